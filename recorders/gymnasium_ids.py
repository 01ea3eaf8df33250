"""The environments' names in Gymnasium: ``gymnasium.make("dmbench/RobotPush-v0")``.

``import dmotion_bench`` calls ``register`` (entry point ``dmbench.gymnasium``). An environment's module is imported
when the environment is made.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

import gymnasium

IDS: Final[Mapping[str, tuple[str, Mapping[str, Any]]]] = {
    "dmbench/GridWorld-v0": ("grid_world:GridWorld", {}),
    "dmbench/GridWorld-v2": ("grid_world:GridWorld", {"version": 2}),
    "dmbench/PlanarPush-v0": ("planar_push:PlanarPush", {}),
    "dmbench/PushT-v0": ("push_t:PushT", {}),
    "dmbench/RobotPush-v0": ("robot_push:RobotPush", {}),
}
"""Each name, where the class is in this package, and what it is built with."""


def register() -> None:
    """Register every environment that is not registered yet."""
    for name, (place, parameters) in IDS.items():
        if name not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=f"{__package__}.{place}", kwargs=dict(parameters))
