"""Which figures a data set cannot have, because its environment does not tell what they need.

What a data set holds of positions and masks decides; ``environment.py`` has the tiers.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from types import MappingProxyType
from typing import Final

from dmotion_bench.environment import Tier, tier_of
from dmotion_bench.errors import DmbenchError
from dmotion_bench.registry import environment_class, is_environment
from dmotion_bench.scoring.samples import POSITION_COLUMNS
from dmotion_bench.specs import DatasetRecipe, EnvSpec

NEEDED: Final = MappingProxyType(
    {
        Tier.OBJECTS: (*POSITION_COLUMNS, "motion_shift_error", "control_distance", "control_success", "control_lost"),
        Tier.MASKS: ("agent_iou",),
    }
)
"""The figures that need each tier; all others need pixels and actions alone."""

_MISSING: Final = MappingProxyType({Tier.OBJECTS: "the positions of objects", Tier.MASKS: "masks of the agent"})


def tier_of_data(spec: EnvSpec, recipe: DatasetRecipe) -> Tier:
    """What the labels of a data set tell."""
    if not spec.objects and not spec.agent_has_color:
        return Tier.PIXELS
    if not is_environment(recipe.environment):
        return Tier.MASKS  # recorded elsewhere by an environment of its own
    try:
        return tier_of(environment_class(recipe.environment))
    except DmbenchError:
        return Tier.MASKS


def refused(spec: EnvSpec, recipe: DatasetRecipe, metrics: Sequence[str], figures: Collection[str]) -> str:
    """The figures that are left out, by name, and what they would need; empty if none is.

    Args:
        spec, recipe: Of the data set.
        metrics: The groups of figures that were asked for.
        figures: Those that there are, such as the distances of an environment that judges its tasks itself.
    """
    tiers = list(Tier)
    lacking = tiers[tiers.index(tier_of_data(spec, recipe)) + 1 :]
    there = {name.partition("[")[0] for name in figures}
    parts = []
    for tier in lacking:
        asked = [name for name in NEEDED[tier] if "control" in metrics or not name.startswith("control_")]
        parts.append(f"{', '.join(name for name in asked if name not in there)} would need {_MISSING[tier]}")
    return "; ".join(parts)
