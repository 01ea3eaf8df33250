"""ROS 2 bags that were recorded into several files, which are one recording.

rosbag2 begins another file after ``--max-bag-duration`` or ``--max-bag-size``. The bag's ``metadata.yaml`` lists all of
them under ``relative_file_paths``. Only that list is read from it, line by line: each file has a line of its own.
"""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

from dmotion_bench.storage.imports.limits import MIB

METADATA: Final = "metadata.yaml"
_KEY: Final = "relative_file_paths:"
_LARGEST: Final = 16 * MIB
_SHOWN: Final = 3  # names in a sentence


def bags_of(files: Iterable[Path]) -> dict[Path, Path]:
    """The folders of the bags that several of the files are parts of, by these files.

    Args:
        files: MCAP files.
    """
    listed: dict[Path, frozenset[str]] = {}
    found: dict[Path, Path] = {}
    for file in files:
        for place in (file, Path(os.path.realpath(file))):  # where it was named, and where a link leads
            folder = Path(os.path.realpath(place.parent))
            if folder not in listed:
                listed[folder] = frozenset(map(_bare, listed_files(folder / METADATA)))
            if _bare(place.name) in listed[folder]:
                found[file] = folder
                break
    parts = Counter(found.values())
    return {file: folder for file, folder in found.items() if parts[folder] > 1}


def listed_files(metadata: Path) -> Sequence[str]:
    """The names of the files that a bag consists of; none if its description cannot be read.

    Args:
        metadata: The bag's ``metadata.yaml``.
    """
    try:
        if not metadata.is_file() or metadata.stat().st_size > _LARGEST:
            return []
        with metadata.open(encoding="utf-8", errors="replace") as lines:
            return _listed(map(str.strip, lines))
    except OSError:
        return []


def _listed(lines: Iterator[str]) -> list[str]:
    if _KEY not in lines:  # the lines after it are left in the iterator
        return []
    names: list[str] = []
    for line in lines:
        if line.startswith("-"):
            names.append(line[1:].strip())
        elif names and not names[-1]:  # a long name may stand below its dash
            names[-1] = line
        else:
            break
    return [name.strip("'\"").rpartition("/")[2] for name in names]


def told_of_bags(bags: Mapping[Path, Path]) -> list[str]:
    """What is told of bags in several files.

    Args:
        bags: See ``bags_of``.
    """
    names: dict[Path, str] = {}
    for file, folder in bags.items():
        names.setdefault(folder, repr(str(file.parent)))
    if not names:
        return []
    shown = ", ".join(list(names.values())[:_SHOWN])
    if len(names) == 1:
        return [f"{len(bags)} files of {shown} are one recording: its {METADATA!r} lists them as parts of one bag."]
    more = f" and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return [
        f"{len(bags)} files are {len(names)} recordings, as each {METADATA!r} lists the parts of one bag: "
        f"{shown}{more}."
    ]


def _bare(name: str) -> str:
    """A file's name without its suffixes: a bag may be compressed after it was recorded."""
    return name.lower().partition(".mcap")[0]
