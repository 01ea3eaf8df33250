"""The versions of the packages that decide results, as recorded in data sets, runs and reports."""

from __future__ import annotations

import platform
from collections.abc import Mapping
from importlib.metadata import PackageNotFoundError, version

from dmotion_bench.errors import DatasetError
from dmotion_bench.wording import shown

PACKAGES = ("dmbench", "torch", "numpy", "mcap", "pyarrow", "pybullet", "pymunk", "gymnasium", "rerun-sdk")
DECIDING = ("dmbench", "torch", "numpy")  # of these, what a training computes with
MOST_STATED = 8  # versions of a package, the last ones


def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """The version of each package and of Python; packages that are not installed are left out."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found


def deciding_versions() -> dict[str, str]:
    """The versions of the packages that a training computes with."""
    here = versions(DECIDING)
    return {name: here[name] for name in DECIDING if name in here}


def with_earlier(earlier: Mapping[str, str], now: Mapping[str, str]) -> dict[str, str]:
    """The versions of something that was begun with some and goes on with others: ``"2.4.5, 2.4.6"``.

    Args:
        earlier: As stated so far, by this function perhaps.
        now: Of this process.
    """
    found = dict(earlier)
    for name, version_now in now.items():
        known = [one for one in earlier.get(name, "").split(", ") if one]
        found[name] = ", ".join([*known, *(() if version_now in known else (version_now,))][-MOST_STATED:])
    return found


def differing(stated: Mapping[str, str]) -> tuple[str, str] | None:
    """The packages of which this machine has another version, in words as it has them and as they are stated."""
    here = versions(tuple(stated))
    names = [name for name in stated if here.get(name, stated[name]) != stated[name]]
    found, wanted = (" and ".join(f"{name} {of[name]}" for name in names) for of in (here, stated))
    return (found, wanted) if names else None


def require_same(stated: Mapping[str, str]) -> None:
    """Check that this machine has the versions that a data set is to state; packages that it lacks do not count.

    Raises:
        DatasetError: It has others; names them and the machine.
    """
    if (other := differing(stated)) is not None:
        found, wanted = other
        raise DatasetError(
            f"the machine {shown(platform.node())} has {found}, and the data set is made with {wanted}; install the "
            "same versions on all machines and run the same command again: it goes on where it stopped."
        )
