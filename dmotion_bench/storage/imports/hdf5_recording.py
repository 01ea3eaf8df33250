"""An HDF5 file in robomimic's layout as a recording: one segment a demonstration.

Layout (robomimic.github.io, "Datasets"): ``data/demo_0``, ``data/demo_1`` ... each with ``obs/NAME``, among them
pictures as bytes of the shape n x height x width x 3, and ``actions``, a row a picture. A file without ``data`` counts
as one demonstration, so that ``observations/images/top`` is found as well.

Only what the file itself holds is read: links and data sets that lead to other files are passed over or refused, and
so are filters that HDF5 would load a library for.
"""

from __future__ import annotations

import hashlib
import json
import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Final

import h5py
import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture
from dmotion_bench.storage.imports.commands import Commands, DiscreteCommands, action_name
from dmotion_bench.storage.imports.continuous_commands import BadCommands, ContinuousCommands, from_rows
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.natural_order import natural
from dmotion_bench.storage.imports.recording import Segment, Survey, steady_times

MAGIC: Final = b"\x89HDF\r\n\x1a\n"
DEMONSTRATIONS: Final = "data"
CHUNK_CACHE: Final = 64 * MIB  # a chunk of many pictures is inflated once, not once a picture
LISTED: Final = 30  # data sets that an error names
_LZF: Final = 32000  # h5py's own
_BUILT_IN: Final = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, _LZF}
_DEEPEST, _MOST = 6, 100_000  # levels and names of a file that are looked at
_ERRORS: Final = (OSError, RuntimeError, ValueError, KeyError, TypeError, IndexError, OverflowError)
"""All that h5py makes of damage."""


class Hdf5Recording:
    """One file.

    Args:
        path: The file.
        camera: The path of the pictures within a demonstration, or its last part; None for the only one.
        actions: The path of the actions, or its last part; None for none.
        action_fields: Names of the columns that count, ``"actions.0"``; none for all.
        source_hz: Pictures a second; None for what the file says of its environment, or ``default_hz``.
        default_hz: Where nothing else is known.
        limits: What the file may make us do.

    Raises:
        RecordingImportError: No HDF5 file, or it lacks the pictures or the actions.
    """

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None,
        actions: str | None,
        action_fields: Sequence[str] = (),
        source_hz: float | None,
        default_hz: float,
        limits: ImportLimits,
    ) -> None:
        self.path, self._limits, self._fields, self.unreadable = path, limits, tuple(action_fields), 0
        with self._opened() as file:
            self._demonstrations = self._find_demonstrations(file)
            found = _datasets(file[self._demonstrations[0]])
            cameras = [name for name, dataset in found.items() if _is_camera(dataset)]
            others = [name for name in found if name not in cameras]
            self._camera = self._named(cameras, camera, "camera", found)
            self._actions = None if actions is None else self._named(others, actions, "actions", found)
            self._hz = source_hz or _control_frequency(file) or default_hz

    def sha256(self) -> str:
        """Of the whole file."""
        with self.path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Read the shapes, and the actions.

        Raises:
            RecordingImportError: As the file deserves it.
        """
        size: tuple[int, int] | None = None
        segments, count = [], 0
        with self._opened() as file:
            for name in self._demonstrations.copy():
                pictures = self._pictures(file, name)
                frames, height, width = pictures.shape[:3]
                if not frames:
                    self._demonstrations.remove(name)
                    continue
                size = size or (height, width)
                if (height, width) != size:
                    sizes = f"{size[1]}x{size[0]} pixels at first, {width}x{height} in {pictures.name!r}"
                    raise self._bad(f"mixes picture sizes: {sizes}")
                count += frames
                if count > self._limits.frames:
                    raise self._bad(f"declares more than the {self._limits.frames:,} pictures that can be imported")
                times = steady_times(frames, self._hz, self.path)
                segments.append(Segment(times_ns=times, commands=self._commands(file, name, times)))
                progress(count)
        if size is None:
            raise self._bad(f"has no pictures in {self._camera!r}")
        return Survey(camera=self._camera, height=size[0], width=size[1], segments=segments)

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Read some pictures of a demonstration."""
        with self._opened() as file:
            pictures = self._pictures(file, self._demonstrations[segment])
            for number in wanted.tolist():
                try:
                    picture = np.asarray(pictures[number])
                except _ERRORS as error:
                    raise self._bad(f"is damaged: picture {number} of {pictures.name!r}: {str(error)[:120]}") from error
                yield np.ascontiguousarray(picture[..., [0, 0, 0]] if picture.shape[2] == 1 else picture[..., :3])

    def _opened(self) -> h5py.File:
        try:
            return h5py.File(self.path, "r", rdcc_nbytes=CHUNK_CACHE, locking=False)
        except _ERRORS as error:
            raise self._bad(f"cannot be read: {str(error)[:120]}") from error

    def _find_demonstrations(self, file: h5py.File) -> list[str]:
        """The paths of the groups that are a demonstration each: those in ``data``, or the whole file."""
        data = _own(file, DEMONSTRATIONS)
        if not isinstance(data, h5py.Group):
            return ["/"]
        names = sorted((name for name in _names(data) if isinstance(_own(data, name), h5py.Group)), key=natural)
        if not names:
            raise self._bad(f"has no demonstrations in {DEMONSTRATIONS!r}")
        return [f"/{DEMONSTRATIONS}/{name}" for name in names]

    def _named(self, names: Sequence[str], asked: str | None, option: str, found: dict[str, h5py.Dataset]) -> str:
        """The data set that is meant: by its path, or by the last part of it."""
        meant = [name for name in names if asked is None or name == asked or name.endswith(f"/{asked.strip('/')}")]
        if asked in meant:
            return asked
        if len(meant) == 1:
            return meant[0]
        first = self._demonstrations[0]
        if asked is None and names:
            listed = "".join(f"\n  --camera {name}" for name in names[:LISTED])
            raise self._bad(f"has {len(names)} cameras; choose one:{listed}", stop="")
        listed = "".join(f"\n  {name} {_described(dataset)}" for name, dataset in list(found.items())[:LISTED])
        wanted = f"{asked!r} for '--{option}'" if asked is not None else "pictures (bytes, n x height x width x 3)"
        raise self._bad(f"has no {wanted}; in {first!r} are:{listed or ' no data sets'}", stop="")

    def _pictures(self, file: h5py.File, demonstration: str) -> h5py.Dataset:
        pictures = self._dataset(file, demonstration, self._camera)
        if not _is_camera(pictures):
            raise self._bad(f"has no pictures in {pictures.name!r}, but {_described(pictures)}")
        count, height, width = pictures.shape[:3]
        if not 0 < height * width <= self._limits.pixels:
            raise self._bad(f"declares pictures of {width}x{height} pixels in {pictures.name!r}")
        if count > self._limits.frames:
            raise self._bad(f"declares more than the {self._limits.frames:,} pictures that can be imported")
        if not _is_filled(pictures):
            raise self._bad(f"declares {count:,} pictures in {pictures.name!r} and holds fewer")
        return pictures

    def _dataset(self, file: h5py.File, demonstration: str, name: str) -> h5py.Dataset:
        """A data set that the file itself holds."""
        found: h5py.Group | h5py.Dataset | None = file[demonstration]
        for part in name.split("/"):
            found = _own(found, part) if isinstance(found, h5py.Group) else None
        if not isinstance(found, h5py.Dataset):
            raise self._bad(f"lacks {name!r} in {demonstration!r}")
        try:
            if found.is_virtual or found.external:
                raise self._bad(f"keeps {found.name!r} in another file")
            created = found.id.get_create_plist()
            foreign = {created.get_filter(number)[0] for number in range(created.get_nfilters())} - _BUILT_IN
            chunk = math.prod(found.chunks) * found.dtype.itemsize if found.chunks else 0
        except _ERRORS as error:
            raise self._bad(f"is damaged at {name!r} in {demonstration!r}: {str(error)[:120]}") from error
        if foreign:
            raise self._bad(f"has {found.name!r} packed by a plug-in; repack it with 'h5repack -f GZIP=4 IN OUT'")
        if chunk > self._limits.message_bytes:
            raise self._bad(f"has chunks of {chunk / MIB:,.0f} MiB in {found.name!r}")
        return found

    def _commands(self, file: h5py.File, demonstration: str, times_ns: Int64[np.ndarray, " n"]) -> Commands | None:
        if self._actions is None:
            return None
        given = self._dataset(file, demonstration, self._actions)
        if len(given.shape) not in (1, 2) or len(given) not in (len(times_ns), len(times_ns) - 1):
            raise self._bad(
                f"has {_described(given)} as actions in {given.name!r}; there must be one for each of the "
                f"{len(times_ns)} pictures"
            )
        if given.size * given.dtype.itemsize > self._limits.message_bytes:
            raise self._bad(f"declares {given.size:,} numbers as actions in {given.name!r}")
        if given.dtype.kind == "f" or self._fields:
            return self._continuous(given, times_ns)
        try:
            values = (given.asstr() if h5py.check_string_dtype(given.dtype) else given)[()].tolist()
            rows = [row[0] if isinstance(row, list) and len(row) == 1 else row for row in values]
            names = [action_name(row) for row in rows]
        except BadPicture as error:
            raise self._bad(f"{error} ({given.name!r})") from error
        except _ERRORS as error:
            raise self._bad(f"is damaged: {given.name!r}: {str(error)[:120]}") from error
        return DiscreteCommands(times_ns=times_ns[: len(names)], names=names)

    def _continuous(self, given: h5py.Dataset, times_ns: Int64[np.ndarray, " n"]) -> ContinuousCommands:
        try:
            values = np.asarray(given[()])
        except _ERRORS as error:
            raise self._bad(f"is damaged: {given.name!r}: {str(error)[:120]}") from error
        feature = str(given.name).rpartition("/")[2]
        try:
            return from_rows(values, times_ns[: len(values)], feature, fields=self._fields, most=self._limits.numbers)
        except BadCommands as error:
            raise self._bad(f"{error} ({given.name!r})") from error

    def _bad(self, reason: str, stop: str = ".") -> RecordingImportError:
        return RecordingImportError(f"the HDF5 file {str(self.path)!r} {reason}{stop}")


def _names(group: h5py.Group) -> list[str]:
    try:
        return [name for name, _ in zip(group, range(_MOST), strict=False)]
    except _ERRORS:
        return []


def _own(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """What stands under a name in the file itself; None for nothing, and for links to elsewhere."""
    try:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            return None
        found = group[name]
    except _ERRORS:
        return None
    return found if isinstance(found, h5py.Group | h5py.Dataset) else None


def _datasets(group: h5py.Group, prefix: str = "", depth: int = 0) -> dict[str, h5py.Dataset]:
    """The data sets in a group by their paths within it; a file can lead in circles, so there is a deepest level."""
    found: dict[str, h5py.Dataset] = {}
    for name in sorted(_names(group), key=natural):
        inside = _own(group, name)
        if isinstance(inside, h5py.Dataset):
            found[prefix + name] = inside
        elif isinstance(inside, h5py.Group) and depth < _DEEPEST and len(found) < _MOST:
            found |= _datasets(inside, f"{prefix}{name}/", depth + 1)
    return found


def _is_camera(dataset: h5py.Dataset) -> bool:
    try:
        return len(dataset.shape) == 4 and dataset.dtype == np.uint8 and dataset.shape[3] in (1, 3, 4)
    except _ERRORS:
        return False


def _is_filled(dataset: h5py.Dataset) -> bool:
    """Whether all was written that is declared; HDF5 makes up zeros for what was not."""
    try:
        if dataset.chunks is None:
            return bool(dataset.id.get_storage_size() == dataset.size * dataset.dtype.itemsize)
        chunks = zip(dataset.shape, dataset.chunks, strict=True)
        return bool(dataset.id.get_num_chunks() == math.prod(-(-size // chunk) for size, chunk in chunks))
    except _ERRORS:
        return False


def _described(dataset: h5py.Dataset) -> str:
    try:
        return f"{' x '.join(map(str, dataset.shape))} {dataset.dtype}"
    except _ERRORS:
        return "(damaged)"


def _control_frequency(file: h5py.File) -> float | None:
    """Steps a second of the environment, as robomimic keeps it beside the demonstrations."""
    try:
        told = json.loads(file[DEMONSTRATIONS].attrs["env_args"])["env_kwargs"]["control_freq"]
    except (*_ERRORS, RecursionError):
        return None
    return float(told) if isinstance(told, int | float) and 0.001 <= told <= 10_000 else None
