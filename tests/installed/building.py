"""Builds the sdist and, from the sdist alone, the wheel."""

from __future__ import annotations

import subprocess
import sys
import tarfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]


def build(folder: Path) -> tuple[Path, Path]:
    """The sdist of the working tree, and the wheel of the unpacked sdist.

    Args:
        folder: Where both are put; empty.
    """
    _hatchling("sdist", ROOT, folder)
    (sdist,) = folder.glob("*.tar.gz")
    with tarfile.open(sdist) as archive:
        archive.extractall(folder / "unpacked", filter="data")
    (source,) = (folder / "unpacked").iterdir()
    return sdist, build_wheel(source, folder)


def build_wheel(source: Path, folder: Path) -> Path:
    """The wheel of a source tree.

    Args:
        source: The tree.
        folder: Where the wheel is put; it holds no other.
    """
    _hatchling("wheel", source, folder)
    (wheel,) = folder.glob("*.whl")
    return wheel


def _hatchling(target: str, source: Path, folder: Path) -> None:
    words = [sys.executable, "-m", "hatchling", "build", "--target", target, "--directory", str(folder)]
    subprocess.run(words, cwd=source, check=True, capture_output=True, text=True)
