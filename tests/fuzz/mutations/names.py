"""What a folder lists: names that nobody expects, links, pipes, files that are gone or in one another's place."""

from __future__ import annotations

import hashlib
import os
import shutil
from pathlib import Path

import numpy as np

from tests.fuzz.mutations import pick

HOSTILE_NAMES = (
    *(".arriving", ".hidden", "-rf", "~", "CON", " name ", "name.", "a:b", "a\\b", "a\nb", "\x1b[2J\x07", "\u202ename"),
    *(os.fsdecode(b"\xff\xfe"), "x" * 250, "%s", "*", "'", "0" * 64, "f" * 64, "F" * 64, f"{'0' * 64}.json", "é" * 100),
)


def spoil_names(rng: np.random.Generator, folder: Path, beside: Path) -> str:
    """Change what is listed in a folder and those below it.

    Args:
        rng: Of the case.
        folder: Whose.
        beside: A folder that links lead to; nobody who reads or writes the other may get there.
    """
    kinds = ("gone", "rename", "rename", "link", "link", "loop", "pipe", "swap", "folder", "empty", "many", "copy")
    return "; ".join(_change(rng, pick(rng, kinds), folder, beside) for _ in range(int(rng.choice([1, 1, 2]))))


def _change(rng: np.random.Generator, kind: str, root: Path, beside: Path) -> str:
    paths = sorted(path for path in root.rglob("*") if not path.is_symlink())
    if not paths:
        return "nothing is left"
    folders = [path for path in paths if path.is_dir()]
    files = [path for path in paths if path.is_file()]
    path = pick(rng, folders) if folders and rng.random() < 0.5 else pick(rng, files or paths)
    told = f"{kind} {path.relative_to(root)}"
    if kind == "rename":
        name = pick(rng, HOSTILE_NAMES)
        if not os.path.lexists(path.with_name(name)):
            path.rename(path.with_name(name))
        return f"{told}: {name[:20]!r}"
    if kind == "copy":
        target = path.with_name(pick(rng, HOSTILE_NAMES))
        if not os.path.lexists(target):
            shutil.copytree(path, target, symlinks=True) if path.is_dir() else shutil.copyfile(path, target)
        return f"{told}: {target.name[:20]!r}"
    if kind == "many":
        return f"{told}: {_many(rng, path if path.is_dir() else path.parent, files)}"
    if kind == "swap":
        other = pick(rng, files or paths)
        if path.is_file() and other.is_file():
            first, second = path.read_bytes(), other.read_bytes()
            path.write_bytes(second)
            other.write_bytes(first)
        return f"{told}: {other.relative_to(root)}"
    if kind == "link":
        target = beside / f"moved-{len(list(beside.iterdir()))}"
        if rng.random() < 0.7:
            path.rename(target)
        else:
            _remove(path)
            target = pick(rng, (beside, beside / "secret", Path("/nonexistent/file"), Path("/dev/zero"), root))
        path.symlink_to(target)
        return f"{told}: {target.name}"
    _remove(path)
    if kind == "loop":
        path.symlink_to(path.name)
    elif kind == "pipe":
        os.mkfifo(path)
    elif kind == "folder":
        path.mkdir()
    elif kind == "empty":
        path.write_bytes(b"")
    return told


def _many(rng: np.random.Generator, folder: Path, files: list[Path]) -> str:
    """Hundreds of files, or of folders, each with a name that could be a hash."""
    count = int(rng.choice([3, 300]))
    content = pick(rng, files).read_bytes() if files else b""
    deep = rng.random() < 0.3
    for number in range(count):
        data = content + b"\n" * number
        name = hashlib.sha256(data).hexdigest()
        path = folder / (name if deep else f"{name}.json")
        if os.path.lexists(path):
            continue
        path.mkdir() if deep else path.write_bytes(data)
    return f"{count} {'folders' if deep else 'files'}"


def _remove(path: Path) -> None:
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink()
