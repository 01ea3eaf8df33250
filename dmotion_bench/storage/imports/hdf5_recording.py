"""An HDF5 file in robomimic's layout as a recording: one segment a demonstration.

Layout (robomimic.github.io, "Datasets"): ``data/demo_0``, ``data/demo_1`` ... each with ``obs/NAME``, among them
pictures, and ``actions``, a row a picture. A file without ``data`` counts as one demonstration, so that ALOHA's
``observations/images/cam_high`` is found as well. ``hdf5_pictures`` says how pictures may be stored.

Only what the file itself holds is read: links and data sets that lead to other files are passed over or refused, and
so are filters that HDF5 would load a library for.
"""

from __future__ import annotations

import hashlib
import json
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
from dmotion_bench.storage.imports.hdf5_contents import ERRORS, datasets, described, fault, names, own
from dmotion_bench.storage.imports.hdf5_pictures import KINDS, PackedPictures, Pixels, holds_pictures, pictures_of
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.natural_order import natural
from dmotion_bench.storage.imports.recording import Segment, Survey, steady_times

MAGIC: Final = b"\x89HDF\r\n\x1a\n"
DEMONSTRATIONS: Final = "data"
NEXT: Final = "next_obs/"  # robomimic's copy of the pictures, each in the place of the one before it
CHUNK_CACHE: Final = 64 * MIB  # a chunk of many pictures is inflated once, not once a picture
LISTED: Final = 30  # data sets that an error names


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
            found = datasets(file[self._demonstrations[0]])
            pictures = [name for name, dataset in found.items() if holds_pictures(dataset, limits)]
            cameras = [name for name in pictures if not name.startswith(NEXT)] or pictures
            others = [name for name in found if name not in pictures]
            self._camera = self._named(cameras, camera, "camera", found)
            self._actions = None if actions is None else self._named(others, actions, "actions", found)
            known_hz = source_hz or _control_frequency(file)
            self._hz, self._is_rate_assumed = known_hz or default_hz, known_hz is None

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
        segments, count, declared = [], 0, len(self._demonstrations)
        with self._opened() as file:
            for name in self._demonstrations.copy():
                stored = self._dataset(file, name, self._camera)
                if not stored.shape or not len(stored):
                    self._demonstrations.remove(name)
                    continue
                pictures = self._pictures(stored)
                try:
                    for seen, (height, width) in enumerate(pictures.sizes()):
                        progress(count + seen)
                        size = size or (height, width)
                        if (height, width) != size:
                            sizes = f"{size[1]}x{size[0]} pixels at first, {width}x{height} in {stored.name!r}"
                            raise self._bad(f"mixes picture sizes: {sizes}")
                except BadPicture as error:
                    raise self._bad(str(error)) from error
                count += len(stored)
                if count > self._limits.frames:
                    raise self._bad(f"declares more than the {self._limits.frames:,} pictures that can be imported")
                times = steady_times(len(stored), self._hz, self.path)
                segments.append(Segment(times_ns=times, commands=self._commands(file, name, times)))
                progress(count)
        if size is None:
            raise self._bad(f"has no pictures in {self._camera!r}")
        empty = f"{declared - len(segments)} of the {declared} demonstrations in {str(self.path)!r} hold no picture."
        hints = [empty] if len(segments) < declared else []
        return Survey(
            camera=self._camera,
            height=size[0],
            width=size[1],
            segments=segments,
            hints=hints,
            is_rate_assumed=self._is_rate_assumed,
        )

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Read some pictures of a demonstration."""
        with self._opened() as file:
            pictures = self._pictures(self._dataset(file, self._demonstrations[segment], self._camera))
            for number in wanted.tolist():
                try:
                    yield pictures.read(number)
                except BadPicture as error:
                    raise self._bad(str(error)) from error

    def _opened(self) -> h5py.File:
        try:
            return h5py.File(self.path, "r", rdcc_nbytes=CHUNK_CACHE, locking=False)
        except ERRORS as error:
            raise self._bad(f"cannot be read: {str(error)[:120]}") from error

    def _find_demonstrations(self, file: h5py.File) -> list[str]:
        """The paths of the groups that are a demonstration each: those in ``data``, or the whole file."""
        data = own(file, DEMONSTRATIONS)
        if not isinstance(data, h5py.Group):
            return ["/"]
        groups = sorted((name for name in names(data) if isinstance(own(data, name), h5py.Group)), key=natural)
        if not groups:
            raise self._bad(f"has no demonstrations in {DEMONSTRATIONS!r}")
        return [f"/{DEMONSTRATIONS}/{name}" for name in groups]

    def _named(self, given: Sequence[str], asked: str | None, option: str, found: dict[str, h5py.Dataset]) -> str:
        """The data set that is meant: by its path, or by the last part of it."""
        meant = [name for name in given if asked is None or name == asked or name.endswith(f"/{asked.strip('/')}")]
        if asked in meant:
            return asked
        if len(meant) == 1:
            return meant[0]
        if meant:
            many = f"{len(meant)} cameras" if asked is None else f"{len(meant)} data sets {asked!r}"
            listed = "".join(f"\n  --{option} {name}" for name in meant[:LISTED])
            raise self._bad(f"has {many}; choose one:{listed}", stop="")
        first = self._demonstrations[0]
        listed = "".join(f"\n  {name} {described(dataset)}" for name, dataset in list(found.items())[:LISTED])
        wanted = f"{asked!r} for '--{option}'" if asked is not None else f"pictures (bytes: {KINDS})"
        raise self._bad(f"has no {wanted}; in {first!r} are:{listed or ' no data sets'}", stop="")

    def _pictures(self, stored: h5py.Dataset) -> Pixels | PackedPictures:
        if not holds_pictures(stored, self._limits):
            raise self._bad(f"has no pictures in {stored.name!r}, but {described(stored)}")
        try:
            return pictures_of(stored, self._limits)
        except BadPicture as error:
            raise self._bad(str(error)) from error

    def _dataset(self, file: h5py.File, demonstration: str, name: str) -> h5py.Dataset:
        """A data set that the file itself holds."""
        found: h5py.Group | h5py.Dataset | None = file[demonstration]
        for part in name.split("/"):
            found = own(found, part) if isinstance(found, h5py.Group) else None
        if not isinstance(found, h5py.Dataset):
            raise self._bad(f"lacks {name!r} in {demonstration!r}")
        reason = fault(found, self._limits)
        if reason is not None:
            raise self._bad(reason)
        return found

    def _commands(self, file: h5py.File, demonstration: str, times_ns: Int64[np.ndarray, " n"]) -> Commands | None:
        if self._actions is None:
            return None
        given = self._dataset(file, demonstration, self._actions)
        if len(given.shape) not in (1, 2) or len(given) not in (len(times_ns), len(times_ns) - 1):
            raise self._bad(
                f"has {described(given)} as actions in {given.name!r}; there must be one for each of the "
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
        except ERRORS as error:
            raise self._bad(f"is damaged: {given.name!r}: {str(error)[:120]}") from error
        return DiscreteCommands(times_ns=times_ns[: len(names)], names=names)

    def _continuous(self, given: h5py.Dataset, times_ns: Int64[np.ndarray, " n"]) -> ContinuousCommands:
        try:
            values = np.asarray(given[()])
        except ERRORS as error:
            raise self._bad(f"is damaged: {given.name!r}: {str(error)[:120]}") from error
        feature = str(given.name).rpartition("/")[2]
        try:
            return from_rows(values, times_ns[: len(values)], feature, fields=self._fields, most=self._limits.numbers)
        except BadCommands as error:
            raise self._bad(f"{error} ({given.name!r})") from error

    def _bad(self, reason: str, stop: str = ".") -> RecordingImportError:
        return RecordingImportError(f"the HDF5 file {str(self.path)!r} {reason}{stop}")


def _control_frequency(file: h5py.File) -> float | None:
    """Steps a second of the environment, as robomimic keeps it beside the demonstrations."""
    try:
        told = json.loads(file[DEMONSTRATIONS].attrs["env_args"])["env_kwargs"]["control_freq"]
    except (*ERRORS, RecursionError):
        return None
    return float(told) if isinstance(told, int | float) and 0.001 <= told <= 10_000 else None
