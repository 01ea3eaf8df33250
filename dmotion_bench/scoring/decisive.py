"""The settings that decide a group of figures besides the weights and the data: figures of others say nothing together.

The leaderboard averages and compares only figures that were measured with the same ones, and so does a comparison of
two runs. Such a comparison pairs single tasks and moments, so it does not ask how many of them there are.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final

from dmotion_bench.scoring.earlier_planning import present_settings
from dmotion_bench.scoring.samples import CONTROL, GAIN, PICTURE_CONTROL

PLANNING: Final = ("planner", "planner_set", "objective", "objective_set", "tasks", "steps", "seed")
"""Those of control, without its version."""

GAINED: Final = f"{GAIN}_"
"""How the names of the settings begin that decide the gain captured."""

_EXTENT: Final = (f"{CONTROL}_tasks", f"{CONTROL}_steps", f"{GAIN}_moments")
"""How much was done; what was done does not depend on them."""


def planning_settings(settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of control, by their names in a report of today; those that are not there are None."""
    present = present_settings(settings)
    return {f"{CONTROL}_{name}": present.get(f"{CONTROL}_{name}") for name in PLANNING}


def sample_settings(metric: str, settings: Mapping[str, Any]) -> dict[str, Any]:
    """The settings of a report that decide its samples of a metric, whatever tasks or moments there are.

    Args:
        metric: As ``samples.parquet`` names it.
        settings: Of the report.
    """
    if metric in (CONTROL, PICTURE_CONTROL):
        version = f"{CONTROL}_version"
        found = {version: settings.get(version)} | planning_settings(settings)
    elif metric == GAIN:
        found = {name: value for name, value in settings.items() if name.startswith(GAINED)}
    else:
        found = {"precision": settings.get("precision")}
    return {name: value for name, value in found.items() if name not in _EXTENT}
