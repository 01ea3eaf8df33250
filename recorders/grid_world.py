"""The environment ``grid_world``: the paper's Grid World (section 5.1), reproduced.

Five by five cells on 128x128 black pixels. The agent is a green square; red and magenta circles, blue and yellow
triangles each fill their cell. With ``agents=2`` there is a second agent, a cyan square. ``grid_rules.py`` says how
they move and push.

Two versions have the same rules and draw the cells otherwise (``grid_drawing.py``). Version 2 draws them as the
paper's published code does, pixel for pixel. Version 1 was recorded before; its frames differ from those of version 2
in 0.3 to 0.4% of the pixels.

Positions are in cells, called metres: x to the right, y downwards, cell (0, 0) at the upper left.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.environment import Policy, RecordingPreset
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.specs import (
    Episode,
    ObjectStates,
    Preset,
    Scalar,
)
from recorders.distractors import (
    FACTORS,
    Picture,
    SceneName,
    Video,
    VideoState,
    episode_values,
    make_scene,
    make_video,
    without_paths,
)
from recorders.expert_policy import ExpertPolicy
from recorders.grid_drawing import SIZE, Version
from recorders.grid_episodes import played_at_once
from recorders.grid_rules import (
    ACTIONS,
    CELLS,
    JOINT_ACTIONS,
    MOVES,
    OBJECTS,
    PUSHED,
    act,
    agents_among,
    legal_actions,
    starting_cells,
)
from recorders.grid_things import FACTS, FACTS_OF_TWO, HEADINGS, draw, heading, states
from recorders.policies import RandomPolicy, require_one_agent
from recorders.push_policy import PushPolicy
from recorders.pushing_script import PushingScript
from recorders.variation import Variation, explained, named_factors


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A state of the world.

    Attributes:
        cells, there: Of all things.
        video: What the next frames depend on besides; None where nothing distracts.
    """

    cells: Int[np.ndarray, "k 2"]
    there: Bool[np.ndarray, " k"]
    video: VideoState | None


class GridWorld(gymnasium.Env[UInt8[np.ndarray, "h w 3"], Any]):
    """A square pushes circles and triangles over a grid, and off it.

    Args:
        version: How the cells are drawn; ``versions`` says what is new in each.
        agents: 1, or 2 for a second agent.
        vary: Names of the factors that are drawn anew for each episode, as a list or separated by commas.
        ranges: What they are drawn from: ``"in-distribution"``, or ``"shifted"``: only values outside of that.
        scene: Which of the ready scenes: ``"clean"``, ``"distracted"``, ``"unseen"``; see ``recorders.distractors``.
        background, movers, correlated, shake, noise, delay: Values of these factors; None: the scene's.
        textures: Generators of the background, separated by commas; None: the scene's.
        clips: The hash of prepared clips, which are the background in place of textures; ``prepared`` makes it.
        render_mode: Gymnasium's; None or ``"rgb_array"``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 -- as in Gymnasium
    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=20, frames=12, tasks=0),
            Preset.SMALL: RecordingPreset(episodes=300, frames=32, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=700, frames=32, tasks=100),
        }
    )
    policies: ClassVar[Mapping[str, Callable[[], Policy]]] = MappingProxyType(
        {"random": RandomPolicy, "object-directed": PushPolicy, "expert-correlated": ExpertPolicy}
    )
    default_policy: ClassVar[str] = "random"
    objective: ClassVar[str] = "tracked"
    settled: ClassVar[bool] = True
    versions: ClassVar[Mapping[int, str]] = MappingProxyType(
        {
            1: "drawn on the 128 x 128 pixels themselves",
            2: "drawn as the paper's published code does: at 500 x 500, reduced by nearest neighbour",
        }
    )

    factors: ClassVar[Mapping[str, str]] = explained(FACTORS)
    _cells: Int[np.ndarray, "k 2"]
    _there: Bool[np.ndarray, " k"]

    def __init__(
        self,
        *,
        version: Version = 1,
        agents: int = 1,
        vary: str | Iterable[str] = (),
        ranges: str = "in-distribution",
        scene: SceneName = "clean",
        background: float | None = None,
        textures: str | None = None,
        clips: str | None = None,
        movers: int | None = None,
        correlated: float | None = None,
        shake: int | None = None,
        noise: float | None = None,
        delay: int | None = None,
        render_mode: str | None = None,
    ) -> None:
        if version not in self.versions:
            raise InvalidSetting(f"version is {version!r}; it can be {', '.join(map(str, self.versions))}.")
        if agents not in (1, 2):
            raise InvalidSetting(f"agents is {agents!r}; Grid World has 1 agent or 2.")
        self.facts, self._version = FACTS if agents == 1 else FACTS_OF_TWO, version
        self._things, self._agents = agents + OBJECTS, list(agents_among(agents + OBJECTS))
        self.render_mode = render_mode
        self.action_space = (ACTIONS if agents == 1 else JOINT_ACTIONS).space()
        self.observation_space = gymnasium.spaces.Box(0, 255, (SIZE, SIZE, 3), np.uint8)
        given = {
            "background": background,
            "movers": movers,
            "correlated": correlated,
            "shake": shake,
            "noise": noise,
            "delay": delay,
        }
        self._scene = make_scene(scene, textures, clips)
        self._variation = Variation(FACTORS, (), ranges)
        self._vary = named_factors(vary)
        self._fixed = {name: value for name, value in given.items() if value is not None}
        self._variation.check(self._vary, self._fixed)
        self._video: Video | None = None
        self._begin(np.random.default_rng(0))
        self._seen = self._drawn()
        self._seen_as_is = True

    @classmethod
    def prepared(cls, parameters: Mapping[str, Scalar]) -> Mapping[str, Scalar]:
        """The parameters with the hash of the clips in the place of their folder."""
        return without_paths(parameters)

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each action takes an agent, in cells."""
        return MOVES.astype(np.float64)

    @property
    def goals(self) -> Float[np.ndarray, "2 2"]:
        """The first and the last cell along x and y."""
        return np.array([[0.0, 0.0], [CELLS - 1.0, CELLS - 1.0]])

    @property
    def area(self) -> Float[np.ndarray, "2 2"]:
        """Likewise of the agent."""
        return self.goals

    def careful_actions(self) -> Bool[np.ndarray, " a"]:
        """Which legal moves push nothing over the edge."""
        legal = self.legal_actions()
        chosen = np.flatnonzero(legal)
        everything = (
            np.repeat(self._cells[None], len(chosen), axis=0),
            np.repeat(self._there[None], len(chosen), axis=0),
        )
        legal[chosen] = (act(*everything, chosen)[1] == self._there).all(axis=-1)
        return legal

    def script(self) -> PushingScript:
        """The rules of the reference ``scripted``.

        Raises:
            InvalidSetting: There are two agents.
        """
        require_one_agent(self, "the reference 'scripted'", "score 'oracle', 'random' or 'idle' instead")
        return PushingScript()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Put agent and objects on cells of their own.

        Args:
            seed: Decides the episode.
            options: ``"vary"`` and values of factors, which go before the constructor's.
        """
        super().reset(seed=seed)
        self._begin(self.np_random)
        values, self._video = self._distraction(self.np_random, options or {})
        self._seen = self._drawn() if self._video is None else self._video.begin(self._drawn())
        self._seen_as_is = True
        return self.render(), {"factors": values} if values else {}

    def _distraction(
        self, generator: np.random.Generator, options: Mapping[str, Any]
    ) -> tuple[dict[str, Scalar], Video | None]:
        """An episode's values of factors and its video; ``generator`` is what the cells were drawn from."""
        fixed = {**self._fixed, **options}
        vary = named_factors(fixed.pop("vary", self._vary))
        if not fixed and not vary and not self._scene.strengths:
            return {}, None
        entropy = int(generator.integers(2**63))
        values = episode_values(self._scene, self._variation, entropy, vary, fixed)
        return values, make_video(self._scene, values, entropy=entropy, facts=self.facts)

    def distracting_motions(self, seed: int, vary: Sequence[str], steps: int) -> dict[str, Float[np.ndarray, "s d"]]:
        """How what distracts moves in the episode of a seed [px]."""
        generator = gymnasium.utils.seeding.np_random(seed)[0]
        starting_cells(generator, self._things)  # drawn first
        _, video = self._distraction(generator, {"vary": vary} if vary else {})
        return {} if video is None else video.motions(steps)

    def step(self, action: int) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Move the agent, or both; an impossible action changes nothing and ``info["illegal"]`` says so.

        Raises:
            InvalidSetting: It is no action.
        """
        illegal = self.advance(action)
        return self.render(), 0.0, False, False, {"illegal": illegal}

    def advance(self, action: int) -> bool:
        """Move the agent, or both, as ``step`` does, without drawing them; whether the action was impossible.

        Raises:
            InvalidSetting: It is no action.
        """
        legal_actions = self.legal_actions()
        if not 0 <= action < len(legal_actions):
            raise InvalidSetting(
                f"{self.facts.id!r} was given the action {action}; it has 0 to {len(legal_actions) - 1}."
            )
        legal = bool(legal_actions[action])
        if legal:
            cells, there = act(self._cells[None], self._there[None], np.array([action]))
            self._cells, self._there, self._seen_as_is = cells[0], there[0], False
            if self._video is not None:
                self._video.step(heading(action, len(self._agents)), HEADINGS)
                if self._video.delay:  # this moment is to be shown later
                    self._look()
        return not legal

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""
        self._look()
        return self._seen.frame.copy()

    def snapshot(self) -> Snapshot:
        """Where everything is."""
        video = None if self._video is None else self._video.state()
        return Snapshot(cells=self._cells, there=self._there, video=video)

    def restore(self, snapshot: Snapshot) -> None:
        """Put everything where it was; it is drawn when it is looked at."""
        self._cells, self._there, self._seen_as_is = snapshot.cells, snapshot.there, False
        if self._video is not None and snapshot.video is not None:
            self._video.restore(snapshot.video)

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """Which moves stay on the grid; of two agents, neither may move against the other."""
        legal: Bool[np.ndarray, " a"] = legal_actions(self._cells[None], self._there[None])[0]
        return legal

    def agent(self) -> ObjectStates:
        """The green square, and the cyan one if there are two."""
        return self._states(self._agents)

    def objects(self) -> ObjectStates:
        """The circles and triangles; ``pixel`` is the mean of the pixels that showed a thing when it was last drawn."""
        return self._states(PUSHED)

    def masks(self) -> UInt8[np.ndarray, "h w"]:
        """What each pixel shows: 0 background, 1 agent, 2 + k object k, then the second agent."""
        self._look()
        return self._seen.masks.copy()

    def memory(self) -> bytes:
        """What the next frames depend on besides where everything is."""
        return b"" if self._video is None else self._video.memory()

    def _begin(self, generator: np.random.Generator) -> None:
        """Put everything on cells of its own."""
        self._cells, self._there = starting_cells(generator, self._things), np.ones(self._things, np.bool_)

    def _look(self) -> None:
        """See the present moment, unless it has been seen."""
        if not self._seen_as_is:
            self._seen = self._drawn() if self._video is None else self._video.show(self._drawn())
            self._seen_as_is = True

    def _drawn(self) -> Picture:
        """The present moment before anything distracts."""
        frames, masks, centers, visible = draw(self._cells[None], self._there[None], self._version)
        return Picture(frame=frames[0], masks=masks[0], pixel=centers[0], visible=visible[0])

    def _states(self, things: slice | list[int]) -> ObjectStates:
        seen = self._seen
        pixel, visible = seen.pixel[things].copy(), seen.visible[things].copy()
        return states(self._cells[things], self._there[things], pixel, visible)

    @classmethod
    def generate(
        cls, seeds: Sequence[int], *, frames: int, policy: str, parameters: Mapping[str, Any]
    ) -> Iterator[Episode]:
        """The episodes of ``seeds``, equal to stepping; with ``RandomPolicy`` all are played at once."""
        world = cls(**parameters)  # the constructor refuses what there is not
        if policy != cls.default_policy:
            if policy not in cls.policies:
                raise UnknownName("policy of grid_world", policy, cls.policies)
            yield from (record_episode(world, cls.policies[policy](), seed, frames) for seed in seeds)
            return
        yield from played_at_once(
            seeds, frames, world._things, world._version, lambda generator: world._distraction(generator, {})
        )
