"""The environment ``push_t``: PushT, in which world models and imitation are compared, written on pymunk 7.

Geometry, motion, goal and rule of success are the published ones (``tee.py``, ``physics.py``, ``measure.py``). What is
our own: pictures of 128 x 128 pixels drawn in numpy, positions in metres (the square of 512 "pixels" has sides of
512 mm), starts in which nothing overlaps, and policies that record data.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, UInt8

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Policy, RecordingPreset
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import MASK_AGENT, MASK_FIRST_OBJECT, EnvSpec, ObjectSpec, ObjectStates, Preset
from recorders.push_t.drawing import DISC_COLOR, SCREEN, TEE_COLOR, background, disc_stamp, tee_stamp
from recorders.push_t.measure import SUCCESS_COVERAGE, GoalCoverage, pose_of
from recorders.push_t.physics import DISC_RADIUS, INSIDE, Point, PushPhysics, Snapshot
from recorders.push_t.policies import Pushing, Wandering
from recorders.push_t.tee import GOAL, MM, SIDE, Pose, clearance, coverage

LONGEST = 100.0  # displacement along x and y [mm]; DINO-WM's and LeWM's scale of relative actions
DISC_STARTS, TEE_STARTS = (50.0, 450.0), (100.0, 400.0)  # along x and y [mm]
GOAL_DISC: Point = (256.0, 400.0)  # where the disc is in the picture of the fixed goal [mm]

ACTIONS = MappingProxyType(
    {
        "target": Continuous(names=("x", "y"), low=(0.0, 0.0), high=(SIDE, SIDE), units=("mm", "mm")),
        "displacement": Continuous(
            names=("dx", "dy"), low=(-LONGEST, -LONGEST), high=(LONGEST, LONGEST), units=("mm", "mm")
        ),
    }
)
GOALS = ("later", "fixed")


class PushT(gymnasium.Env[UInt8[np.ndarray, "h w 3"], Any]):
    """A disc pushes a T over a square of 512 mm; 128x128 pixels of 4 mm, ten actions a second.

    An episode's reward is ``gym-pusht``'s: the share of the green zone that the T covers, divided by 0.95, at most 1.
    ``info["coverage"]`` is that share. With the fixed goal the episode has terminated when it exceeds 0.95.

    ``reset``'s options may hold ``"state"``: the disc's x and y, the T's x, y [mm] and angle [rad], as ``gym-pusht``
    has them. The state is then exactly this one, at rest.

    Args:
        goal: Of control tasks: ``"later"``, what was recorded some frames after a task's start, or ``"fixed"``, the
            green zone.
        actions: ``"target"``: the place (x, y) that the disc is pulled to; ``"displacement"``: that place as seen from
            the disc, up to 100 mm along x and y. A place outside of the square is moved to its edge.
        render_mode: Gymnasium's; None or ``"rgb_array"``.
    """

    title: ClassVar[str] = "PushT"
    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 -- as in Gymnasium
    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=6, frames=16, tasks=0),
            Preset.SMALL: RecordingPreset(episodes=330, frames=101, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=6000, frames=101, tasks=104),
        }
    )
    policies: ClassVar[Mapping[str, Callable[[], Policy]]] = MappingProxyType({"push": Pushing, "random": Wandering})
    default_policy: ClassVar[str] = "push"
    objective: ClassVar[str] = "pixel"

    def __init__(
        self,
        *,
        goal: Literal["later", "fixed"] = "later",
        actions: Literal["target", "displacement"] = "target",
        render_mode: str | None = None,
    ) -> None:
        if goal not in GOALS:
            raise UnknownName("kind of goal", goal, GOALS)
        if actions not in ACTIONS:
            raise UnknownName("kind of actions", actions, tuple(ACTIONS))
        self.render_mode = render_mode
        self._fixed_goal, self._relative = goal == "fixed", actions == "displacement"
        self.actions = ACTIONS[actions]
        self.facts = EnvSpec(
            id="push_t",
            actions=self.actions,
            agent=ObjectSpec(name="disc", shape="circle", color=DISC_COLOR),
            objects=(ObjectSpec(name="tee", shape="T", color=TEE_COLOR),),
            agent_has_color=True,
            push_threshold=1e-3,
        )
        self.action_space = self.actions.space()
        self.observation_space = gymnasium.spaces.Box(0, 255, (self.facts.height, self.facts.width, 3), np.uint8)
        self._physics = PushPhysics()
        self._picture: tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]] | None = None

    @property
    def disc(self) -> Point:
        """Where the disc is [mm]."""
        return self._physics.motion.disc

    @property
    def tee(self) -> Pose:
        """Where the T is."""
        return self._physics.motion.tee

    def towards(self, target: Point) -> Float[np.ndarray, "2"]:
        """The action that pulls the disc to a place [mm], as nearly as one can."""
        place = np.clip(np.array(target), 0.0, SIDE)
        action: Float[np.ndarray, "2"] = np.clip(place - self.disc, -LONGEST, LONGEST) if self._relative else place
        return action

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Start an episode, a function of the seed and the options alone.

        Raises:
            InvalidSetting: ``options["state"]`` is not five numbers.
        """
        super().reset(seed=seed)
        state = (options or {}).get("state")
        disc, tee = _drawn(self.np_random) if state is None else _given(state)
        self._physics.put(disc, tee)
        self._picture = None
        return self.render(), {"coverage": coverage(tee, GOAL)}

    def step(self, action: Any) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Pull the disc to a place for a tenth of a second.

        ``info["illegal"]`` says that a displacement leads out of the square.

        Raises:
            InvalidSetting: An action has a number outside of its bounds.
        """
        illegal = self.advance(action)
        share = coverage(self.tee, GOAL)
        reward = min(1.0, share / SUCCESS_COVERAGE)
        terminated = self._fixed_goal and share > SUCCESS_COVERAGE
        return self.render(), reward, terminated, False, {"illegal": illegal, "coverage": share}

    def advance(self, action: Any) -> bool:
        """Do as ``step`` does, without drawing; whether the action led out of the square.

        Raises:
            InvalidSetting: An action has a number outside of its bounds.
        """
        values = np.asarray(action, np.float64)
        if fault := self.actions.fault(values[None]):
            raise InvalidSetting(f"{self.facts.id!r} was given {fault}; an action is {self.actions}.")
        x, y = values.tolist()
        if self._relative:
            x, y = self.disc[0] + x, self.disc[1] + y
        target = min(max(x, 0.0), SIDE), min(max(y, 0.0), SIDE)
        self._physics.control(target)
        self._picture = None
        return self._relative and target != (x, y)

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""
        return self._drawn_now()[0].copy()

    def masks(self) -> UInt8[np.ndarray, "h w"]:
        """What each pixel's centre shows: 0 background, the green zone too, 1 the disc, 2 the T."""
        return self._drawn_now()[1].copy()

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """None: there are no discrete actions."""
        return np.zeros(0, np.bool_)

    def agent(self) -> ObjectStates:
        """The disc; z is 0. The T is drawn over it where a wall holds the T against it."""
        return _states(self.disc, 0.0, visible=_visible(self.disc, self.tee))

    def objects(self) -> ObjectStates:
        """The T by the centre of its area; z is 0, nothing hides it, and it turns from x towards y."""
        return _states(self.tee.centre, self.tee.angle, visible=1.0)

    def snapshot(self) -> Snapshot:
        """The present state."""
        return self._physics.snapshot()

    def restore(self, snapshot: Snapshot) -> None:
        """Return to a state exactly: what follows is what followed before, bit by bit."""
        self._physics.restore(snapshot)
        self._picture = None

    def task_measure(self, start: ObjectStates, goal: ObjectStates) -> GoalCoverage:
        """The judged distance by the share of the goal that the T covers."""
        return GoalCoverage(pose_of(start), pose_of(goal))

    def task_goal(self) -> tuple[UInt8[np.ndarray, "h w 3"], ObjectStates] | None:
        """The picture and the T at the fixed goal, the disc below it; None if the goal is a later frame."""
        return (
            (_drawing(GOAL_DISC, GOAL)[0], _states(GOAL.centre, GOAL.angle, visible=1.0)) if self._fixed_goal else None
        )

    def _drawn_now(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        if self._picture is None:
            self._picture = _drawing(self.disc, self.tee)
        return self._picture


def _drawing(disc: Point, tee: Pose) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
    """The picture of a state, and its masks."""
    frame = background().copy()
    masks = np.zeros(frame.shape[:2], np.uint8)
    for one, mask in ((disc_stamp(*disc), MASK_AGENT), (tee_stamp(tee), MASK_FIRST_OBJECT)):
        if one is not None:
            one.lay(frame)
            np.copyto(masks[one.window], mask, where=one.inside)
    return frame, masks


def _states(place: Point, angle: float, *, visible: float) -> ObjectStates:
    position = np.array([[place[0] * MM, place[1] * MM, 0.0]])
    return ObjectStates(
        position=position,
        orientation=np.array([[0.0, 0.0, math.sin(angle / 2), math.cos(angle / 2)]]),
        pixel=SCREEN.project(position[:, :2]),
        visible=np.array([visible]),
    )


def _visible(disc: Point, tee: Pose) -> float:
    """The share of the disc's pixels that the T leaves open."""
    if clearance(tee, *disc) >= DISC_RADIUS:
        return 1.0
    pixel = SIDE / SCREEN.size
    x, y = (np.arange(math.floor((place - DISC_RADIUS) / pixel), (place + DISC_RADIUS) / pixel) for place in disc)
    own = [
        (across, down)
        for across in ((x + 0.5) * pixel).tolist()
        for down in ((y + 0.5) * pixel).tolist()
        if math.dist((across, down), disc) <= DISC_RADIUS
    ]
    return float(np.mean([clearance(tee, *place) > 0 for place in own]))


def _drawn(generator: np.random.Generator) -> tuple[Point, Pose]:
    """A start: the published distribution, drawn again until the T is between the walls and the disc beside it."""
    while True:
        x, y, tee_x, tee_y = (float(generator.uniform(*bounds)) for bounds in (DISC_STARTS,) * 2 + (TEE_STARTS,) * 2)
        tee = Pose(tee_x, tee_y, float(generator.uniform(-math.pi, math.pi)))
        if tee.within(*INSIDE) and clearance(tee, x, y) > DISC_RADIUS:
            return (x, y), tee


def _given(state: Sequence[float]) -> tuple[Point, Pose]:
    numbers = np.asarray(state, np.float64)
    if numbers.shape != (5,) or not np.isfinite(numbers).all():
        raise InvalidSetting(
            f"the state of 'push_t' was given as {state!r}; it takes five numbers: the disc's x and y, the T's x and y "
            "[mm], and the T's angle [rad]."
        )
    x, y, tee_x, tee_y, angle = numbers.tolist()
    return (x, y), Pose(tee_x, tee_y, angle)
