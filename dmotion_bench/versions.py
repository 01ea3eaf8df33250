"""Which releases of the packages that decide results are at work; stands in data sets, runs and reports."""

from __future__ import annotations

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = ("dmbench", "torch", "numpy", "mcap", "pyarrow", "pybullet", "pymunk", "gymnasium", "rerun-sdk")


def versions(packages: tuple[str, ...] = PACKAGES) -> dict[str, str]:
    """Release by name, Python's among them; a package that is not installed is left out."""
    found = {"python": platform.python_version()}
    for name in packages:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
