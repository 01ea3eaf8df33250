"""The versions of the packages that decide results, as recorded in data sets, runs and reports."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("dmbench", "torch", "numpy", "mcap", "pyarrow", "pybullet", "pymunk", "gymnasium", "rerun-sdk")


def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """The version of each package and of Python; packages that are not installed are left out."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
