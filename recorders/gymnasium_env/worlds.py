"""Gymnasium ids that are known to work, and the packages that register ids.

Nothing is imported here. ``extra`` is what ``pip install 'dmbench[EXTRA]'`` is given.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final


@dataclass(frozen=True, kw_only=True)
class World:
    """An id that is known to work.

    Attributes:
        what: What is seen, in a line.
        extra: Of dmbench, with the packages that it needs.
    """

    what: str
    extra: str


@dataclass(frozen=True, kw_only=True)
class Source:
    """A package that registers ids when it is imported.

    Attributes:
        module: To import.
        package: To install, as a registry of packages names it.
        extra: Of dmbench, if it has one.
    """

    module: str
    package: str
    extra: str | None = None


CLASSIC, BOX2D, MUJOCO, MINIGRID = "gym-classic", "gym-box2d", "gym-mujoco", "gym-minigrid"
ATARI, DM_CONTROL, OGBENCH, METAWORLD = "gym-atari", "gym-dm-control", "gym-ogbench", "gym-metaworld"

WORLDS: Final[Mapping[str, World]] = MappingProxyType(
    {
        "Pendulum-v1": World(what="swing a pendulum up by a torque", extra=CLASSIC),
        "CartPole-v1": World(what="balance a pole on a cart, pushed left or right", extra=CLASSIC),
        "MountainCarContinuous-v0": World(what="drive a weak car out of a valley", extra=CLASSIC),
        "MiniGrid-DoorKey-5x5-v0": World(what="walk over a grid, take a key, open a door", extra=MINIGRID),
        "LunarLander-v3": World(what="land a spacecraft with three engines", extra=BOX2D),
        "CarRacing-v3": World(what="drive a car along a track, seen from above", extra=BOX2D),
        "Reacher-v5": World(what="an arm of two joints reaches for a point", extra=MUJOCO),
        "Pusher-v5": World(what="an arm of seven joints pushes a cylinder to a goal", extra=MUJOCO),
        "ALE/Pong-v5": World(what="Atari's Pong", extra=ATARI),
        "dm_control/cheetah-run-v0": World(what="DeepMind Control's running cheetah", extra=DM_CONTROL),
        "cube-single-v0": World(what="OGBench: a robot arm moves a cube", extra=OGBENCH),
        "Meta-World/MT1": World(
            what="Meta-World: a robot arm; --set env_name=push-v3 --set seed=1 pushes a puck", extra=METAWORLD
        ),
    }
)

SOURCES: Final[Mapping[str, Source]] = MappingProxyType(
    {
        "MiniGrid-": Source(module="minigrid", package="minigrid", extra=MINIGRID),
        "BabyAI-": Source(module="minigrid", package="minigrid", extra=MINIGRID),
        "ALE/": Source(module="ale_py", package="ale-py", extra=ATARI),
        "dm_control/": Source(module="shimmy", package="shimmy", extra=DM_CONTROL),
        "cube-": Source(module="ogbench", package="ogbench", extra=OGBENCH),
        "scene-": Source(module="ogbench", package="ogbench", extra=OGBENCH),
        "puzzle-": Source(module="ogbench", package="ogbench", extra=OGBENCH),
        "pointmaze-": Source(module="ogbench", package="ogbench", extra=OGBENCH),
        "antmaze-": Source(module="ogbench", package="ogbench", extra=OGBENCH),
        "Meta-World/": Source(module="metaworld", package="metaworld", extra=METAWORLD),
    }
)
"""How the ids of a package begin."""

MODULES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "pygame": CLASSIC,
        "Box2D": BOX2D,
        "box2d": BOX2D,
        "mujoco": MUJOCO,
        "imageio": MUJOCO,
        "minigrid": MINIGRID,
        "ale_py": ATARI,
        "dm_control": DM_CONTROL,
        "shimmy": DM_CONTROL,
        "ogbench": OGBENCH,
        "metaworld": METAWORLD,
    }
)
"""The extra that brings a module which turned out to be missing."""

PACKAGES: Final = (
    *("gymnasium", "pygame-ce", "pygame", "Box2D", "mujoco", "minigrid", "ale-py"),
    *("dm-control", "shimmy", "ogbench", "metaworld"),
)
"""What may decide the frames; those that are installed stand in ``dataset.json``."""


def extra_for(name: str) -> str | None:
    """The extra of dmbench that brings an id."""
    if name in WORLDS:
        return WORLDS[name].extra
    return next((source.extra for start, source in SOURCES.items() if name.startswith(start)), None)
