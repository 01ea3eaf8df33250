"""Which releases of the packages that decide results are at work; stands in data sets, runs and reports."""

from __future__ import annotations

import hashlib
import platform
from functools import cache
from importlib import resources
from importlib.metadata import PackageNotFoundError, version

from dmotion_bench import __version__

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


@cache
def code_version(*parts: str) -> str:
    """The release of dmbench and a hash over some of its code: what other code found is not taken for its own.

    Args:
        parts: Folders and modules of the package, such as ``"scoring"`` and ``"positions.py"``.
    """
    digest = hashlib.sha256()
    package = resources.files("dmotion_bench")
    for part in map(package.joinpath, parts):
        files = sorted(part.iterdir(), key=lambda file: file.name) if part.is_dir() else [part]
        for file in files:
            if file.name.endswith(".py"):
                digest.update(file.name.encode() + b"\0" + file.read_bytes())
    return f"{__version__}+{digest.hexdigest()[:12]}"
