"""A folder of pictures as a recording: each folder with pictures is an episode, in the natural order of their names.

Pictures have no times; they count as taken at a steady rate, and ``picture_numbers`` says where some are missing.

Names that differ in more than their numbers, ``img0_left.png`` and ``img0_right.png``, are of several cameras. A
pattern such as ``img#_left.png`` chooses one: a ``#`` stands for each number.
"""

from __future__ import annotations

import hashlib
import stat
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture, CompressedPicture
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.natural_order import in_natural_order
from dmotion_bench.storage.imports.picture_numbers import (
    NUMBER,
    begun_anew,
    hz_by_times,
    repeated_with_others,
    steps_between,
)
from dmotion_bench.storage.imports.pixels import Shape, shape_of, to_rgb
from dmotion_bench.storage.imports.recording import Segment, Survey, steady_times, times_after
from dmotion_bench.wording import shown

PICTURES: Final = (".jpeg", ".jpg", ".png", ".webp")
_HEAD: Final = 1 << 20  # of a picture's file: its size stands there, if not behind a large thumbnail
_LISTED: Final = 10  # patterns that an error names


def pattern_of(name: str) -> str:
    """A picture's name with a ``#`` for each number: ``img#_left.png``; a time with a fraction is one number."""
    return NUMBER.sub("#", name)


def folder_and_pattern(camera: str | None) -> tuple[str | None, str | None]:
    """The folder and the pattern that ``--camera`` names: ``rgb``, ``img#_left.png`` or ``rgb/img#_left.png``."""
    if camera is None or Path(camera).suffix.lower() not in PICTURES:
        return camera, None
    folder, _, name = camera.rpartition("/")
    return folder or None, pattern_of(name)


def pictures_in(folder: Path, pattern: str | None = None) -> list[Path]:
    """The pictures that lie in a folder, in natural order; hidden files are none.

    A link that leads nowhere is one: a picture is missing there, and reading it says so.

    Args:
        folder: It.
        pattern: Of the names that count; None for all.
    """
    files = [
        file for file in folder.iterdir() if _is_picture_of(pattern, file) and (file.is_file() or file.is_symlink())
    ]
    return in_natural_order((file for file in files if not file.is_dir()), may_be_times=True)


def patterns_in(folder: Path) -> Counter[str]:
    """How many pictures of each pattern lie in a folder."""
    return Counter(pattern_of(file.name) for file in pictures_in(folder))


def listed_patterns(patterns: Counter[str]) -> str:
    """Patterns for an error, each with its number of pictures."""
    told = "".join(f"\n  --camera {shown(name)} ({count:,} pictures)" for name, count in patterns.most_common(_LISTED))
    return told + (f"\n  and {len(patterns) - _LISTED} more" if len(patterns) > _LISTED else "")


def episode_folders(path: Path, camera: str | None) -> list[Path]:
    """The folders whose pictures are an episode each: the folder itself, those in it, or a camera's in those.

    Pictures in the folder itself come first, unless a camera's are asked for: then the folder must be called so.
    Of a camera that is a pattern, a folder must hold pictures with such names.
    """
    camera, pattern = folder_and_pattern(camera)
    is_own = _has_pictures(path, pattern)
    if is_own and camera is None:
        return [path]
    is_own = is_own and path.resolve().name == camera
    folders = (folder for folder in path.iterdir() if folder.is_dir() and not folder.name.startswith("."))
    inside = in_natural_order(folders)
    if camera is not None:
        below = [folder / camera for folder in inside if Path(camera).name == camera]
        inside = [folder for folder in below if _is_folder(folder)] or [one for one in inside if one.name == camera]
    found = [folder for folder in inside if _has_pictures(folder, pattern)]
    return [path] if is_own and not found else found


def _is_picture_of(pattern: str | None, file: Path) -> bool:
    """Whether a file is called like a picture, and by the pattern if there is one."""
    is_one = file.suffix.lower() in PICTURES and not file.name.startswith(".")
    return is_one and pattern in (None, pattern_of(file.name))


def _has_pictures(folder: Path, pattern: str | None) -> bool:
    """Whether a folder holds a picture; one that cannot be read does not, as far as anybody knows."""
    try:
        return any(_is_picture_of(pattern, file) and file.is_file() for file in folder.iterdir())
    except OSError:
        return False


def _is_folder(path: Path) -> bool:
    try:
        return path.is_dir()
    except OSError:
        return False


class PictureFolder:
    """A folder of pictures, or of folders of pictures.

    Args:
        path: The folder.
        camera: The name of the folder in each episode's folder that the pictures are in; None where they lie in the
            episode's folder itself. See ``folder_and_pattern`` for cameras whose pictures share a folder.
        source_hz: Pictures a second.
        limits: What a file may make us do.
        salvage: In a damaged picture's place take the one before it.
        is_rate_assumed: Whether nobody has said ``source_hz``.
    """

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None,
        source_hz: float,
        limits: ImportLimits,
        salvage: bool = False,
        is_rate_assumed: bool = False,
    ) -> None:
        self._is_rate_assumed = is_rate_assumed
        self.path, self._source_hz, self._limits, self._salvage = path, source_hz, limits, salvage
        self._camera, self.unreadable = camera, 0
        self._pattern = folder_and_pattern(camera)[1]
        self._folders = episode_folders(path, camera)

    def sha256(self) -> str:
        """Over the names and the contents of all pictures."""
        digest = hashlib.sha256()
        for file in self._files():
            digest.update(f"{file.relative_to(self.path).as_posix()}\0".encode(errors="surrogateescape"))
            with file.open("rb") as opened:
                digest.update(hashlib.file_digest(opened, "sha256").digest())
        return digest.hexdigest()

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Look at the size of every picture.

        Raises:
            RecordingImportError: They are of several cameras, sizes or kinds, too many, or no pictures.
        """
        first: tuple[Path, Shape] | None = None
        segments, count, missing = [], 0, Counter[Path]()
        shared, anew = dict[Path, tuple[list[str], int]](), dict[Path, tuple[str, int]]()
        rates = Counter[float]()
        for folder in self._folders:
            files, shape = self._in(folder), None
            for file in files:
                shape = self._shape(file, shape)
                first = first or (file, shape)
                if shape != first[1]:
                    raise self._mixed(*first, file, shape)
                count += 1
                progress(count)
            if count > self._limits.frames:
                raise RecordingImportError(f"{str(self.path)!r} holds more pictures than can be imported at once.")
            names = [file.name for file in files]
            if (numbers := repeated_with_others(names)) is not None:
                shared[folder] = numbers
            elif (begun := begun_anew(names)) is not None:
                anew[folder] = begun
            if self._is_rate_assumed and (rate := hz_by_times(names)):
                rates[rate] += len(names)
            steps = steps_between(names)
            if steps is None:
                times = steady_times(len(files), self._source_hz, self.path)
            else:
                times = times_after(steps, self._source_hz, self.path)
                missing[folder] = int((steps > 1).sum())
            segments.append(Segment(times_ns=times))
        if first is None:
            raise RecordingImportError(f"{str(self.path)!r} holds no pictures ({', '.join(PICTURES)}).")
        shape = first[1]
        return Survey(
            camera=self._camera or "pictures",
            height=shape.height,
            width=shape.width,
            segments=segments,
            told=[
                *_told_of_shared(shared),
                *_told_of_begun(anew),
                *self._told_of_missing(+missing),
                *_told_of_rates(rates),
            ],
            is_deep=shape.is_deep,
            is_rate_assumed=self._is_rate_assumed,
        )

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Unpack some of an episode's pictures."""
        files = self._in(self._folders[segment])
        shown: UInt8[np.ndarray, "h w 3"] | None = None
        for number in wanted.tolist():
            if number >= len(files):
                raise RecordingImportError(f"{str(self.path)!r} changed while it was imported; import it again.")
            file = files[number]
            try:
                shown = to_rgb(self._read(file, None), self._limits)
            except BadPicture as error:
                if not self._salvage or shown is None:
                    raise self._damaged(file, error, is_first=shown is None) from error
                self.unreadable += 1
            yield shown

    def _files(self) -> Iterator[Path]:
        for folder in self._folders:
            yield from self._in(folder)

    def _in(self, folder: Path) -> list[Path]:
        """An episode's pictures.

        Raises:
            RecordingImportError: They are of several cameras.
        """
        files = pictures_in(folder, self._pattern)
        patterns = Counter(pattern_of(file.name) for file in files)
        if len(patterns) > 1:
            raise RecordingImportError(
                f"the pictures in {str(folder)!r} have names of {len(patterns)} patterns ('#' is a number), as those "
                "of several cameras have; choose one, or rename them so that they differ in their numbers alone:"
                f"{listed_patterns(patterns)}"
            )
        return files

    def _told_of_missing(self, places: Counter[Path]) -> list[str]:
        """What is told of numbers or times that are missing among the names, by the folder."""
        if not places:
            return []
        count = places.total()
        where = f"{count:,} {'place' if count == 1 else 'places'} of "
        where += (
            f"{str(next(iter(places)))!r}" if len(places) == 1 else f"{len(places):,} folders in {str(self.path)!r}"
        )
        return [f"numbers are missing in the names of the pictures, in {where}: those pictures count as lost."]

    def _mixed(self, one: Path, shape: Shape, other: Path, others_shape: Shape) -> RecordingImportError:
        """The error for two pictures that do not go together."""
        if shape.is_deep == others_shape.is_deep:
            return RecordingImportError(
                f"the pictures in {str(self.path)!r} have several sizes: {shape.width}x{shape.height} pixels in "
                f"{str(one)!r}, {others_shape.width}x{others_shape.height} in {str(other)!r}; import them one size at "
                "a time."
            )
        deep, picture = (one, other) if shape.is_deep else (other, one)
        way_out = "put the pictures that you mean into a folder of their own."
        if deep.parent != picture.parent:
            chosen = f"choose with '--camera {picture.parent.name}', or " if self._camera is None else ""
            way_out = f"{chosen}name the folders that you mean."
        return RecordingImportError(
            f"{str(self.path)!r} mixes pictures with what may be depth: {str(deep)!r} is grey with 16 bits a pixel, "
            f"{str(picture)!r} is not. Depth is no picture; {way_out}"
        )

    def _damaged(self, file: Path, error: BadPicture, *, is_first: bool) -> RecordingImportError:
        """The error for a picture in whose place none can be taken, or none is to be."""
        way_out = "" if is_first else "; import the others with '--salvage'"
        if self._salvage:
            way_out = ", and no whole picture comes before it in its folder; move it elsewhere"
        return RecordingImportError(f"the picture {str(file)!r} {error}{way_out}.")

    def _shape(self, file: Path, before: Shape | None) -> Shape:
        """What its head says; of a picture that is damaged, where that is to be lived with, that of the one before."""
        try:
            try:
                return shape_of(self._read(file, _HEAD), self._limits)
            except BadPicture:
                return shape_of(self._read(file, None), self._limits)
        except BadPicture as error:
            if before is not None and self._salvage:
                return before
            raise self._damaged(file, error, is_first=before is None) from error

    def _read(self, file: Path, most: int | None) -> CompressedPicture:
        try:
            facts = file.stat()
            if not stat.S_ISREG(facts.st_mode):  # a link may lead to a pipe, or to a device that never ends
                raise BadPicture("is no ordinary file")
            if facts.st_size > self._limits.message_bytes:
                raise BadPicture(f"is a file of more than {self._limits.message_bytes >> 20} MiB")
            with file.open("rb") as opened:
                return CompressedPicture(stamp_ns=0, format=file.suffix[1:], data=opened.read(most))
        except OSError as error:
            raise RecordingImportError(f"cannot read {str(file)!r}: {error.strerror}.") from error


def _told_of_rates(pictures: Counter[float]) -> list[str]:
    """What is told of the rates that the times in names tell, by how many pictures have each."""
    if not pictures:
        return []
    rate = pictures.most_common(1)[0][0]
    return [f"the names of the pictures are times, as of {rate:g} pictures a second: say '--source-hz {rate:g}'."]


def _told_of_shared(folders: Mapping[Path, tuple[list[str], int]]) -> list[str]:
    """What is told of folders whose pictures may be of several cameras that a number tells apart."""
    for folder, (values, others) in folders.items():
        more = f", and so in {len(folders) - 1:,} more folders" if len(folders) > 1 else ""
        return [
            f"a number in the names of the pictures in {str(folder)!r} is {' or '.join(values)} with each of "
            f"{others:,} others{more}, as the number of a camera or of an episode is, and all of them become one "
            "episode in the order of their names. If they are of several cameras or episodes, move those of each into "
            "a folder of its own; '--camera' then names the folder of a camera."
        ]
    return []


def _told_of_begun(folders: Mapping[Path, tuple[str, int]]) -> list[str]:
    """What is told of folders whose pictures may be of several episodes, as their numbers begin anew."""
    for folder, (first, times) in folders.items():
        more = f", and so in {len(folders) - 1:,} more folders" if len(folders) > 1 else ""
        return [
            f"a number in the names of the pictures in {str(folder)!r} begins anew at {first} {times:,} times{more}, "
            "as the number of a picture does with each episode, and all of them become one recording in the order of "
            "their names. If they are of several episodes, move those of each into a folder of its own."
        ]
    return []
