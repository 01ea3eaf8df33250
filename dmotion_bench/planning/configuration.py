"""Everything that decides a plan besides the model and the data, as it stands in a report.

A planner is the name of its class and its fields. A cost is its name and the constants that were tuned for it: those
of the modules that it is made of. They are collected, not listed by hand, so a constant that is added later is in the
report as well.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import asdict, is_dataclass
from types import MappingProxyType, ModuleType
from typing import Any, Final

from dmotion_bench import positions
from dmotion_bench.planning import (
    approaching,
    covering,
    edges,
    exploring,
    following,
    planner,
    table,
    tracking,
)
from dmotion_bench.planning.costs import cost_name
from dmotion_bench.planning.planner import Planner
from dmotion_bench.specs import EnvSpec

SIMULATOR: Final = "simulator"
"""The oracle's own cost: the positions that the simulator knows."""


def constants(module: ModuleType, *names: str) -> dict[str, Any]:
    """The constants (``Final``) of a module as ``module.NAME``, all of them or those that are named."""
    own = [name for name, kind in module.__annotations__.items() if str(kind).startswith("Final")]
    place = module.__name__.rpartition(".")[2]
    return {f"{place}.{name}": _plain(getattr(module, name)) for name in names or own}


_TRACKING: Final = (positions, tracking)
_FOLLOWING: Final = (*_TRACKING, approaching, covering, edges, exploring, following, table)
_CONSTANTS: Final[Mapping[str, Callable[[], dict[str, Any]]]] = MappingProxyType(
    {
        "followed": lambda: _all(*_FOLLOWING),
        "tracked": lambda: _all(*_TRACKING) | constants(following, "LOST"),
        "position": lambda: _all(positions) | constants(following, "LOST"),
    }
)


def planning_configuration(
    chosen: Planner, cost: str | None, spec: EnvSpec, *, needs_pixels: bool | None
) -> dict[str, Any]:
    """The planner and the cost, complete, as JSON's types.

    Args:
        chosen: The planner.
        cost: Of ``costs.COSTS``; None for what suits the model.
        spec: Of the environment.
        needs_pixels: The model's; None for the true simulator in a model's place.
    """
    own_cost = cost is None and needs_pixels is None
    name = SIMULATOR if own_cost else cost_name(cost, spec, needs_pixels=bool(needs_pixels))
    fields: dict[str, Any] = asdict(chosen) if is_dataclass(chosen) else {}
    return {
        "planner": {"class": type(chosen).__name__, **_plain(fields), **constants(planner)},
        "cost": {"name": name, **_CONSTANTS.get(name, dict)()},
    }


def _all(*modules: ModuleType) -> dict[str, Any]:
    return {name: value for module in modules for name, value in constants(module).items()}


def _plain(value: Any) -> Any:
    """A value with lists in place of tuples, as it reads back from JSON."""
    if isinstance(value, Mapping):
        return {str(name): _plain(one) for name, one in value.items()}
    return [_plain(one) for one in value] if isinstance(value, tuple | list) else value
