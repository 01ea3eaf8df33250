"""DMotion (Yuan et al. 2021): a forward model learned from video by disentangling the agent's motion.

Two networks are trained together on triplets (x_{t-1}, x_t, x_{t+1}) without any action:

- The **object extractor** encodes x_t into n maps m^i and the pair (x_t, x_{t+1}) into n motions phi^i, moves each map
  by its motion, m^i_{t+1} = ST(m^i_t, phi^i_t) (eq. 1), and decodes the moved maps to x'_{t+1}.
- The **interaction learner** predicts x''_{t+1} from (x_{t-1}, x_t) and the moved map 0 alone. What the past cannot
  tell it is what the agent chooses to do; so map 0 comes to hold the agent, and phi^0 the agent's motion.

The loss is |x' - x|^2 + |x'' - x|^2 (eq. 2). Afterwards one demonstration (x_t, x_{t+1}) per action fills the
action-transformation table a -> phi^0, and the interaction learner is the forward model.

The paper has one agent and names several as future work (section VI). Here the interaction learner may be given the
first k maps, ``agents=k``: map i is moved by phi^i, and each agent has a table of its own. Whose map is which is
decided with the tables, from the demonstrations (``JointActionToLatent``); from then on all methods speak of agents in
the order of ``EnvSpec.agents``.

This file is the method. The networks are in ``dmotion_paper.py``, layer by layer as published, and in
``dmotion_compact.py``, which need far less computation. ``dmbench bench`` measures both (``train[dmotion-compact]``,
``train[dmotion-paper]``).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import Any, ClassVar, Final, Literal

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float
from torch import Tensor, nn

from baselines import dmotion_compact, dmotion_paper
from baselines.dominant_shift import dominant_shift
from baselines.layers import squared_error
from baselines.motion import AffineMotion, CrossConvolution, Motion, Translation, pixel_shift, theta_of_shift
from baselines.own_frames import WITH_OWN_FRAMES, OwnFrames, Step
from baselines.patches import rows_of
from baselines.recipe import compact_recipe
from baselines.two_frames import Packed, TwoFrameModel
from baselines.unet import UNetConfig
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.action_encoding import Actions
from dmotion_bench.learning.action_to_latent import ActionToLatent, JointActionToLatent
from dmotion_bench.learning.model import (
    Demonstrations,
    Losses,
    ModelInputs,
    Phase,
    TrainingConfig,
    TripletBatch,
)
from dmotion_bench.learning.settings import only_with
from dmotion_bench.specs import Preset, Supervision

MOST_AGENTS: Final = 4
_OF_TRANSLATIONS: Final = {"blur": 1, "jitter": 0, "jitter_end": 0, "anneal": None, "guide": 1, "guided": None}
"""Settings that do nothing to other transforms, each with the value besides its default that ``configure`` gives."""
CLOSE: Final = 0.05  # in theta's units: nearer than this, the distance to the guiding shift is squared


@dataclass(frozen=True, kw_only=True)
class DMotionConfig(UNetConfig):
    """The choices that the paper leaves open or compares.

    The other transforms have neither ``blur`` nor ``jitter`` nor ``guide``: they are trained without these three aids.

    Attributes:
        arch: ``"paper"`` as published, ``"compact"`` for speed.
        maps: n, the number of feature maps.
        agents: How many of the maps, the first ones, hold an agent; the paper's is 1.
        transform: ``"translation"`` (the default in both environments), ``"affine"`` with all six parameters, or
            ``"cross_convolution"`` (the ablation DMotion-No-STN).
        kernel: Side of cross convolution's kernels [px of the map].
        agent_entries: At how many places of the interaction learner the agent's map enters: 3 as in the paper, or 1.
        second_frame: Whether the interaction learner sees x_{t-1}.
        warp, gate_floor, width: Of the interaction learner; compact only. The paper's paints, and has no gate.
        blur: Width of the interpolation kernel at the start of the training [px of the map]; shrinks to 1 over the
            share ``anneal`` of it. 1 is the paper's. With wide kernels the gradient of the motion reaches far.
        jitter: Standard deviation of the noise on phi^0 as the interaction learner sees it, at the start of the
            training [px of the map]; falls to ``jitter_end`` at its end. 0 is the paper's. With noise on it,
            only a true motion carries the action; a hidden code in the last digits of phi^0 does not.
        jitter_end: Where the noise ends; no more than where it starts.
        anneal: Share of the training after which the kernel has its own width.
        guide: Weight of the distance from phi^0 to the shift that explains best what changes between the two frames
            (``dominant_shift.py``), at the start of the training; falls to 0 over the share ``guided`` of it. 0 is the
            paper's. It is used with one agent and translations. Without it map 0 may come to have coordinates of its
            own, in which phi^0 names the action as well and is no shift in the picture.
        guided: Share of the training after which nothing guides phi^0.
        own_frames: Share of the triplets, at the end of the training, whose x_{t-1} and x_t are the model's own, as
            they are in planning (``own_frames.py``); it grows from 0 in proportion. 0 is the paper's.
        own_steps: At most so many predictions in a row lead to such an x_t.
    """

    arch: Literal["compact", "paper"] = "compact"
    maps: int = 8
    agents: int = 1
    transform: Literal["translation", "affine", "cross_convolution"] = "translation"
    kernel: int = 27
    agent_entries: Literal[1, 3] = 3
    second_frame: bool = True
    blur: float = 8.0
    jitter: float = 1.2
    jitter_end: float = only_with(0.2, "jitter above 0", lambda its: its.jitter > 0)
    anneal: float = only_with(0.2, "blur above 1", lambda its: its.blur > 1)
    guide: float = only_with(0.0, "agents=1", lambda its: its.agents == 1)
    guided: float = only_with(0.4, "guide above 0 and agents=1", lambda its: its.guide > 0 and its.agents == 1)
    own_frames: float = 0.0
    own_steps: int = only_with(4, *WITH_OWN_FRAMES)

    def __post_init__(self) -> None:
        if self.maps < 1 or self.kernel % 2 == 0:
            raise InvalidSetting(f"maps is {self.maps} and kernel {self.kernel}; maps must be 1 or more, kernel odd.")
        if not 1 <= self.agents <= min(self.maps, MOST_AGENTS):
            raise InvalidSetting(
                f"agents is {self.agents}; it can be 1 to {min(self.maps, MOST_AGENTS)}, with {self.maps} maps."
            )
        if self.blur < 1 or min(self.jitter, self.jitter_end) < 0 or not 0 < self.anneal <= 1:
            raise InvalidSetting(
                "blur must be 1 or more, jitter and jitter_end 0 or more, anneal above 0 and at most 1."
            )
        if self.guide < 0 or not 0 < self.guided <= 1:
            raise InvalidSetting("guide must be 0 or more, guided above 0 and at most 1.")
        OwnFrames(self.own_frames, self.own_steps)  # refuses what cannot be
        super().__post_init__()
        if self.transform != "cross_convolution" and self.kernel != DMotionConfig.kernel:
            raise InvalidSetting(f"kernel is for transform=cross_convolution; {self.transform} has none.")
        for name, also in _OF_TRANSLATIONS.items():
            if self.transform != "translation" and getattr(self, name) not in (getattr(DMotionConfig, name), also):
                raise InvalidSetting(f"{name} is for transform=translation; with {self.transform} it does nothing.")
        usual = UNetConfig()
        for name in ("warp", "gate_floor", "width"):
            if self.arch == "paper" and getattr(self, name) != getattr(usual, name):
                raise InvalidSetting(f"{name} is for arch=compact; the paper's interaction learner has no such choice.")


class DMotion(TwoFrameModel[DMotionConfig]):
    """Learns from video alone; a few demonstrations tell it afterwards which latent action each action is."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = (
        "Yuan, Wu, Zhao, Zhang, Ding, Dong: DMotion: Robotic Visuomotor Control with Unsupervised Forward Model "
        "Learned from Videos, IROS 2021"
    )
    Config: ClassVar[type] = DMotionConfig
    architectures: ClassVar[tuple[str, ...]] = ("compact", "paper")

    def __init__(self, config: DMotionConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.transform: Motion = _transform(config)
        if inputs.height != inputs.width or inputs.height % 16:
            raise InvalidSetting(
                f"frames are {inputs.height} x {inputs.width}; "
                "DMotion takes square ones whose side is a multiple of 16."
            )
        is_paper = config.arch == "paper"
        networks = dmotion_paper if is_paper else dmotion_compact
        sized = {"side": inputs.height} if is_paper else {}  # the compact networks have no layer that knows the size
        self.pack, self.unpack = networks.pack, networks.unpack
        self.image_encoder = networks.ImageEncoder(config.maps)
        self.motion_encoder = networks.MotionEncoder(
            config.maps, self.transform.identity(), reversible=self.transform.reversible, **sized
        )
        self.decoder = networks.Decoder(config.maps, **sized)
        self.interaction_learner = networks.InteractionLearner(
            frames=2 if config.second_frame else 1,
            agent_entries=config.agent_entries,
            agents=config.agents,
            **({} if is_paper else {"config": config}),
        )
        identity = self.transform.identity()
        self.table: ActionToLatent | JointActionToLatent
        if config.agents == 1:
            self.table = ActionToLatent(inputs.actions, identity.shape[-1], unaligned=identity)
            self.register_state_dict_post_hook(_without_the_tables_module)  # type: ignore[no-untyped-call]
            self.register_load_state_dict_pre_hook(_with_the_tables_module)  # type: ignore[no-untyped-call]
        else:
            self.table = JointActionToLatent(inputs.actions, config.agents, identity.shape[-1], unaligned=identity)
        self.blur, self.jitter, self.guide = config.blur, config.jitter, config.guide
        self.own_frames = OwnFrames(config.own_frames, config.own_steps)

    @classmethod
    def configure(cls, arch: str) -> DMotionConfig:
        """The paper's architecture is trained as in the paper: no widened kernels, no noise, nothing that guides."""
        if arch == "paper":
            return DMotionConfig(arch="paper", blur=1.0, jitter=0.0, jitter_end=0.0)
        return DMotionConfig(guide=1.0)

    @classmethod
    def training_defaults(cls, preset: Preset, arch: str) -> TrainingConfig:
        """The paper's: Adam 1e-3, batches of 32, 50 epochs."""
        if arch == "paper":
            return TrainingConfig(
                epochs={Preset.TINY: 1, Preset.SMALL: 10, Preset.PAPER: 50}[preset],
                learning_rate=1e-3,
                schedule="constant",
                optimizer="adam",
                clip_norm=0.0,
                channels_last=True,
            )
        return compact_recipe(preset)

    def phases(self) -> tuple[Phase, ...]:
        """One, of video alone; with the frames before a triplet if the model is to predict from its own."""
        return (Phase(earlier=self.own_frames.earlier),)

    def progress(self, share: float) -> None:
        """Narrow the interpolation kernel, reduce the noise, and let go of phi^0 as the training proceeds."""
        left = max(0.0, 1 - share / self.config.anneal)
        self.blur = 1 + (self.config.blur - 1) * left
        end = min(self.config.jitter, self.config.jitter_end)  # the noise never grows
        self.jitter = end + (self.config.jitter - end) * (1 - share)
        self.guide = self.config.guide * max(0.0, 1 - share / self.config.guided)
        self.own_frames.progress(share)

    def losses(self, batch: TripletBatch) -> Losses:
        """Equation 2, in squared [-1, 1] units, averaged over pixels and channels.

        Not in the paper: what guides phi^0, and own frames.
        """
        previous, current, following = (self.pack(image) for image in (batch.previous, batch.current, batch.next))
        maps = self.image_encoder(current)
        motion = self.motion_encoder(current, following)
        blur = self.blur if self.training else 1.0
        reconstructed = self.decoder(self.transform(maps, motion, blur))
        count = self.config.agents
        held = maps[:, :count]
        if self.training and (own := self.own_frames.of(batch, self.pack, self._followed)) is not None:
            previous, current = own.put_into(previous, current)
            held = held.index_copy(0, own.rows, self.image_encoder(own.current, count))
        agents = self.transform(held, self._with_noise(motion[:, :count], maps.shape[-1]), blur)
        predicted = self._interact(previous, current, agents)
        each = squared_error(predicted, following)  # packing moves pixels about, the mean stays
        extraction, prediction = squared_error(reconstructed, following).mean(), each.mean()
        total, terms = extraction + prediction, {"extraction": extraction.detach(), "prediction": prediction.detach()}
        if self.training and self.guide and self._can_be_guided:
            guidance = self._guidance(batch, motion)
            total, terms = total + self.guide * guidance, terms | {"guidance": guidance.detach()}
        return Losses(total=total, terms=terms, per_triplet=each.detach())

    @torch.no_grad()
    def align(self, demonstrations: Demonstrations) -> None:
        """Learn the phi^0 of each action: for discrete ones this is the paper's action-transformation table.

        Of several agents, first of all whose maps are whose.
        """
        motions = demonstrations.read(lambda _, current, following: self._motions(current, following))
        self.table.fit(motions if self.config.agents > 1 else motions[:, 0], demonstrations.action)

    def _drawn(self, previous: Tensor, current: Tensor, parent: Tensor | None, latent: Tensor) -> Packed:
        """Predict x''_{t+1} with ``latent`` as the agent's motion, or the agents' motions one after the other."""
        count = self.config.agents
        motions = self.agent_motions(latent)
        if count > 1:
            motions = motions[:, self._order().argsort()]  # as the maps are
        agents = self.transform(rows_of(self.image_encoder(current, count), parent), motions)
        last = rows_of(current, parent)
        if self.config.arch == "paper":
            return last, self._interact(rows_of(previous, parent), last, agents)
        predicted: Tensor = self.interaction_learner(
            self._frames(previous, current), agents, parent=parent, current=last
        )
        return last, predicted

    def _latent_of(self, action: Actions) -> Float[Tensor, "b d"]:
        latent: Tensor = self.table(action).flatten(1)
        return latent

    def motion(self, current: Float[Tensor, "b c h w"], following: Float[Tensor, "b c h w"]) -> Float[Tensor, "b d"]:
        """phi^0: how the agent moves between two frames; of several agents one after the other."""
        return self._motions(current, following)[:, self._order()].flatten(1)

    def agent_motions(self, latent: Float[Tensor, "b d"]) -> Float[Tensor, "b k e"]:
        """The motion of each agent, out of a latent action."""
        return rearrange(latent, "b (k e) -> b k e", k=self.config.agents)

    def _motions(self, current: Float[Tensor, "b c h w"], following: Float[Tensor, "b c h w"]) -> Tensor:
        """The motions of the agents' maps, in the order of the maps."""
        motion: Tensor = self.motion_encoder(self.pack(current), self.pack(following))
        return motion[:, : self.config.agents]

    def _order(self) -> Tensor:
        """The agents' maps."""
        return self.table.order if isinstance(self.table, JointActionToLatent) else torch.zeros(1, dtype=torch.long)

    def latent_action(
        self,
        previous: Float[Tensor, "b c h w"],
        current: Float[Tensor, "b c h w"],
        following: Float[Tensor, "b c h w"],
    ) -> Float[Tensor, "b d"]:
        """phi^0; it does not depend on x_{t-1}."""
        return self.motion(current, following)

    def agent_map(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b y x"]:
        """|m^0|: where the agent is, or the first of several."""
        return self.agent_maps(current)[:, 0]

    def agent_maps(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k y x"]:
        """|m^i|: where each agent is."""
        return self.feature_maps(current)[:, self._order()].abs()

    def feature_maps(self, current: Float[Tensor, "b c h w"]) -> Float[Tensor, "b k y x"]:
        """The maps m^i_t before they are moved."""
        maps: Tensor = self.image_encoder(self.pack(current))
        return maps.float()

    def moved_maps(
        self, current: Float[Tensor, "b c h w"], following: Float[Tensor, "b c h w"]
    ) -> Float[Tensor, "b k y x"]:
        """The maps m^i_{t+1}, each moved by its own motion."""
        current, following = self.pack(current), self.pack(following)
        return self.transform(self.image_encoder(current), self.motion_encoder(current, following)).float()

    def pixel_shift(self, motion: Float[Tensor, "b d"]) -> Float[Tensor, "b 2"]:
        """How far a motion moves the agent: (right, down) in pixels of the frame."""
        if isinstance(self.transform, Translation):
            return pixel_shift(motion, self._map_side) * self._map_pixel
        if isinstance(self.transform, AffineMotion):
            return pixel_shift(motion[:, [2, 5]], self._map_side) * self._map_pixel
        side = self.transform.size**0.5
        weights = motion.abs() / motion.abs().sum(-1, keepdim=True)
        place = torch.arange(motion.shape[-1], device=motion.device)
        offset = torch.stack([place % side, place // side], -1) - side // 2
        shift: Tensor = -(weights @ offset.float()) * self._map_pixel
        return shift

    @property
    def _map_side(self) -> int:
        """Of the maps m^i [px of the map]."""
        return dmotion_paper.MAP_SIZE if self.config.arch == "paper" else self.inputs.width // dmotion_compact.MAP_PIXEL

    @property
    def _map_pixel(self) -> float:
        """The side of a map's pixel [px of the frame]."""
        return self.inputs.width / self._map_side

    def _interact(self, previous: Tensor, current: Tensor, agent: Tensor) -> Float[Tensor, "b c h w"]:
        predicted: Tensor = self.interaction_learner(self._frames(previous, current), agent)
        return predicted

    def _frames(self, previous: Tensor, current: Tensor) -> list[Tensor]:
        return [previous, current] if self.config.second_frame else [current]

    def _followed(self, previous: Tensor, current: Tensor, step: Step) -> Float[Tensor, "b p hp wp"]:
        """x''_{t+1}, packed, under the motions that are seen in a step."""
        count = self.config.agents
        agents = self.transform(
            self.image_encoder(current, count), self.motion_encoder(step.now, step.after)[:, :count]
        )
        return self._interact(previous, current, agents)

    @property
    def _can_be_guided(self) -> bool:
        """Whether phi^0 is one shift: two agents that move at once leave no shift that explains what changes."""
        return self.config.agents == 1 and isinstance(self.transform, Translation)

    def _guidance(self, batch: TripletBatch, motion: Float[Tensor, "b k d"]) -> Float[Tensor, ""]:
        """How far phi^0 is from the shift that explains best what changes, where there is one."""
        shift = dominant_shift(batch.current, batch.next)
        wanted = theta_of_shift(shift.pixels / self._map_pixel, self._map_side)
        distance = F.smooth_l1_loss(motion[:, 0], wanted, beta=CLOSE, reduction="none").sum(1)
        return (distance * shift.confidence).sum() / shift.confidence.sum().clamp(min=1)

    def _with_noise(self, motion: Float[Tensor, "b k d"], size: int) -> Float[Tensor, "b k d"]:
        if not self.training or not self.jitter or not isinstance(self.transform, Translation):
            return motion
        return motion + torch.randn_like(motion) * (self.jitter * 2 / (size - 1))


class DMotionNoSTN(DMotion):
    """The paper's ablation: cross convolution in place of the spatial transformer; the table holds kernels."""

    @classmethod
    def configure(cls, arch: str) -> DMotionConfig:
        """A kernel of 27 reaches a grid cell; ``--set kernel=5`` is that of Visual Dynamics."""
        return dataclasses.replace(super().configure(arch), transform="cross_convolution", guide=0.0)


def _without_the_tables_module(model: nn.Module, state: dict[str, Any], prefix: str, _: object) -> None:
    """Checkpoints hold the table under the name that it had as a tensor of the model's own."""
    state[f"{prefix}table"] = state.pop(f"{prefix}table.rows")


def _with_the_tables_module(model: nn.Module, state: dict[str, Any], prefix: str, *_: object) -> None:
    if f"{prefix}table" in state:
        state[f"{prefix}table.rows"] = state.pop(f"{prefix}table")


def _transform(config: DMotionConfig) -> Motion:
    if config.transform == "translation":
        return Translation()
    if config.transform == "affine":
        return AffineMotion()
    return CrossConvolution(config.kernel)
