"""What the two pushing environments share: how the pusher moves, what is seen, episodes out of seeds.

A subclass says how an episode is built, how a step is simulated, and how the scene is drawn.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, UInt8

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.environment import Policy, RecordingPreset
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import EnvSpec, ObjectSpec, ObjectStates, Preset, Scalar
from recorders.distractors import Picture, Scene, Video, VideoState, episode_values, make_video, without_paths
from recorders.expert_policy import ExpertPolicy
from recorders.policies import RandomPolicy
from recorders.push_policy import PushPolicy
from recorders.pushing_script import PushingScript
from recorders.table_lattice import Lattice, Place
from recorders.table_things import turned
from recorders.variation import Factor, Variation, named_factors

ACTIONS = ("up", "down", "left", "right")  # as seen in the picture


@dataclass(frozen=True, kw_only=True)
class Snapshot:
    """A state between two steps, when everything is at rest.

    Attributes:
        place: Of the pusher.
        moment: Steps since the episode's start.
        positions, orientations: Of the objects, as ``ObjectStates`` has them.
        video: What the next frames depend on besides; None where nothing distracts.
    """

    place: Place
    moment: int
    positions: Float[np.ndarray, "k 3"]
    orientations: Float[np.ndarray, "k 4"]
    video: VideoState | None = None


class PushingEnvironment(gymnasium.Env[UInt8[np.ndarray, "h w 3"], Any]):
    """A pusher moves over a table, in four directions on a lattice or freely, and pushes what it meets.

    A step lasts until everything is at rest. An object that falls off the table is gone, and the episode has
    terminated; stepping on is allowed.

    ``reset``'s options may hold ``"vary"`` and values of factors, which go before the constructor's. The values of
    an episode's factors, where they may be unusual, are in ``info["factors"]``; given as options together with the
    seed they make the same episode.

    Args:
        facts: What is always true of the environment.
        factors: What may vary in it.
        lattice: Where the pusher can stand.
        vary: Names of the factors that are drawn anew for each episode, as a list or separated by commas.
        ranges: What they are drawn from, one of ``variation.Ranges``.
        fixed: Values of factors for every episode; None leaves the scene's, or the usual one.
        scene: What distracts in its video.
        render_mode: Gymnasium's; None or ``"rgb_array"``.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 -- as in Gymnasium
    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=6, frames=16, tasks=0),
            Preset.SMALL: RecordingPreset(episodes=330, frames=101, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=6000, frames=101, tasks=104),
        }
    )
    policies: ClassVar[Mapping[str, Callable[[], Policy]]] = MappingProxyType(
        {"push": PushPolicy, "random": RandomPolicy, "object-directed": PushPolicy, "expert-correlated": ExpertPolicy}
    )
    default_policy: ClassVar[str] = "push"
    objective: ClassVar[str] = "tracked"
    settled: ClassVar[bool] = True
    factors: ClassVar[Mapping[str, str]] = MappingProxyType({})

    def __init__(
        self,
        *,
        facts: EnvSpec,
        factors: Iterable[Factor],
        lattice: Lattice,
        vary: str | Iterable[str],
        ranges: str,
        fixed: Mapping[str, float | None],
        scene: Scene,
        render_mode: str | None,
    ) -> None:
        self.facts = facts
        self.lattice = lattice
        self.render_mode = render_mode
        assert facts.actions is not None, "a pushing world knows what can be done in it"
        self.actions = facts.actions
        self.action_space = self.actions.space()
        self.observation_space = gymnasium.spaces.Box(0, 255, (facts.height, facts.width, 3), np.uint8)
        self._variation = Variation(factors, [one.name for one in facts.objects], ranges)
        self._vary = named_factors(vary)
        self._fixed = {name: value for name, value in fixed.items() if value is not None}
        self._variation.check(self._vary, self._fixed)
        self._scene = scene
        self._video: Video | None = None
        self._seen: Picture | None = None
        self._factors: dict[str, Scalar] = {}
        self._place: Place = (0, 0)
        self._moment = 0

    @classmethod
    def prepared(cls, parameters: Mapping[str, Scalar]) -> Mapping[str, Scalar]:
        """The parameters with the hash of the clips in the place of their folder."""
        return without_paths(parameters)

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each discrete action takes the pusher, along the world's x and y [m]."""
        moves: Float[np.ndarray, "a 2"] = self.lattice.step * np.asarray(self.lattice.moves)
        return moves

    def script(self) -> PushingScript:
        """The rules of the reference ``scripted``."""
        return PushingScript()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Start an episode, a function of the seed and the options alone."""
        super().reset(seed=seed)
        fixed = {**self._fixed, **(options or {})}
        vary = named_factors(fixed.pop("vary", self._vary))
        entropy = _entropy(self.np_random)
        self._factors = episode_values(self._scene, self._variation, entropy, vary, fixed)
        self._moment = 0
        self._place = self._begin(np.random.default_rng([entropy, 0]), np.random.default_rng([entropy, 1]))
        self._video = make_video(
            self._scene, self._factors, entropy=entropy, facts=self.facts, surroundings=self._surroundings()
        )
        self._frame, self._masks = self._draw()
        if self._video is not None:
            self._see(self._video.begin(self._undistracted()))
        self._drawn_as_is = True
        return self._frame.copy(), {"factors": dict(self._factors)}

    def distracting_motions(self, seed: int, vary: Sequence[str], steps: int) -> dict[str, Float[np.ndarray, "s d"]]:
        """How what distracts moves in the episode of a seed [px]; nothing is simulated."""
        entropy = _entropy(gymnasium.utils.seeding.np_random(seed)[0])
        chosen = named_factors(vary) if vary else self._vary
        values = episode_values(self._scene, self._variation, entropy, chosen, self._fixed)
        video = make_video(self._scene, values, entropy=entropy, facts=self.facts)
        return {} if video is None else video.motions(steps)

    @property
    def room(self) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest displacement along x and y that nothing cuts short [m]."""
        return self.lattice.room(self._place)

    @property
    def goals(self) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest place along x and y that an object may be pushed to [m]."""
        origin, places = np.asarray(self.lattice.origin), np.asarray(self.lattice.places)
        goals: Float[np.ndarray, "2 2"] = origin + self.lattice.step * np.stack([0 * places + 1, places - 2])
        return goals

    @property
    def area(self) -> Float[np.ndarray, "2 2"]:
        """The least and the greatest place along x and y where the pusher can be [m]."""
        return np.array(
            [self.lattice.at((0, 0)), self.lattice.at((self.lattice.places[0] - 1, self.lattice.places[1] - 1))]
        )

    def step(self, action: Any) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Move the pusher; ``info["illegal"]`` says that a move would have left its area.

        Such a discrete action changes nothing; a displacement ends at the area's edge.

        Raises:
            InvalidSetting: It is no action, or has a number outside of its bounds.
        """
        illegal = self.advance(action)
        return self.render(), 0.0, self._terminated(), False, {"illegal": illegal}

    def advance(self, action: Any) -> bool:
        """Move the pusher as ``step`` does, without drawing it; whether the move would have left its area.

        Raises:
            InvalidSetting: It is no action, or has a number outside of its bounds.
        """
        place, illegal = self._after(action)
        if not illegal or isinstance(self.actions, Continuous):
            if self._video is not None:
                self._video.step(*(self._directions(action) if self._video.follows else ((0.0, 0.0), None)))
            self._place = place
            self._moment += 1
            self._push(self.lattice.at(self._place))
            self._drawn_as_is = False
            if self._video is not None and self._video.delay:  # this moment is to be shown later
                self._show()
        return illegal

    def _refresh(self) -> None:
        """Draw the present moment, unless that has been done."""
        if not self._drawn_as_is:
            self._show()

    def _show(self) -> None:
        """Draw the present moment, and what its frame shows."""
        self._frame, self._masks = self._draw()
        if self._video is not None:
            self._see(self._video.show(self._undistracted()))
        self._drawn_as_is = True

    def _undistracted(self) -> Picture:
        """What was drawn last, before anything distracts."""
        agent, objects = self._agent(), self._objects()
        return Picture(
            frame=self._frame,
            masks=self._masks,
            pixel=np.concatenate([agent.pixel, objects.pixel]),
            visible=np.concatenate([agent.visible, objects.visible]),
        )

    def _see(self, seen: Picture) -> None:
        self._seen, self._frame, self._masks = seen, seen.frame, seen.masks

    def _directions(self, action: Any) -> tuple[tuple[float, float], list[tuple[float, float]] | None]:
        """Where an action points in the picture (x, y), of length 1 or (0, 0), and where all do, if they are few."""
        ways = np.asarray(action, np.float64)[None] if isinstance(self.actions, Continuous) else self.moves
        here = np.asarray(self.lattice.at(self._place))
        seen = self._projected(np.concatenate([here[None], here + ways]))
        steps: list[list[float]] = (seen[1:] - seen[0]).tolist()
        lengths = [math.hypot(x, y) for x, y in steps]
        headings = [(x / far, y / far) if far else (0.0, 0.0) for (x, y), far in zip(steps, lengths, strict=True)]
        return (headings[0], None) if isinstance(self.actions, Continuous) else (headings[int(action)], headings)

    def _after(self, action: Any) -> tuple[Place, bool]:
        """Where an action leads, and whether it would leave the pusher's area."""
        if not isinstance(self.actions, Continuous):
            self._require(self.actions.fault([action]))
            return self.lattice.after(self._place, int(action)), not bool(self.legal_actions()[action])
        values = np.asarray(action, np.float64)
        self._require(self.actions.fault(values[None]))
        return self.lattice.moved(self._place, (float(values[0]), float(values[1])))

    def _require(self, fault: str | None) -> None:
        if fault:
            raise InvalidSetting(f"{self.facts.id!r} was given {fault}; an action is {self.actions}.")

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""
        self._refresh()
        return self._frame.copy()

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """Which moves of a whole step, in the four directions, stay in the pusher's area."""
        return self.lattice.legal(self._place)

    def masks(self) -> UInt8[np.ndarray, "h w"]:
        """What each pixel's centre shows: 0 background, 1 agent, 2 + k object k."""
        self._refresh()
        return self._masks.copy()

    def agent(self) -> ObjectStates:
        """The pusher's state, k = 1."""
        return self._as_seen(self._agent(), slice(1))

    def objects(self) -> ObjectStates:
        """The objects' states; where something distracts, ``pixel`` and ``visible`` are of what the frame shows."""
        return self._as_seen(self._objects(), slice(1, None))

    def _as_seen(self, states: ObjectStates, things: slice) -> ObjectStates:
        """A copy of states, with what the frame shows of them: whoever is told may write into it."""
        pixel, visible = states.pixel, states.visible
        if self._video is not None and self._seen is not None:
            pixel, visible = self._seen.pixel[things], self._seen.visible[things]
        return ObjectStates(
            position=states.position.copy(),
            orientation=states.orientation.copy(),
            pixel=pixel.copy(),
            visible=visible.copy(),
        )

    def memory(self) -> bytes:
        """What the next frames depend on besides where everything is."""
        drifting = self._moment.to_bytes(8, "little") if self._factor("distractors") else b""
        return drifting if self._video is None else self._video.memory()

    def snapshot(self) -> Snapshot:
        """Where everything is; all of it is at rest."""
        objects = self._objects()
        return Snapshot(
            place=self._place,
            moment=self._moment,
            positions=objects.position.copy(),
            orientations=objects.orientation.copy(),
            video=None if self._video is None else self._video.state(),
        )

    def restore(self, snapshot: Snapshot) -> None:
        """Put everything where it was; it is drawn when it is looked at."""
        self._place, self._moment = snapshot.place, snapshot.moment
        self._put(snapshot, self.lattice.at(snapshot.place))
        if self._video is not None and snapshot.video is not None:
            self._video.restore(snapshot.video)
        self._drawn_as_is = False

    @abstractmethod
    def _agent(self) -> ObjectStates:
        """The pusher's state as it was drawn, k = 1."""

    @abstractmethod
    def _objects(self) -> ObjectStates:
        """The objects' states as they were drawn."""

    @abstractmethod
    def _projected(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        """Where the pusher is seen in the picture [px] when it stands at these places [m]."""

    @abstractmethod
    def _surroundings(self) -> tuple[int, int, int]:
        """The colour (RGB) around the picture in this episode."""

    @abstractmethod
    def _begin(self, placement: np.random.Generator, distraction: np.random.Generator) -> Place:
        """Build an episode's world with ``self._factors``; where the pusher stands in it."""

    @abstractmethod
    def _push(self, goal: tuple[float, float]) -> None:
        """Move the pusher to ``goal`` [m] and wait until everything is at rest."""

    @abstractmethod
    def _put(self, snapshot: Snapshot, pusher: tuple[float, float]) -> None:
        """Build the physics anew with everything where the snapshot has it, the pusher at ``pusher`` [m]."""

    @abstractmethod
    def _terminated(self) -> bool:
        """Whether an object has fallen."""

    @abstractmethod
    def _draw(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        """The present frame and masks."""

    def _factor(self, name: str, of_object: str | None = None) -> float:
        return self._variation.of(self._factors, name, of_object)

    def _color(self, one: ObjectSpec) -> tuple[float, float, float]:
        """An object's colour in this episode: RGB, 0-1."""
        return turned(one.color, self._factor("colour", one.name))


def pushing_actions(kind: str, lattice: Lattice) -> ActionSpec:
    """Four directions, or a displacement of the pusher of up to one step of the lattice along each axis.

    Args:
        kind: ``"discrete"`` or ``"continuous"``.

    Raises:
        UnknownName: It is neither.
    """
    if kind == "discrete":
        return Discrete(ACTIONS)
    if kind != "continuous":
        raise UnknownName("kind of actions", kind, ("discrete", "continuous"))
    return Continuous(names=("dx", "dy"), low=(-lattice.step,) * 2, high=(lattice.step,) * 2, units=("m", "m"))


def _entropy(generator: np.random.Generator) -> int:
    """An episode's entropy, the first that is drawn by its seed; all its random streams are made of it."""
    return int(generator.integers(2**63))
