"""Registered environments, models, objectives, solvers, speeds and tables: names and what they are, by entry points.

``FAMILY:MEMBER`` names an environment of a family, which decides itself what its members are.

Nothing is imported until a name is asked for, so listing names costs no torch and no simulator.
"""

from __future__ import annotations

import contextlib
import difflib
import functools
import re
import sys
from collections.abc import Callable, Iterable, Mapping
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

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

ENVIRONMENTS = "dmbench.environments"
FAMILIES = "dmbench.environment_families"
MODELS = "dmbench.models"
OBJECTIVES = "dmbench.objectives"
SOLVERS = "dmbench.solvers"
SPEEDS = "dmbench.speeds"
TABLES = "dmbench.tables"
LEADERBOARD = "dmbench.leaderboard"

LISTED = {
    ENVIRONMENTS: "dmbench list environments",
    FAMILIES: "dmbench list environments",
    MODELS: "dmbench list models",
    OBJECTIVES: "dmbench score --help",
    SOLVERS: "dmbench score --help",
    TABLES: "dmbench reproduce --help",
}
"""The commands that list the names of each group."""

_REGISTERING: Final = {
    ENVIRONMENTS: "register_environment",
    MODELS: "register_model",
    OBJECTIVES: "register_objective",
    SOLVERS: "register_solver",
}
"""The functions that make a class known in one process."""


_ENVIRONMENT_MEMBERS: Final = (
    *("recording", "policies", "default_policy"),
    *("reset", "step", "legal_actions", "render", "close"),
)

_NAME: Final = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,99}")

_ADDED: Final[dict[tuple[str, str], object]] = {}
"""What this process has added to the groups by ``add``, by group and name."""


def registered(group: str) -> tuple[EntryPoint, ...]:
    """What installed packages have registered in a group.

    Reading the metadata of all packages takes milliseconds, and a scoring asks many times. So what was read is kept
    for as long as none of the folders that packages are found in changes.
    """
    return _read(group, tuple((folder, _changed(folder)) for folder in sys.path))


@functools.lru_cache(maxsize=64)
def _read(group: str, folders: tuple[tuple[str, int], ...]) -> tuple[EntryPoint, ...]:
    return tuple(entry_points(group=group))


def _changed(folder: str) -> int:
    try:
        return Path(folder or ".").stat().st_mtime_ns
    except OSError:  # there is no such folder
        return 0


def add(group: str, name: str, what: object) -> None:
    """Register something for the rest of this process, as a notebook does; other processes do not know it.

    Args:
        group: Such as ``MODELS``.
        name: A name that no package has registered in it; one that was added before stands for something else now.
        what: The class.

    Raises:
        UsageError: A package has registered this name, or it cannot be a part of a folder's name.
    """
    if not _NAME.fullmatch(name):
        raise UsageError(
            f"{shown(name)} cannot be a name here; it has at most 100 letters, digits, dots, dashes and underscores, "
            "the first of them a letter or a digit."
        )
    if any(point.name == name for point in registered(group)):
        raise UsageError(f"{shown(name)} is registered by a package already ({group}); choose another name.")
    _ADDED[group, name] = what


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


def names(group: str) -> list[str]:
    """Every name registered in a group, sorted."""
    added = {name for owner, name in _ADDED if owner == group}
    return sorted({point.name for point in registered(group)} | added)


def owners(group: str, name: str) -> set[str]:
    """The packages that register a name."""
    return {point.dist.name for point in registered(group) if point.name == name and point.dist is not None}


def is_built_in(group: str, name: str) -> bool:
    """Whether this project itself registers a name, and so tests what it stands for."""
    return owners(group, name) == {"dmbench"}


def _load(group: str, kind: str, name: str) -> Any:
    if (group, name) in _ADDED:
        return _ADDED[group, name]
    found: list[EntryPoint] = [point for point in registered(group) if point.name == name]
    if not found:
        raise UnknownName(kind, name, names(group), LISTED.get(group, ""), _REGISTERING.get(group, ""))
    if len({point.value for point in found}) > 1:
        claimed = sorted(f"{point.dist.name if point.dist else 'a package'} ({point.value})" for point in found)
        raise DmbenchError(f"the {kind} {name!r} is registered by {' and by '.join(claimed)}; rename or uninstall one.")
    try:
        return found[0].load()
    except DmbenchError:
        raise
    except Exception as error:  # somebody else's module may raise anything
        raise DmbenchError(
            f"the {kind} {name!r} is registered as {found[0].value!r}, which cannot be imported "
            f"({type(error).__name__}): {error}."
        ) from error


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
    loaded: Callable[[float], Iterable[Result]] = _load(SPEEDS, "speed", name)
    return loaded


def family_names() -> list[str]:
    """The names of all installed families of environments."""
    return names(FAMILIES)


def environment_family(name: str) -> EnvironmentFamily:
    """A family of environments.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: EnvironmentFamily = _load(FAMILIES, "family of environments", name)
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
    loaded: type[Environment] = _load(ENVIRONMENTS, "environment", name)
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
    loaded: type[ForwardModel[Any]] = _load(MODELS, "model", name)
    return loaded


def objective_names() -> list[str]:
    """The names of all installed objectives."""
    return names(OBJECTIVES)


def solver_names() -> list[str]:
    """The names of all installed solvers."""
    return names(SOLVERS)


def objective_class(name: str) -> type[Objective]:
    """The class of an objective.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: type[Objective] = _load(OBJECTIVES, "objective", name)
    return loaded


def solver_class(name: str) -> type[Solver]:
    """The class of a solver.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: type[Solver] = _load(SOLVERS, "planner", name)
    return loaded


def table_names() -> list[str]:
    """The names of all tables that can be reproduced."""
    return names(TABLES)


def table(name: str) -> Table:
    """A table that can be reproduced.

    Raises:
        UnknownName: Nothing is registered under this name.
    """
    loaded: Table = _load(TABLES, "table", name)
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
