"""Registered environments, models, objectives, solvers, speeds and tables: names and what they are, by entry points.

``FAMILY:MEMBER`` names an environment of a family, which decides itself what its members are.
"""

from __future__ import annotations

import contextlib
import difflib
from collections.abc import Callable, Iterable, Mapping
from typing import TYPE_CHECKING, Any, Final

from dmotion_bench.entry_points import (
    ENVIRONMENTS,
    FAMILIES,
    LEADERBOARD,
    LISTED,
    MODELS,
    OBJECTIVES,
    SOLVERS,
    SPEEDS,
    TABLES,
    add,
    load,
    names,
    registered,
)
from dmotion_bench.errors import DmbenchError, UnknownName, UsageError
from dmotion_bench.values import is_frozen_dataclass
from dmotion_bench.wording import shown

if TYPE_CHECKING:
    from dmotion_bench.benchmarks.result import Result
    from dmotion_bench.environment import Environment, EnvironmentFamily
    from dmotion_bench.learning.model import ForwardModel
    from dmotion_bench.planning.objectives.base import Objective
    from dmotion_bench.planning.solvers.base import Solver
    from dmotion_bench.reproduction.table import Table


_ENVIRONMENT_MEMBERS: Final = (
    *("recording", "policies", "default_policy"),
    *("reset", "step", "legal_actions", "render", "close"),
)


def register_model(name: str, kind: type[ForwardModel[Any]]) -> None:
    """Make a class of models known in this process, as a notebook does; a package of its own is known in every one.

    Args:
        name: By which it is trained and scored. Registering it again replaces it.
        kind: The class, a subclass of ``ForwardModel``.

    Raises:
        UsageError: The name is a package's or cannot be one, or this is no such class.

    Example:
        >>> from dmotion_bench.registry import model_class
        >>> dm.register_model("my-dmotion", model_class("dmotion"))
        >>> "my-dmotion" in dm.model_names()
        True
    """
    if not (isinstance(kind, type) and hasattr(kind, "training_defaults")):
        raise UsageError(f"{shown(kind)} is no class of models; give a subclass of ForwardModel.")
    add(MODELS, name, kind)


def register_environment(name: str, kind: type[Environment]) -> None:
    """Make a class of environments known in this process.

    Args:
        name: By which it is recorded. Registering it again replaces it.
        kind: The class; ``dmotion_bench.environment`` says what it has to do.

    Raises:
        UsageError: The name is a package's or cannot be one, or this is no such class.

    Example:
        >>> from dmotion_bench.registry import environment_class
        >>> dm.register_environment("my-world", environment_class("grid_world"))
        >>> "my-world" in dm.environment_names()
        True
    """
    if not isinstance(kind, type):
        raise UsageError(f"{shown(kind)} is no class of environments; see dmotion_bench.environment.Environment.")
    _require_whole(name, kind)
    add(ENVIRONMENTS, name, kind)


def _require_whole(name: str, kind: type) -> None:
    """See that a class has what every environment has; ``facts`` may be made by its constructor.

    Raises:
        UsageError: It has not.
    """
    if missing := [member for member in _ENVIRONMENT_MEMBERS if not hasattr(kind, member)]:
        raise UsageError(
            f"the class {kind.__name__!r} of the environment {shown(name)} has no {', '.join(map(repr, missing))}; "
            "see dmotion_bench.environment.Environment."
        )


def register_solver(name: str, kind: type[Solver]) -> None:
    """Make a class of solvers known in this process.

    Args:
        name: By which it plans. Registering it again replaces it.
        kind: The class, a frozen dataclass with a method ``plan``; ``docs/your_planner.md`` says what it has to do.

    Raises:
        UsageError: The name is a package's or cannot be one, or this is no such class.

    Example:
        >>> from dmotion_bench.registry import solver_class
        >>> dm.register_solver("my-cem", solver_class("cem"))
        >>> dm.plan("oracle", steps=2, planner="my-cem", planner_settings={"horizon": 1}).planner
        'my-cem'
    """
    _add_planner(SOLVERS, "solvers", "plan", name, kind)


def register_objective(name: str, kind: type[Objective]) -> None:
    """Make a class of objectives known in this process.

    Args:
        name: By which it is planned with. Registering it again replaces it.
        kind: The class, a frozen dataclass with a method ``reset``; ``docs/your_planner.md`` says what it has to do.

    Raises:
        UsageError: The name is a package's or cannot be one, or this is no such class.

    Example:
        >>> from dmotion_bench.registry import objective_class
        >>> dm.register_objective("my-pixel", objective_class("pixel"))
        >>> len(dm.plan("oracle", steps=2, objective="my-pixel", planner_settings={"horizon": 1}).actions)
        2
    """
    _add_planner(OBJECTIVES, "objectives", "reset", name, kind)


def _add_planner(group: str, many: str, method: str, name: str, kind: object) -> None:
    if not (is_frozen_dataclass(kind) and hasattr(kind, method)):
        raise UsageError(
            f"{shown(kind)} is no class of {many}; give a frozen dataclass with a method '{method}', as "
            "docs/your_planner.md describes it."
        )
    add(group, name, kind)


def environment_names() -> list[str]:
    """The names of all installed environments.

    Example:
        >>> "grid_world" in dm.environment_names()
        True
    """
    return names(ENVIRONMENTS)


def model_names() -> list[str]:
    """The names of all installed models.

    Example:
        >>> "dmotion" in dm.model_names()
        True
    """
    return names(MODELS)


def speed_names() -> list[str]:
    """The names of all speeds that packages add to ``dmbench bench``."""
    return names(SPEEDS)


def speed(name: str) -> Callable[[float], Iterable[Result]]:
    """The function that measures an added speed for so many seconds.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: Callable[[float], Iterable[Result]] = load(SPEEDS, "speed", name)
    return loaded


def family_names() -> list[str]:
    """The names of all installed families of environments."""
    return names(FAMILIES)


def environment_family(name: str) -> EnvironmentFamily:
    """A family of environments.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: EnvironmentFamily = load(FAMILIES, "family of environments", name)
    return loaded


def is_environment(name: str) -> bool:
    """Whether an environment of this name, or its family, is installed."""
    family, colon, _ = name.partition(":")
    return family in family_names() if colon else name in environment_names()


def environment_class(name: str) -> type[Environment]:
    """The class of an environment, or of a member of a family.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    if not isinstance(name, str):
        raise UsageError(
            f"{shown(name)} is not the name of an environment; give its name or 'gym:ID', and make a class of your own "
            "known by register_environment."
        )
    family, colon, member = name.partition(":")
    if colon:
        return environment_family(family).member(member)
    if name not in environment_names():
        members = [f"{one}:{world}" for one in family_names() for world in environment_family(one).worlds()]
        if difflib.get_close_matches(name, members, n=1):  # 'gym:' was left out
            raise UnknownName("environment", name, [*environment_names(), *members], LISTED[ENVIRONMENTS])
    loaded: type[Environment] = load(ENVIRONMENTS, "environment", name)
    _require_whole(name, loaded)
    return loaded


def usual_policy(name: str) -> str | None:
    """The policy that an environment is recorded by if nobody names one; None for an environment that is not here."""
    try:
        return environment_class(name).default_policy
    except DmbenchError:
        return None


def environment_versions(name: str) -> Mapping[int, str]:
    """What is true of each version of an environment, the last one recorded by default; empty if it has only one.

    Empty as well for one that is not installed, such as that of imported recordings.
    """
    from dmotion_bench.environment import Versioned

    try:
        kind: object = environment_class(name)
    except DmbenchError:
        return {}
    return kind.versions if isinstance(kind, Versioned) else {}


def environment_title(name: str) -> str:
    """What pages call an environment: the title of its class, else its name in words, as "Grid World"."""
    from dmotion_bench.environment import Titled

    if name in environment_names():
        with contextlib.suppress(DmbenchError):  # it cannot be imported here
            kind: object = environment_class(name)
            if isinstance(kind, Titled):
                return kind.title
    return name if ":" in name else name.replace("_", " ").title()


def model_class(name: str) -> type[ForwardModel[Any]]:
    """The class of a model.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: type[ForwardModel[Any]] = load(MODELS, "model", name)
    return loaded


def objective_names() -> list[str]:
    """The names of all installed objectives.

    Example:
        >>> "centres" in dm.objective_names()
        True
    """
    return names(OBJECTIVES)


def solver_names() -> list[str]:
    """The names of all installed solvers.

    Example:
        >>> "cem" in dm.solver_names()
        True
    """
    return names(SOLVERS)


def objective_class(name: str) -> type[Objective]:
    """The class of an objective.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: type[Objective] = load(OBJECTIVES, "objective", name)
    return loaded


def solver_class(name: str) -> type[Solver]:
    """The class of a solver.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: type[Solver] = load(SOLVERS, "planner", name)
    return loaded


def table(name: str) -> Table:
    """A table that can be reproduced.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: Table = load(TABLES, "table", name)
    return loaded


def leaderboard_part(name: str) -> Callable[..., Any]:
    """A function of the leaderboard's package, which the core does not know.

    Raises:
        DmbenchError: No installed package has it.
    """
    for point in registered(LEADERBOARD):
        if point.name == name:
            loaded: Callable[..., Any] = point.load()
            return loaded
    raise DmbenchError(
        f"no installed package has the leaderboard's {name!r} (entry points {LEADERBOARD!r}); "
        "install dmbench again: 'pip install --editable .' in its folder."
    )
