"""Solvers and objectives by their names, with every field settable, and as they stand in a report."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from types import MappingProxyType, ModuleType
from typing import Any, Final

from dmotion_bench import positions
from dmotion_bench.environment import HasObjective
from dmotion_bench.errors import DmbenchError
from dmotion_bench.learning.settings import to_json, with_settings
from dmotion_bench.planning.objectives.base import Objective
from dmotion_bench.planning.solvers.base import Solver
from dmotion_bench.registry import environment_class, objective_class, solver_class
from dmotion_bench.specs import EnvSpec
from dmotion_bench.values import is_frozen_dataclass

DEFAULT_SOLVER: Final = "cem"


SIMULATOR: Final = "simulator"
"""The name of the oracle's own objective, ``TrueCost``."""

EARLIER_NAMES: Final[Mapping[str, str]] = MappingProxyType({"position": "centres", "followed": "tabletop"})
"""Objectives that had another name; it is accepted still."""


def make_solver(name: str, settings: Sequence[str] = ()) -> Solver:
    """A solver by its name.

    Args:
        name: Registered under ``dmbench.solvers``.
        settings: ``KEY=VALUE`` for fields that differ from their defaults.

    Raises:
        UnknownName: There is none of this name.
        InvalidSetting: It has no such field, or the field cannot have this value.
    """
    solver: Solver = _made(solver_class(name), name, settings, "--planner-set")
    return solver


def make_objective(name: str, settings: Sequence[str] = ()) -> Objective:
    """An objective by its name, present or earlier; arguments and errors as in ``make_solver``."""
    name = present_name(name)
    objective: Objective = _made(objective_class(name), name, settings, "--objective-set")
    return objective


def present_name(objective: str) -> str:
    """The present name of an objective."""
    return EARLIER_NAMES.get(objective, objective)


def _made(kind: type[Any], name: str, settings: Sequence[str], option: str) -> Any:
    if not is_frozen_dataclass(kind):
        raise DmbenchError(
            f"{name!r} is registered as {kind.__qualname__}, which is no frozen dataclass; write "
            "@dataclass(frozen=True, kw_only=True) above it."
        )
    try:
        made = kind()
    except TypeError as error:
        raise DmbenchError(f"{name!r} cannot be made without settings ({error}); give each field a default.") from None
    return with_settings(settings, made, option=option)[0] if settings else made


def default_objective(environment: str, spec: EnvSpec, *, needs_pixels: bool) -> str:
    """The name of the objective that control plans with if nobody names one.

    Models that draw no frames compare features. Others plan with what the environment names (``HasObjective``), which
    is the paper's where it names none; with features, too, if that looks for objects and there are none.

    Args:
        environment: Its registered name.
        spec: Its facts.
        needs_pixels: The model's.
    """
    if not needs_pixels:
        return "feature"
    kind: object = environment_class(environment)
    name = kind.objective if isinstance(kind, HasObjective) else "centres"
    if not spec.objects and getattr(objective_class(name), "finds_objects", False):
        return "feature"
    return name


def generic_objective(spec: EnvSpec, *, needs_pixels: bool, for_objects: str = "tracked") -> str:
    """The name of an objective that knows nothing of the scene, the same for every environment and model of a kind.

    Features for models that draw no frames; else the objects' centres, each hidden object where it was last seen; where
    there are no objects to find, the pictures.

    Args:
        spec: The environment's facts.
        needs_pixels: The model's.
        for_objects: The objective where there are objects.
    """
    if not needs_pixels:
        return "feature"
    return for_objects if spec.objects else "pixel"


def planning_configuration(
    solver_name: str, solver: Solver, objective_name: str, objective: Objective
) -> dict[str, Any]:
    """A solver and an objective, complete, as JSON's types.

    Args:
        solver_name, solver: The solver.
        objective_name, objective: The objective.
    """
    return {
        "solver": {"name": solver_name, **to_json(solver)},
        "objective": objective_configuration(objective_name, objective),
    }


def objective_configuration(name: str, objective: Objective) -> dict[str, Any]:
    """An objective, complete, as JSON's types."""
    found = constants(positions) if getattr(objective, "finds_objects", False) else {}
    return {"name": name, **to_json(objective), **found}


def constants(module: ModuleType) -> dict[str, Any]:
    """The constants (``Final``) of a module as ``module.NAME``."""
    own = [name for name, kind in module.__annotations__.items() if str(kind).startswith("Final")]
    place = module.__name__.rpartition(".")[2]
    plain: dict[str, Any] = json.loads(json.dumps({f"{place}.{name}": getattr(module, name) for name in own}))
    return plain
