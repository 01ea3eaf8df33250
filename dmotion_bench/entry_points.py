"""What installed packages register in the groups of entry points, and what this process adds to them.

Nothing is imported until a name is asked for, so listing names costs no torch and no simulator.
"""

from __future__ import annotations

import functools
import re
import sys
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import DmbenchError, UnknownName, UsageError
from dmotion_bench.wording import shown

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
    if not isinstance(name, str) or not _NAME.fullmatch(name):
        raise UsageError(
            f"{shown(name)} cannot be a name here; it has at most 100 letters, digits, dots, dashes and underscores, "
            "the first of them a letter or a digit."
        )
    if any(point.name == name for point in registered(group)):
        raise UsageError(f"{shown(name)} is registered by a package already ({group}); choose another name.")
    _ADDED[group, name] = what


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


def load(group: str, kind: str, name: str) -> Any:
    """What a name stands for.

    Args:
        group: Such as ``MODELS``.
        kind: What a sentence calls a member of the group.
        name: Asked for.

    Raises:
        UnknownName: Nothing is registered under this name.
        DmbenchError: Two packages register it, or it cannot be imported.
    """
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
