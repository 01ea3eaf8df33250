"""How much a camera of ``robot_push`` lets the arm hide; run as a program, it compares cameras.

The same recorded moments are drawn by each camera, with the arm and without it. An object counts as hidden where less
than 60% of its silhouette is visible. Where each camera's field of view comes from ``fitting``, the table fills every
picture alike, so that objects have about the same number of pixels.

::

    python -m recorders.robot_push.occlusion --episodes 20
"""

from __future__ import annotations

import argparse
import itertools
import sys
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Float

from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.specs import MASK_FIRST_OBJECT
from recorders.push_policy import PushPolicy
from recorders.robot_push.arm_layer import ArmPose
from recorders.robot_push.camera import Camera
from recorders.robot_push.environment import RobotPush, table_renderer
from recorders.robot_push.light import Light
from recorders.robot_push.scene import TABLE
from recorders.robot_push.solids import SOLIDS
from recorders.table_lattice import Place

VISIBLE: Final = 0.6
"""The share of an object's silhouette from which on it counts as visible."""

MARGIN: Final = 2.0
"""Between the table, with the objects on it, and the border of the picture [px]."""

LIGHT: Final = Light()

PITCHES: Final = (-30.0, -35.0, -40.0, -45.0, -52.0, -60.0, -75.0, -89.0)  # [deg]
DISTANCES: Final = (1.0, 1.5, 2.5, 4.0)  # [m]


class Moment(NamedTuple):
    """Where everything is at a recorded frame.

    Attributes:
        place: Of the tip, on the lattice.
        positions: Of the objects [m].
        orientations: Theirs, x y z w.
    """

    place: Place
    positions: Float[np.ndarray, "k 3"]
    orientations: Float[np.ndarray, "k 4"]


@dataclass(frozen=True, kw_only=True)
class Occlusion:
    """What one camera sees of some moments.

    Attributes:
        hidden: The share of objects of which less than ``VISIBLE`` is visible.
        without_arm: The same if there were no arm: what objects hide of one another.
        pixels: The number of pixels of an object that nothing hides, mean over objects.
        off_picture: The share of objects that lie outside of the picture, wholly or in part.
    """

    hidden: float
    without_arm: float
    pixels: float
    off_picture: float


def moments(episodes: int, frames: int, seed: int = 0) -> list[Moment]:
    """The moments of some episodes of the recording policy.

    Args:
        episodes, frames: How many; each second frame is taken.
        seed: Of the first episode; the others follow.
    """
    env, found = RobotPush(), []
    try:
        for one in range(seed, seed + episodes):
            states = record_episode(env, PushPolicy(), one, frames).labels
            tips = states.agent.position[:, 0, :2]
            for frame in range(0, len(tips), 2):
                place = env.lattice.nearest(tips[frame])
                found.append(Moment(place, states.objects.position[frame], states.objects.orientation[frame]))
    finally:
        env.close()
    return found


def fitting(camera: Camera) -> Camera:
    """The camera with the narrowest field of view in which the whole table lies, with what stands on it."""
    low, high = 5.0, 120.0
    for _ in range(30):
        middle = (low + high) / 2
        seen = replace(camera, field_of_view=middle).project(_corners())[:, :2]
        fits = seen.min() >= MARGIN and seen.max() <= camera.size - 1 - MARGIN
        low, high = (low, middle) if fits else (middle, high)
    return replace(camera, field_of_view=round(high, 1) + 0.1)


def _corners() -> Float[np.ndarray, "n 3"]:
    """Of the space above the table that objects take."""
    reach = [(-side / 2, side / 2) for side in TABLE.size]
    height = max(solid.height for solid in SOLIDS.values())
    middle = TABLE.center
    return np.array([(middle[0] + x, middle[1] + y, z) for x, y in itertools.product(*reach) for z in (0, height)])


def occlusion(camera: Camera, seen: Iterable[Moment]) -> Occlusion:
    """What a camera sees of some moments.

    Args:
        camera: Where it stands.
        seen: The moments.
    """
    arm, none = (table_renderer(camera, LIGHT, pose, {}) for pose in (_arm(), _no_arm))
    solids = list(SOLIDS.values())
    with_arm, without, pixels, cut = [], [], [], []
    for moment in seen:
        standing = [index for index, position in enumerate(moment.positions) if np.isfinite(position[0])]
        sprites = [
            arm.sprite(solids[k], moment.positions[k], moment.orientations[k], (0.5, 0.5, 0.5), MASK_FIRST_OBJECT + k)
            for k in standing
        ]
        with_arm.append(arm.picture(moment.place, sprites).visible)
        without.append(none.picture(moment.place, sprites).visible)
        pixels += [one.count / 9 for one in sprites if one is not None]
        cut += [_is_cut(camera, sprite.window) if sprite else True for sprite in sprites]
    return Occlusion(
        hidden=float((np.concatenate(with_arm) < VISIBLE).mean()),
        without_arm=float((np.concatenate(without) < VISIBLE).mean()),
        pixels=float(np.mean(pixels)),
        off_picture=float(np.mean(cut)),
    )


def _is_cut(camera: Camera, window: tuple[slice, slice]) -> bool:
    """Whether a sprite reaches the border of the picture."""
    return any(side.start == 0 or side.stop == camera.size for side in window)


@lru_cache(maxsize=1)
def _arm() -> Callable[[Place], ArmPose]:
    """The arm's poses, each computed once for all cameras."""
    env = RobotPush()
    env.close()
    return lru_cache(maxsize=None)(env.posed_arm)


def _no_arm(place: Place) -> ArmPose:
    return ArmPose(np.zeros((0, 3, 3)), np.zeros((0, 3)), np.zeros(0, np.bool_))


def main(arguments: Sequence[str] | None = None) -> None:
    """Print what each camera of the grid sees, those that hide least first."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=20, help="Episodes of the recording policy.")
    parser.add_argument("--frames", type=int, default=60, help="Frames of each, at most.")
    parser.add_argument("--pitch", type=float, nargs="*", default=PITCHES, help="[deg]")
    parser.add_argument("--distance", type=float, nargs="*", default=DISTANCES, help="[m]")
    parser.add_argument("--yaw", type=float, nargs="*", default=(90.0,), help="[deg]; 90 looks toward the base.")
    parser.add_argument(
        "--field-of-view", type=float, nargs="*", default=(), help="[deg] Default: as the table needs it."
    )
    asked = parser.parse_args(arguments)
    seen = moments(asked.episodes, asked.frames)
    cameras = [Camera()]
    for yaw, pitch, distance in itertools.product(asked.yaw, asked.pitch, asked.distance):
        camera = Camera(yaw=yaw, pitch=pitch, distance=distance)
        cameras += [replace(camera, field_of_view=one) for one in asked.field_of_view] or [fitting(camera)]
    found = [(camera, occlusion(camera, seen)) for camera in cameras]
    lines = [f"{len(seen)} moments; the first camera is the present one", ""]
    lines.append(
        "| yaw [deg] | pitch [deg] | distance [m] | field of view [deg] | hidden | without arm | pixels | cut |"
    )
    lines.append("|---|---|---|---|---|---|---|---|")
    for camera, one in found[:1] + sorted(found[1:], key=lambda pair: pair[1].hidden):
        lines.append(
            f"| {camera.yaw:.0f} | {camera.pitch:.0f} | {camera.distance} | {camera.field_of_view:.1f} "
            f"| {one.hidden:.1%} | {one.without_arm:.1%} | {one.pixels:.0f} | {one.off_picture:.1%} |"
        )
    sys.stdout.write("\n".join([*lines, ""]))


if __name__ == "__main__":
    main()
