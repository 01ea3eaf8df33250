"""The environment ``planar_push``: pushing seen from straight above, the fast step between the paper's two.

Nothing hides anything and light changes no colour, so that what ``robot_push`` adds (perspective, shading, an arm in
the way) can be told from what pushing alone asks of a model.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from types import MappingProxyType
from typing import Any, ClassVar, Literal

import numpy as np
from jaxtyping import Float, UInt8

from dmotion_bench.environment import RecordingPreset
from dmotion_bench.specs import MASK_AGENT, MASK_FIRST_OBJECT, EnvSpec, ObjectSpec, ObjectStates, Preset
from recorders.distractors import FACTORS as VIDEO_FACTORS
from recorders.distractors import SceneName, make_scene
from recorders.planar_push.drawing import Stamp, View, stamp
from recorders.planar_push.shapes import SHAPES, circle, rectangle
from recorders.planar_push.table_physics import Piece, PlanarPhysics, Pose
from recorders.pushing import PushingEnvironment, Snapshot, pushing_actions
from recorders.table_lattice import KEPT_PLACES, Lattice, Place, TableTop
from recorders.table_things import Drift, colored_objects
from recorders.variation import Factor, explained

TABLE = TableTop(size=(0.52, 0.52), center=(0.0, 0.0), edge_gap=0.03, gap=0.012)
LATTICE = Lattice(
    places=(13, 13),
    origin=(-0.24, -0.24),
    step=0.04,  # 8 pixels
    moves=((0, 1), (0, -1), (-1, 0), (1, 0)),
)
DISC = circle(0.025)
DRIFTING, DRIFT_SPEED = circle(0.03), 0.02  # distractors: [m], [m] a step
TABLE_COLOR, FLOOR_COLOR = (214, 196, 168), (236, 239, 243)
DISC_COLOR, DRIFTING_COLOR = (35, 35, 40), (150, 150, 150)

FACTORS = (  # colours stay near enough to be found by them, under every light
    Factor(
        name="friction",
        usual=0.5,
        low=0.25,
        high=0.9,
        shifted=((0.1, 0.2), (1.0, 1.2)),
        each=True,
        meaning="an object's friction on the table",
    ),
    Factor(
        name="mass",
        usual=0.15,
        low=0.05,
        high=0.6,
        shifted=((0.02, 0.04), (0.7, 1.0)),
        each=True,
        meaning="an object's mass [kg]",
    ),
    Factor(
        name="colour",
        usual=0,
        low=-8,
        high=8,
        shifted=((-11, -9), (9, 11)),
        each=True,
        meaning="turn of an object's hue [deg]",
    ),
    Factor(
        name="light",
        usual=1,
        low=0.94,
        high=1.06,
        shifted=((0.88, 0.92), (1.08, 1.12)),
        meaning="brightness of the whole picture",
    ),
    Factor(
        name="camera",
        usual=0,
        low=-6,
        high=6,
        shifted=((-12, -8), (8, 12)),
        meaning="turn of the camera about its axis [deg]",
    ),
    Factor(
        name="distractors",
        usual=0,
        low=0,
        high=3,
        shifted=((4, 6),),
        whole=True,
        meaning="number of grey discs that drift over the table and touch nothing",
    ),
    *VIDEO_FACTORS,
)


class PlanarPush(PushingEnvironment):
    """A dark disc pushes flat shapes over a table; 128x128 pixels of 5 mm, up to 8 pixels a step.

    Args:
        objects: How many objects there are, 1 to 6; they are red, green, blue, yellow, magenta, cyan.
        shapes: Their shapes in this order, separated by commas; repeated where there are fewer than objects.
        actions: ``"discrete"``: the four directions; ``"continuous"``: a displacement (dx, dy) of the tip along the
            world's x and y, each up to one step [m].
        vary: Names of the factors that are drawn anew for each episode, as a list or separated by commas.
        ranges: What they are drawn from: ``"in-distribution"``, or ``"shifted"``: only values outside of that.
        friction, mass, colour, light, camera, distractors: Values of these factors, the same in every episode;
            None: the usual ones.
        scene: Which of the ready scenes: ``"clean"``, ``"distracted"``, ``"unseen"``; see ``recorders.distractors``.
        background, movers, correlated, shake, noise, delay: Values of these factors; None: the scene's.
        textures: Generators of the background, separated by commas; None: the scene's.
        clips: The hash of prepared clips, which are the background in place of textures; ``prepared`` makes it.
        render_mode: Gymnasium's; None or ``"rgb_array"``.
    """

    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=6, frames=16, tasks=0),
            Preset.SMALL: RecordingPreset(episodes=400, frames=101, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=6000, frames=101, tasks=104),
        }
    )
    factors: ClassVar[Mapping[str, str]] = explained(FACTORS)
    test_tasks: ClassVar[Mapping[int, Mapping[str, str]]] = MappingProxyType(
        {
            1: {
                "": "ebbab843f19a4e4117cdad4346ea5f0d68c2fe9eb1aff1755803871a4bd532e2",
                "actions=continuous": "0f35654ff8d4a1382b43eb069588d4e4761860c21489449f6dc6953862863028",
            }
        }
    )

    def __init__(
        self,
        *,
        objects: int = 6,
        shapes: str = ",".join(SHAPES),
        actions: Literal["discrete", "continuous"] = "discrete",
        vary: str | Iterable[str] = (),
        ranges: str = "in-distribution",
        friction: float | None = None,
        mass: float | None = None,
        colour: float | None = None,
        light: float | None = None,
        camera: float | None = None,
        distractors: int | None = None,
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
        super().__init__(
            facts=EnvSpec(
                id="planar_push",
                actions=pushing_actions(actions, LATTICE),
                agent=ObjectSpec(name="disc", shape="circle", color=DISC_COLOR),
                objects=colored_objects(objects, shapes, SHAPES),
                agent_has_color=True,
                push_threshold=3e-3,
            ),
            factors=FACTORS,
            lattice=LATTICE,
            vary=vary,
            ranges=ranges,
            fixed={
                "friction": friction,
                "mass": mass,
                "colour": colour,
                "light": light,
                "camera": camera,
                "distractors": distractors,
                "background": background,
                "movers": movers,
                "correlated": correlated,
                "shake": shake,
                "noise": noise,
                "delay": delay,
            },
            scene=make_scene(scene, textures, clips),
            render_mode=render_mode,
        )
        self._shapes = [SHAPES[one.shape] for one in self.facts.objects]
        self._physics = PlanarPhysics(size=TABLE.size, disc=DISC.radius)
        self._look: tuple[float, float] | None = None
        self._object_states: ObjectStates | None = None

    def _agent(self) -> ObjectStates:
        """The disc."""
        if self._place not in self._agents:
            _make_room(self._agents)
            place = np.array([self.lattice.at(self._place)])
            self._agents[self._place] = self._states(place, np.zeros(1))
        return self._agents[self._place]

    def _objects(self) -> ObjectStates:
        """The shapes; z is 0, and nothing hides anything."""
        if self._object_states is None:
            self._object_states = self._states(self._physics.positions, self._physics.angles)
        return self._object_states

    def _states(self, places: Float[np.ndarray, "k 2"], angles: Float[np.ndarray, " k"]) -> ObjectStates:
        nothing, half = 0 * angles, angles / 2  # NaN for one that is gone
        position, orientation = np.empty((len(angles), 3)), np.empty((len(angles), 4))
        position[:, :2], position[:, 2] = places, nothing
        orientation[:, 0] = orientation[:, 1] = nothing
        orientation[:, 2], orientation[:, 3] = np.sin(half), np.cos(half)
        return ObjectStates(
            position=position,
            orientation=orientation,
            pixel=self._view.project(places),
            visible=(~np.isnan(angles)).astype(np.float64),
        )

    def _begin(self, placement: np.random.Generator, distraction: np.random.Generator) -> Place:
        spots, place = TABLE.scatter(
            [shape.radius for shape in self._shapes], pusher=DISC.radius, lattice=self.lattice, generator=placement
        )
        turns = placement.uniform(-np.pi, np.pi, len(self._shapes))
        pieces = [
            Piece(
                shape=shape,
                mass=self._factor("mass", one.name),
                friction=self._factor("friction", one.name),
                position=(float(x), float(y)),
                angle=float(turn),
            )
            for one, shape, (x, y), turn in zip(self.facts.objects, self._shapes, spots, turns, strict=True)
        ]
        self._physics.build(pieces, self.lattice.at(place))
        reach = TABLE.size[0] / 2 - DRIFTING.radius
        self._drift = Drift(distraction, int(self._factor("distractors")), reach=(reach, reach), speed=DRIFT_SPEED)
        self._colors = [self._lit([255 * channel for channel in self._color(one)]) for one in self.facts.objects]
        look = (self._factor("camera"), self._factor("light"))
        if look != self._look:
            self._look = look
            self._view = View(size=self.facts.height, turn=look[0])
            self._table = self._empty_table()
            self._discs: dict[Place, Stamp | None] = {}
            self._agents: dict[Place, ObjectStates] = {}
        self._object_states = None
        self._drawn: list[Pose | None] = [None] * len(self._shapes)
        self._stamps: list[Stamp | None] = [None] * len(self._shapes)
        self._still: tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]] | None = None
        return place

    def _push(self, goal: tuple[float, float]) -> None:
        if self._physics.move(goal):
            self._object_states = None

    def _put(self, snapshot: Snapshot, pusher: tuple[float, float]) -> None:
        angles = 2 * np.arctan2(snapshot.orientations[:, 2], snapshot.orientations[:, 3])
        self._physics.restore(snapshot.positions[:, :2], angles, pusher)
        self._object_states = None

    def _terminated(self) -> bool:
        return bool(self._physics.fallen.any())

    def _draw(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        poses = self._physics.poses
        if self._still is None or poses != self._drawn or self._factor("distractors"):
            for index, (pose, drawn) in enumerate(zip(poses, self._drawn, strict=True)):
                if pose != drawn:
                    self._stamps[index] = None if pose is None else self._stamp_of(index, pose)
            self._drawn = poses
            self._still = self._draw_objects()
        frame, masks = self._still[0].copy(), self._still[1].copy()
        if self._place not in self._discs:
            _make_room(self._discs)
            place = np.asarray(self.lattice.at(self._place))
            self._discs[self._place] = stamp(self._view, DISC, place, 0.0, self._lit(DISC_COLOR))
        disc = self._discs[self._place]
        if disc is not None:
            disc.lay(frame)
            np.copyto(masks[disc.window], MASK_AGENT, where=disc.inside)
        return frame, masks

    def _draw_objects(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        frame, masks = self._table.copy(), np.zeros(self._table.shape[:2], np.uint8)
        for place in self._drift.places(self._moment):
            drifting = stamp(self._view, DRIFTING, place, 0.0, self._lit(DRIFTING_COLOR))
            if drifting is not None:
                drifting.lay(frame)
        for index, one in enumerate(self._stamps):
            if one is not None:
                one.lay(frame)
                np.copyto(masks[one.window], MASK_FIRST_OBJECT + index, where=one.inside)
        return frame, masks

    def _stamp_of(self, index: int, pose: Pose) -> Stamp | None:
        return stamp(self._view, self._shapes[index], np.array(pose[:2]), pose[2], self._colors[index])

    def _projected(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        return self._view.project(places)

    def _surroundings(self) -> tuple[int, int, int]:
        red, green, blue = self._lit(FLOOR_COLOR)
        return int(red), int(green), int(blue)

    def _empty_table(self) -> UInt8[np.ndarray, "h w 3"]:
        frame = np.empty((self.facts.height, self.facts.width, 3), np.uint8)
        frame[:] = np.asarray(self._lit(FLOOR_COLOR), np.uint8)
        table = stamp(self._view, rectangle(*TABLE.size), np.zeros(2), 0.0, self._lit(TABLE_COLOR))
        if table is not None:
            table.lay(frame)
        return frame

    def _lit(self, color: Sequence[float]) -> tuple[float, float, float]:
        """A colour (RGB, 0-255) under this episode's light."""
        red, green, blue = np.rint(np.clip(self._factor("light") * np.asarray(color), 0, 255))
        return float(red), float(green), float(blue)


def _make_room(kept: dict[Place, Any]) -> None:
    """Forget what is kept of places once there are many, as with continuous actions."""
    if len(kept) >= KEPT_PLACES:
        kept.clear()
