"""The environment ``robot_push``: the robot pushing of the paper's section 5.1, in PyBullet.

Physics and drawing cost about as much. ``dmbench bench`` measures the frames per second on a given machine.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import ClassVar, Literal

import numpy as np
from jaxtyping import Float, UInt8

from dmotion_bench.specs import MASK_BACKGROUND, MASK_FIRST_OBJECT, EnvSpec, ObjectSpec, ObjectStates
from recorders.distractors import SceneName, make_scene
from recorders.pushing import PushingEnvironment, Snapshot, pushing_actions
from recorders.robot_push import panda
from recorders.robot_push.arm_layer import ArmLayer, ArmPose
from recorders.robot_push.camera import Camera
from recorders.robot_push.light import Light
from recorders.robot_push.renderer import BACKGROUND, Picture, Renderer
from recorders.robot_push.scene import (
    DISC_COLOR,
    DISC_RADIUS,
    DISC_SPEED,
    FACTORS,
    LATTICE,
    TABLE,
    TABLE_COLOR,
    TABLE_THICKNESS,
)
from recorders.robot_push.solids import SOLIDS, box, prism
from recorders.robot_push.sprite import Sprite
from recorders.robot_push.table_physics import ROD_BOTTOM, Body, TablePhysics, load_bullet
from recorders.table_lattice import Place
from recorders.table_things import Drift, colored_objects
from recorders.variation import explained

UPRIGHT = np.array([0.0, 0.0, 0.0, 1.0])
DISC = prism(24, DISC_RADIUS, 0.002)


@lru_cache(maxsize=2)
def _arm_layers(camera: Camera, light: Light) -> dict[Place, ArmLayer]:
    """The arm's layers, shared by all environments of a process: filled as the tip's places are first drawn."""
    return {}


class RobotPush(PushingEnvironment):
    """A Panda arm pushes objects over a table with a rod; 128x128 pixels.

    Args:
        objects: How many objects there are, 1 to 6; they are red, green, blue, yellow, magenta, cyan.
        shapes: Their shapes in this order, separated by commas; repeated where there are fewer than objects.
        actions: ``"discrete"``: the four directions; ``"continuous"``: a displacement (dx, dy) of the tip along the
            world's x and y, each up to one step [m].
        vary: Names of the factors that are drawn anew for each episode, as a list or separated by commas.
        ranges: What they are drawn from: ``"in-distribution"``, or ``"shifted"``: only values outside of that.
        pitch, distance, field_of_view: Of the camera, as ``Camera`` has them [deg, m, deg]; None: the version's.
        friction, mass, colour, light, camera, distractors: Values of these factors, the same in every episode;
            None: the usual ones, those of the paper's scene.
        scene: Which of the ready scenes: ``"clean"``, ``"distracted"``, ``"unseen"``; see ``recorders.distractors``.
        background, movers, correlated, shake, noise, delay: Values of these factors; None: the scene's.
        textures: Generators of the background, separated by commas; None: the scene's.
        clips: The hash of prepared clips, which are the background in place of textures; ``prepared`` makes it.
        render_mode: Gymnasium's; None or ``"rgb_array"``.

    Raises:
        PackageNotInstalled: There is no PyBullet here.
    """

    factors: ClassVar[Mapping[str, str]] = explained(FACTORS)
    test_tasks: ClassVar[Mapping[int, Mapping[str, str]]] = MappingProxyType(
        {1: {"": "6ab3bdfdc0ed182a33c17013ea1426439e2b4962a536e860160fcf0da8a42f7a"}}
    )
    objective: ClassVar[str] = "tabletop"

    def __init__(
        self,
        *,
        objects: int = 6,
        shapes: str = ",".join(SOLIDS),
        actions: Literal["discrete", "continuous"] = "discrete",
        vary: str | Iterable[str] = (),
        ranges: str = "in-distribution",
        pitch: float | None = None,
        distance: float | None = None,
        field_of_view: float | None = None,
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
        usual = Camera()
        self._camera = Camera(
            pitch=usual.pitch if pitch is None else pitch,
            distance=usual.distance if distance is None else distance,
            field_of_view=usual.field_of_view if field_of_view is None else field_of_view,
        )
        super().__init__(
            facts=EnvSpec(
                id="robot_push",
                actions=pushing_actions(actions, LATTICE),
                agent=ObjectSpec(name="arm", shape="Panda arm with a rod", color=(228, 231, 234)),
                objects=colored_objects(objects, shapes, SOLIDS),
                shaded=True,
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
        self._solids = [SOLIDS[one.shape] for one in self.facts.objects]
        self._physics = TablePhysics(size=TABLE.size, center=TABLE.center)
        self._arm = panda.surface(Path(load_bullet("pybullet_data").getDataPath()) / "franka_panda" / "meshes")
        self._renderer = self._make_renderer(*self._camera_and_light())

    def _agent(self) -> ObjectStates:
        """The rod's tip; ``visible`` speaks of arm and rod. The base, which never moves, is background."""
        position = np.array([[*self.lattice.at(self._place), ROD_BOTTOM]])
        return ObjectStates(
            position=position,
            orientation=UPRIGHT[None],
            pixel=self._renderer.camera.project(position)[:, :2],
            visible=np.array([self._picture.agent_visible]),
        )

    def _objects(self) -> ObjectStates:
        """The objects; ``pixel`` is the centre of the whole silhouette, the hidden part included."""
        pixel = self._renderer.camera.project(self._physics.positions)[:, :2]
        for index, sprite in enumerate(self._sprites):
            if sprite is not None:
                pixel[index] = sprite.center
        return ObjectStates(
            position=self._physics.positions,
            orientation=self._physics.quaternions,
            pixel=pixel,
            visible=self._picture.visible,
        )

    def close(self) -> None:
        """Free the simulator."""
        self._physics.close()

    def _begin(self, placement: np.random.Generator, distraction: np.random.Generator) -> Place:
        spots, place = TABLE.scatter(
            [solid.radius for solid in self._solids],
            pusher=panda.ROD_RADIUS,
            lattice=self.lattice,
            generator=placement,
        )
        turns = placement.uniform(-np.pi, np.pi, len(self._solids))
        bodies = [
            Body(
                solid=solid,
                mass=self._factor("mass", one.name),
                friction=self._factor("friction", one.name),
                position=(float(x), float(y)),
                yaw=float(yaw),
            )
            for one, solid, (x, y), yaw in zip(self.facts.objects, self._solids, spots, turns, strict=True)
        ]
        self._physics.build(bodies, self.lattice.at(place))
        self._drift = Drift(
            distraction,
            int(self._factor("distractors")),
            reach=(TABLE.size[0] / 2 - DISC_RADIUS, TABLE.size[1] / 2 - DISC_RADIUS),
            speed=DISC_SPEED,
        )
        self._colors = [self._color(one) for one in self.facts.objects]
        camera, light = self._camera_and_light()
        if (self._renderer.camera, self._renderer.light) != (camera, light):
            self._renderer = self._make_renderer(camera, light)
        self._sprites: list[Sprite | None] = [None] * len(self._solids)
        self._drawn = np.full((len(self._solids), 7), np.nan)
        return place

    def _push(self, goal: tuple[float, float]) -> None:
        self._physics.move(goal)

    def _put(self, snapshot: Snapshot, pusher: tuple[float, float]) -> None:
        self._physics.restore(snapshot.positions, snapshot.orientations, pusher)

    def _terminated(self) -> bool:
        return bool(self._physics.fallen.any())

    def _draw(self) -> tuple[UInt8[np.ndarray, "h w 3"], UInt8[np.ndarray, "h w"]]:
        poses = np.concatenate([self._physics.positions, self._physics.quaternions], axis=-1)
        for index in np.flatnonzero((poses != self._drawn).any(axis=-1)):
            self._sprites[index] = self._sprite(int(index), poses[index])
        self._drawn = poses
        discs = [
            self._renderer.sprite(DISC, np.array([x, y, 0.0]), UPRIGHT, DISC_COLOR, MASK_BACKGROUND)
            for x, y in self._drift.places(self._moment) + TABLE.center
        ]
        self._picture: Picture = self._renderer.picture(self._place, self._sprites, discs)
        return self._picture.frame, self._picture.masks

    def _sprite(self, index: int, pose: Float[np.ndarray, "7"]) -> Sprite | None:
        if self._physics.fallen[index]:
            return None
        label = MASK_FIRST_OBJECT + index
        return self._renderer.sprite(self._solids[index], pose[:3], pose[3:], self._colors[index], label)

    def _projected(self, places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
        tips = np.concatenate([places, np.full((len(places), 1), ROD_BOTTOM)], axis=1)
        return self._renderer.camera.project(tips)[:, :2]

    def _surroundings(self) -> tuple[int, int, int]:
        return BACKGROUND

    def _camera_and_light(self) -> tuple[Camera, Light]:
        azimuth = np.deg2rad(self._factor("light"))
        light = Light(direction=(0.5 * float(np.cos(azimuth)), 0.5 * float(np.sin(azimuth)), 1.2))
        return replace(self._camera, yaw=90 + self._factor("camera"), size=self.facts.height), light

    def _make_renderer(self, camera: Camera, light: Light) -> Renderer:
        return table_renderer(camera, light, self.posed_arm, _arm_layers(camera, light))

    def posed_arm(self, place: Place) -> ArmPose:
        """The arm with its tip at a place of the lattice."""
        tip = np.array([*self.lattice.at(place), ROD_BOTTOM])
        frames = panda.link_frames(panda.joints_for(tip))
        return ArmPose(self._arm.posed(frames), self._arm.colors, self._arm.links > 0)


def table_renderer(
    camera: Camera, light: Light, arm: Callable[[Place], ArmPose], layers: dict[Place, ArmLayer]
) -> Renderer:
    """A renderer of the table; arguments as of ``Renderer``."""
    table = box(*TABLE.size, TABLE_THICKNESS), np.array([*TABLE.center, -TABLE_THICKNESS / 2]), TABLE_COLOR
    return Renderer(camera=camera, light=light, table=table, arm=arm, layers=layers)
