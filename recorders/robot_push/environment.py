"""The environment ``robot_push``: the robot pushing of the paper's section 5.1, in PyBullet."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import gymnasium
import numpy as np
from jaxtyping import Bool, Float, UInt8

from dmotion_bench.environment import RecordingPreset
from dmotion_bench.specs import MASK_BACKGROUND, MASK_FIRST_OBJECT, ObjectStates, Preset, Scalar
from recorders.robot_push import panda
from recorders.robot_push.camera import Camera
from recorders.robot_push.distractors import DriftingDiscs
from recorders.robot_push.renderer import ArmLayer, Light, Picture, Renderer, Sprite
from recorders.robot_push.scene import (
    ACTIONS,
    FACTORS,
    LATTICE,
    MOVES,
    SHAPES,
    STEP,
    TABLE_CENTER,
    TABLE_COLOR,
    TABLE_SIZE,
    TABLE_THICKNESS,
    Place,
    facts,
    on_table,
    scatter,
    turned,
)
from recorders.robot_push.solids import SOLIDS, box
from recorders.robot_push.table_physics import ROD_BOTTOM, Body, TablePhysics, load_bullet
from recorders.variation import Variation, named_factors


@lru_cache(maxsize=2)
def _arm_layers(camera: Camera, light: Light) -> dict[Place, ArmLayer]:
    """The arm's layers, shared by all environments of a process: filled as the tip's places are first drawn."""
    return {}


class RobotPush(gymnasium.Env[UInt8[np.ndarray, "h w 3"], Any]):
    """A Panda arm pushes objects over a table with a rod; 128x128 pixels, four directions.

    An action moves the rod's tip by one place of a lattice and lasts until everything is at rest. An object that
    falls off the table is gone, and the episode has terminated; stepping on is allowed.

    Args:
        objects: How many objects there are, 1 to 6; they are red, green, blue, yellow, magenta, cyan.
        shapes: Their shapes in this order, separated by commas; repeated where there are fewer than objects.
        vary: Names of the factors that are drawn anew for each episode, as a list or separated by commas.
        fixed: Factors with other values than usual, in every episode.
        render_mode: Gymnasium's; None or ``"rgb_array"``.

    ``reset``'s options may hold ``"vary"`` and values of factors, which go before the constructor's. The values of an
    episode's factors, where they are not the usual ones, are in ``info["factors"]``; given as options
    together with the seed they make the same episode.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 10}  # noqa: RUF012 -- as in Gymnasium
    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=6, frames=16, tasks=0),
            Preset.SMALL: RecordingPreset(episodes=330, frames=101, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=6000, frames=101, tasks=104),
        }
    )
    default_policy: ClassVar[str] = "push"

    def __init__(
        self,
        *,
        objects: int = 6,
        shapes: str = SHAPES,
        vary: str | Iterable[str] = (),
        fixed: Mapping[str, float] | None = None,
        render_mode: str | None = None,
    ) -> None:
        self.facts = facts(objects, shapes)
        self.render_mode = render_mode
        self._vary, self._fixed = named_factors(vary), dict(fixed or {})
        self._variation = Variation(FACTORS, [one.name for one in self.facts.objects])
        self._variation.check(self._vary, self._fixed)
        self._solids = [SOLIDS[one.shape] for one in self.facts.objects]
        self._physics = TablePhysics(size=TABLE_SIZE, center=TABLE_CENTER)
        meshes = Path(load_bullet("pybullet_data").getDataPath()) / "franka_panda" / "meshes"
        self._arm = panda.surface(meshes)
        self._factors: dict[str, Scalar] = {}
        self._renderer = self._make_renderer(*self._camera_and_light())
        self.action_space = gymnasium.spaces.Discrete(len(ACTIONS))
        self.observation_space = gymnasium.spaces.Box(0, 255, (self.facts.height, self.facts.width, 3), np.uint8)

    @property
    def moves(self) -> Float[np.ndarray, "a 2"]:
        """Where each action takes the tip, along the world's x and y [m]."""
        moves: Float[np.ndarray, "a 2"] = STEP * MOVES
        return moves

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Start an episode, a function of the seed and the options alone."""
        super().reset(seed=seed)
        fixed = {**self._fixed, **(options or {})}
        vary = named_factors(fixed.pop("vary", self._vary))
        entropy = int(self.np_random.integers(2**63))
        self._factors = self._variation.values(entropy, vary, fixed)
        self._time = 0
        self._place = self._build(np.random.default_rng([entropy, 0]))
        self._drifting = DriftingDiscs(np.random.default_rng([entropy, 1]), int(self._factor("distractors")))
        self._colors = [turned(one.color, self._factor("colour", one.name)) for one in self.facts.objects]
        self._renderer = self._renderer_for(*self._camera_and_light())
        self._sprites: list[Sprite | None] = [None] * len(self._solids)
        self._drawn = np.full((len(self._solids), 7), np.nan)
        self._picture = self._draw()
        return self._picture.frame.copy(), {"factors": dict(self._factors)}

    def step(self, action: int) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Move the tip; a move off the lattice changes nothing and ``info["illegal"]`` says so."""
        legal = bool(self.legal_actions()[action])
        if legal:
            x, y = MOVES[action]
            self._place = (self._place[0] + int(x), self._place[1] + int(y))
            self._physics.move(on_table(self._place))
            self._time += 1
            self._picture = self._draw()
        terminated = bool(self._physics.fallen.any())
        return self._picture.frame.copy(), 0.0, terminated, False, {"illegal": not legal}

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""
        return self._picture.frame.copy()

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """Which moves stay on the lattice."""
        reached = np.asarray(self._place) + MOVES
        inside: Bool[np.ndarray, " a"] = ((reached >= 0) & (reached < LATTICE)).all(axis=-1)
        return inside

    def agent(self) -> ObjectStates:
        """The rod's tip; ``visible`` speaks of the arm and the rod together."""
        position = np.array([[*on_table(self._place), ROD_BOTTOM]])
        return ObjectStates(
            position=position,
            orientation=np.array([[0.0, 0.0, 0.0, 1.0]]),
            pixel=self._renderer.camera.project(position)[:, :2],
            visible=np.array([self._picture.agent_visible]),
        )

    def objects(self) -> ObjectStates:
        """The objects; ``pixel`` is the centre of the whole silhouette, the hidden part included."""
        pixel = self._renderer.camera.project(self._physics.positions)[:, :2]
        for index, sprite in enumerate(self._sprites):
            if sprite is not None:
                pixel[index] = sprite.center
        return ObjectStates(
            position=self._physics.positions.copy(),
            orientation=self._physics.quaternions.copy(),
            pixel=pixel,
            visible=self._picture.visible.copy(),
        )

    def masks(self) -> UInt8[np.ndarray, "h w"]:
        """What each pixel's centre shows: 0 background, 1 arm and rod, 2 + k object k."""
        return self._picture.masks.copy()

    def close(self) -> None:
        """Free the simulator."""
        self._physics.close()

    def _factor(self, name: str, of_object: str | None = None) -> float:
        return self._variation.of(self._factors, name, of_object)

    def _build(self, generator: np.random.Generator) -> Place:
        """Put the objects on the table and the rod beside them."""
        spots, place = scatter([solid.radius for solid in self._solids], generator)
        turns = generator.uniform(-np.pi, np.pi, len(self._solids))
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
        self._physics.build(bodies, on_table(place))
        return place

    def _camera_and_light(self) -> tuple[Camera, Light]:
        camera = Camera(yaw=90 + self._factor("camera"))
        azimuth = np.deg2rad(self._factor("light"))
        light = Light(direction=(0.5 * float(np.cos(azimuth)), 0.5 * float(np.sin(azimuth)), 1.2))
        return camera, light

    def _renderer_for(self, camera: Camera, light: Light) -> Renderer:
        if (self._renderer.camera, self._renderer.light) == (camera, light):
            return self._renderer
        return self._make_renderer(camera, light)

    def _make_renderer(self, camera: Camera, light: Light) -> Renderer:
        table = box(*TABLE_SIZE, TABLE_THICKNESS), np.array([*TABLE_CENTER, -TABLE_THICKNESS / 2]), TABLE_COLOR
        return Renderer(camera=camera, light=light, table=table, arm=self._posed_arm, layers=_arm_layers(camera, light))

    def _posed_arm(self, place: Place) -> tuple[Float[np.ndarray, "n 3 3"], Float[np.ndarray, "n 3"]]:
        tip = np.array([*on_table(place), ROD_BOTTOM])
        return self._arm.posed(panda.link_frames(panda.joints_for(tip))), self._arm.colors

    def _draw(self) -> Picture:
        poses = np.concatenate([self._physics.positions, self._physics.quaternions], axis=-1)
        for index in np.flatnonzero((poses != self._drawn).any(axis=-1)):
            gone = self._physics.fallen[index]
            self._sprites[index] = (
                None
                if gone
                else self._renderer.sprite(self._solids[index], poses[index, :3], poses[index, 3:], self._colors[index])
            )
        self._drawn = poses
        sprites = [(sprite, MASK_FIRST_OBJECT + k) for k, sprite in enumerate(self._sprites)]
        sprites += [(sprite, MASK_BACKGROUND) for sprite in self._drifting.sprites(self._renderer, self._time)]
        picture = self._renderer.picture(self._place, sprites)
        return replace(picture, visible=picture.visible[: len(self._solids)])
