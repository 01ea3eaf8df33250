"""What lies in a folder and is not imported: nothing that looks like a recording is left out without a word."""

from __future__ import annotations

import itertools
import os
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from dmotion_bench.storage.imports.natural_order import natural
from dmotion_bench.wording import shown
from dmotion_bench.workspace import DATASET_MANIFEST

BAGS: Final = (".bag", ".db3")
VIDEOS: Final = (
    *(".wmv", ".asf", ".flv", ".ts", ".m2ts", ".mts", ".mpg", ".mpeg", ".vob", ".ogv", ".3gp", ".mxf", ".gif"),
    *(".264", ".h264", ".265", ".h265", ".hevc", ".y4m"),
)
PICTURES: Final = (".bmp", ".tif", ".tiff", ".ppm", ".pgm", ".exr", ".heic", ".avif", ".jp2")
"""Suffixes of recordings, videos and pictures that are not read."""
CONVERTER: Final = "'rosbags-convert --src BAG --dst OUT --dst-storage mcap'"
NOT_READ: Final = (
    "a format that is not read: write the pictures of each episode as PNG files into a folder of its own, or as "
    "'data/demo_0/obs/NAME' into an HDF5 file; or make a LeRobot data set of it"
)
"""What is said of arrays, after their name."""
_ARRAYS: Final = {
    re.compile(r".*\.np[yz]"): "NumPy arrays",
    re.compile(r".*\.zarr|\.z(group|array|attrs)|zarr\.json"): "Zarr arrays",
    re.compile(r".*\.tfrecord.*"): "TFRecord files, as RLDS and TensorFlow Datasets have them",
    re.compile(r".*\.(pkl|pickle|pt|pth)"): "pickled Python objects",
}
_CONVERT: Final = {
    BAGS: f"bags with {CONVERTER}",
    VIDEOS: "videos with 'ffmpeg -i IN OUT.mkv'",
    PICTURES: "pictures into PNG files",
}
_OWN_FORMAT: Final = re.compile(rb'"format"\s*:\s*"dmbench/')
_MOST_FILES: Final = 200_000  # that are looked at besides those that are imported
_MOST_LISTED: Final = 1_000  # names on a level that are looked at for arrays
_SHOWN: Final = 3


@dataclass(frozen=True, kw_only=True)
class Taken:
    """What is imported, by real paths.

    Attributes:
        whole: Files, and folders of which everything belongs to a recording.
        pictures: Folders whose pictures are imported.
        chosen: Folders in which ``--camera`` has chosen one folder or file; what lies beside it are other cameras.
        above: All folders that anything of this lies in.
    """

    whole: frozenset[Path]
    pictures: frozenset[Path]
    chosen: frozenset[Path]
    above: frozenset[Path] = field(init=False)

    def __post_init__(self) -> None:
        above: set[Path] = set()
        for path in self.whole | self.pictures:
            for folder in path.parents:
                if folder in above:
                    break
                above.add(folder)
        object.__setattr__(self, "above", frozenset(above))

    def holds(self, folder: Path) -> bool:
        """Whether anything in a folder is imported."""
        return folder in self.above or folder in self.pictures


def real_paths(paths: Iterable[Path]) -> frozenset[Path]:
    """Where they are, whatever links lead there."""
    return frozenset(map(_real, paths))


@dataclass(frozen=True, kw_only=True)
class PassedOver:
    """What is not imported of a folder, in natural order.

    Attributes:
        folder: It.
        readable: Recordings and pictures, and folders that hold some.
        foreign: Files of formats that are not read, and folders that hold some.
        suffixes: Of those files.
        broken: Links that lead nowhere, and folders that cannot be read.
        is_all: Whether the whole folder was looked through.
    """

    folder: Path
    readable: Sequence[Path]
    foreign: Sequence[Path]
    suffixes: frozenset[str]
    broken: Sequence[Path]
    is_all: bool

    def sentences(self, camera: str | None) -> list[str]:
        """What is told of it."""
        told = []
        if self.readable:
            exactly = "" if camera is None else f" '--camera {camera}' takes what is called exactly so."
            told.append(
                f"{self._counted(self.readable)} not imported: {self.listed(self.readable)}. What of it belongs to the "
                f"data set can be named as a further path.{exactly}"
            )
        if self.foreign:
            told.append(self.foreign_sentence())
        if self.broken:
            told.append(
                f"{self._counted(self.broken)} not imported: {self.listed(self.broken)}. A link leads "
                "nowhere, or a folder cannot be read."
            )
        if not self.is_all:
            told.append(
                f"{str(self.folder)!r} holds more than {_MOST_FILES:,} other files; what else of them was not imported "
                "is not told. Name the recordings themselves."
            )
        return told

    def foreign_sentence(self) -> str:
        """What is told of formats that are not read."""
        ways = [way for suffixes, way in _CONVERT.items() if not self.suffixes.isdisjoint(suffixes)]
        return (
            f"{self._counted(self.foreign)} not imported: {self.listed(self.foreign)}. "
            f"Files of the kind {', '.join(sorted(self.suffixes))} are not read: convert {', '.join(ways)}."
        )

    def listed(self, paths: Sequence[Path]) -> str:
        """The first of the paths, as they are called within the folder, and how many there are besides."""
        names = [str(path.relative_to(self.folder)) + "/" * path.is_dir() for path in paths[:_SHOWN]]
        names = [name if name.isprintable() else shown(name) for name in names]
        more = f" and {len(paths) - _SHOWN} more" if len(paths) > _SHOWN else ""
        return ", ".join(names) + more

    def _counted(self, paths: Sequence[Path]) -> str:
        if len(paths) == 1:
            return f"1 file or folder in {str(self.folder)!r} was"
        return f"{len(paths):,} files and folders in {str(self.folder)!r} were"


def arrays_of(name: str) -> str | None:
    """What a file or folder of this name holds, if that is arrays of another kind."""
    return next((kind for names, kind in _ARRAYS.items() if names.fullmatch(name)), None)


def arrays_in(folder: Path) -> tuple[Path, str] | None:
    """The first file or folder with arrays in a folder, or in the folders in it, and what they are."""
    inside = [one for level in ("*", "*/*") for one in itertools.islice(folder.glob(level), _MOST_LISTED)]
    return next(((one, kind) for one in inside if (kind := arrays_of(one.name)) is not None), None)


def is_dataset(folder: Path) -> bool:
    """Whether a folder holds a data set of dmbench, by the beginning of its manifest."""
    if not (folder / DATASET_MANIFEST).is_file():  # a pipe would be waited for
        return False
    try:
        with (folder / DATASET_MANIFEST).open("rb") as file:
            return _OWN_FORMAT.search(file.read(4096)) is not None
    except OSError:
        return False


def passed_over(root: Path, taken: Taken, suffixes: Iterable[str], mark: Path) -> PassedOver:
    """Look through a folder for what is not imported of it; hidden files and data sets of dmbench do not count.

    Args:
        root: The folder.
        taken: What is imported.
        suffixes: Of recordings and pictures that can be read.
        mark: A folder with this file in it is a recording as a whole.
    """
    readable, foreign, broken = dict[Path, None](), dict[Path, None](), dict[Path, None]()
    known, strange, seen, waiting, left = tuple(suffixes), set[str](), set[Path](), [root], _MOST_FILES
    while waiting and left > 0:
        folder = waiting.pop()
        real = _real(folder)
        if real in seen or real in taken.whole or is_dataset(folder):
            continue
        seen.add(real)
        try:
            is_whole = (folder / mark).is_file()
            entries = [one for one in os.scandir(folder) if not one.name.startswith(".")]
        except OSError:
            broken[folder] = None
            continue
        if is_whole:
            readable[folder] = None
            continue
        holder = _holder(folder, root, taken)
        for entry in entries:
            path = folder / entry.name
            at = _real(path) if entry.is_symlink() else real / entry.name
            if at in taken.whole or (real in taken.chosen and not taken.holds(at)):
                continue
            if _is_folder(entry):
                waiting.append(path)
                continue
            is_known = entry.name.lower().endswith(known)
            if is_known and real in taken.pictures:  # also a link that leads nowhere: the import refuses it
                continue
            left -= 1
            if entry.is_symlink() and not path.exists():
                broken[path] = None
            elif is_known:
                readable[holder or path] = None
            elif suffix := _foreign_suffix(entry.name):
                foreign[holder or path] = None
                strange.add(suffix)
    return PassedOver(
        folder=root,
        readable=_in_order(readable, root),
        foreign=_in_order(foreign, root),
        suffixes=frozenset(strange),
        broken=_in_order(broken, root),
        is_all=left > 0,
    )


def _holder(folder: Path, root: Path, taken: Taken) -> Path | None:
    """The folder that the files in a folder are told of by: one that could be imported; None for the files alone."""
    told = None
    for one in (folder, folder.parent):
        if one == root or taken.holds(_real(one)):
            break
        told = one
    return told


def _real(path: Path) -> Path:
    return Path(os.path.realpath(path))  # Path.resolve() fails at a link to itself


def _is_folder(entry: os.DirEntry[str]) -> bool:
    try:
        return entry.is_dir()
    except OSError:  # a link to itself, or into a folder that is closed
        return False


def _foreign_suffix(name: str) -> str | None:
    return next((one for suffixes in _CONVERT for one in suffixes if name.lower().endswith(one)), None)


def _in_order(paths: Iterable[Path], root: Path) -> list[Path]:
    return sorted(paths, key=lambda path: [natural(part) for part in path.relative_to(root).parts])
