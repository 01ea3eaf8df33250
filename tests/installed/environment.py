"""Empty environments with dmbench installed from a wheel: from the package index, or from what is installed here."""

from __future__ import annotations

import functools
import os
import subprocess
import sys
import zipfile
from importlib.metadata import Distribution, PackageNotFoundError, PathDistribution, distribution
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from tests.installed.building import ROOT

PIP = ("-m", "pip", "--disable-pip-version-check", "--quiet", "install")
LEFT_TO_TORCH = ("torch", "lightning-fabric")
"""What is not installed where torch would be a build of several gigabytes."""


def from_the_index(folder: Path, wheel: Path, python: str, *, without_torch: bool = False) -> Path:
    """An environment that pip fills as a user's.

    Args:
        folder: Of the new environment.
        wheel: dmbench's.
        python: The interpreter to make it with.
        without_torch: Leave torch out, and what needs it.

    Returns:
        Its interpreter.
    """
    made = _empty(folder, python)
    limits = ("--constraint", str(ROOT / "constraints.txt"))
    if without_torch:
        needed = [str(one) for one in _needs(_of_the_wheel(wheel), made) if one.name not in LEFT_TO_TORCH]
        subprocess.run([made, *PIP, *limits, *needed], check=True)
        subprocess.run([made, *PIP, "--no-deps", str(wheel)], check=True)
    else:
        subprocess.run([made, *PIP, *limits, "torch"], check=True)  # first, as make install does: one build of it
        subprocess.run([made, *PIP, *limits, str(wheel)], check=True)
    return made


def from_here(folder: Path, wheel: Path) -> Path:
    """An environment that holds what dmbench declares to need, linked from this one, and nothing else; no network.

    pip installs the wheel into it and finds every requirement met, or fails.

    Returns:
        Its interpreter.
    """
    made = _empty(folder, sys.executable, "--without-pip")
    (site,) = (folder / "lib").glob("python*/site-packages")
    for package in _closure(wheel, made):
        for file in package.files or ():
            top = file.parts[0]
            if top not in ("..", "__pycache__") and not top.endswith(".pth") and not os.path.lexists(site / top):
                (site / top).symlink_to(Path(str(package.locate_file(top))))
    of_this = [sys.executable, "-m", "pip", "--python", str(made), *PIP[2:]]
    subprocess.run([*of_this, "--no-index", str(wheel)], check=True, capture_output=True, text=True)
    return made


def _empty(folder: Path, python: str, *options: str) -> Path:
    subprocess.run([python, "-m", "venv", *options, str(folder)], check=True, capture_output=True)
    return folder / "bin" / "python"


def _of_the_wheel(wheel: Path) -> Distribution:
    """What the wheel says of itself."""
    (said,) = (path for path in zipfile.Path(wheel).iterdir() if path.name.endswith(".dist-info"))
    return PathDistribution(said)


def _closure(wheel: Path, python: Path) -> list[Distribution]:
    """Every distribution that the wheel needs, by way of others as well, without extras that nobody asked for."""
    waiting = _needs(_of_the_wheel(wheel), python)
    met: set[tuple[str, frozenset[str]]] = set()
    found: dict[str, Distribution] = {}
    while waiting:
        needed = waiting.pop()
        name = canonicalize_name(needed.name)
        if (name, frozenset(needed.extras)) in met:
            continue
        met.add((name, frozenset(needed.extras)))
        try:
            found[name] = distribution(needed.name)
        except PackageNotFoundError as error:
            raise AssertionError(f"{needed} is needed and is not installed here; run 'make install'.") from error
        waiting += _needs(found[name], python, frozenset(needed.extras))
    return [found[name] for name in sorted(found)]


def _needs(package: Distribution, python: Path, extras: frozenset[str] = frozenset()) -> list[Requirement]:
    """What a distribution requires on this system, in an interpreter of this version."""
    worlds = [{"python_version": _version(python), "extra": extra} for extra in {"", *extras}]
    requirements = [Requirement(text) for text in package.requires or ()]
    return [one for one in requirements if one.marker is None or any(one.marker.evaluate(world) for world in worlds)]


@functools.cache
def _version(python: Path) -> str:
    asked = [str(python), "-c", "import sys; print('%d.%d' % sys.version_info[:2])"]
    return subprocess.run(asked, check=True, capture_output=True, text=True).stdout.strip()
