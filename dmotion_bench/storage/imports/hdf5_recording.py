"""An HDF5 file in robomimic's layout as a recording: one segment a demonstration.

Layout (robomimic.github.io, "Datasets"): ``data/demo_0``, ``data/demo_1`` ... each with ``obs/NAME``, among them
pictures, and ``actions``, a row a picture. Demonstrations may stand at the root as well, ManiSkill's ``traj_0``,
``traj_1`` ... Any other file counts as one demonstration, so that ALOHA's ``observations/images/cam_high`` is found.
``hdf5_pictures`` says how pictures may be stored.

Only what the file itself holds is read: links and data sets that lead to other files are passed over or refused, and
so are filters that HDF5 would load a library for.
"""

from __future__ import annotations

import hashlib
import itertools
import json
import math
import re
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Final

import h5py
import numpy as np
from jaxtyping import Int64, UInt8

from dmotion_bench.actions import MOST_NUMBERS
from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture
from dmotion_bench.storage.imports.commands import Commands, from_choices
from dmotion_bench.storage.imports.continuous_commands import (
    BadCommands,
    ContinuousCommands,
    column_names,
    from_rows,
    places_of,
)
from dmotion_bench.storage.imports.episode_faults import EpisodeFaults, Size
from dmotion_bench.storage.imports.hdf5_contents import ERRORS, datasets, described, fault, names, own
from dmotion_bench.storage.imports.hdf5_ends import episode_ends
from dmotion_bench.storage.imports.hdf5_pictures import KINDS, PackedPictures, Pixels, holds_pictures, pictures_of
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.natural_order import natural
from dmotion_bench.storage.imports.near_names import did_you_mean
from dmotion_bench.storage.imports.recording import Segment, Survey, steady_times
from dmotion_bench.wording import counted, shown

DEMONSTRATIONS: Final = "data"
NEXT: Final = "next_obs/"  # robomimic's copy of the pictures, each in the place of the one before it
CHUNK_CACHE: Final = 64 * MIB  # a chunk of many pictures is inflated once, not once a picture
_WHOLE: Final = "/"  # the demonstration of a file that has no group for each
_NUMBER: Final = re.compile(r"\d+")
_CALLED: Final = frozenset({"demo_#", "episode_#", "traj_#"})
"""What groups at the root are called that are demonstrations (ManiSkill: ``traj_0``), whatever is in them."""
_COMPARED: Final = 8  # groups that are looked into to tell demonstrations from cameras
LISTED: Final = 30  # data sets that an error names
_NAMED: Final = 5  # groups in a sentence


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
        skip_damaged: Leave damaged demonstrations out.

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
        skip_damaged: bool = False,
    ) -> None:
        self.path, self._limits, self._fields, self.unreadable = path, limits, tuple(action_fields), 0
        self._skip, self._demonstrations = skip_damaged, list[str]()
        with self._opened() as file:
            self._declared = self._find_demonstrations(file)
            found, pictures = self._typical(file, camera)
            cameras = [name for name in pictures if not name.startswith(NEXT)] or pictures
            if camera is None:  # numbers with fractions may be something else, such as points in space
                cameras = [name for name in cameras if found[name].dtype.kind != "f"] or cameras
            others = [name for name in found if name not in pictures]
            self._camera = self._named(cameras, camera, "camera", found)
            self._actions = None if actions is None else self._named(others, actions, "actions", found)
            if self._actions is not None and self._fields:
                self._check_fields(found[self._actions])
            if self._declared == [_WHOLE]:
                self._check_is_one(found)
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
        faults = EpisodeFaults(skip=self._skip, several=len(self._declared) > 1)
        sound, sizes = list[tuple[str, Segment]](), list[Size]()
        count = empty = 0
        with self._opened() as file:
            for name in self._declared:
                with faults.of(name):
                    stored = self._dataset(file, name, self._camera)
                    if not stored.shape or not len(stored):
                        empty += 1
                        continue
                    size = self._one_size(stored, None if self._skip or not sizes else sizes[0], progress, count)
                    if count + len(stored) <= self._limits.frames:
                        times = steady_times(len(stored), self._hz, self.path)
                        commands = self._commands(file, name, times)
                        sound.append((name, Segment(times_ns=times, commands=commands, name=name)))
                        sizes.append(size)
                    count += len(stored)
                if count > self._limits.frames:
                    raise self._bad(f"declares more than the {self._limits.frames:,} pictures that can be imported")
                progress(count)
        if not sound:
            raise faults.nothing_left() if faults.skipped else self._bad(f"has no pictures in {self._camera!r}")
        kept = faults.of_usual_size([name for name, _ in sound], sizes)
        self._demonstrations = [sound[place][0] for place in kept]
        height, width = sizes[kept[0]]
        told = f"{empty} of the {len(self._declared)} demonstrations in {str(self.path)!r} hold no picture."
        return Survey(
            camera=self._camera,
            height=height,
            width=width,
            segments=[sound[place][1] for place in kept],
            hints=[told] if empty else [],
            told=self._told_of_names(),
            skipped=faults.skipped,
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

    def _told_of_names(self) -> list[str]:
        """What is told of groups that are taken for demonstrations, and whose names are not of one kind."""
        called = [name.rpartition("/")[2] for name in self._declared]
        if len({_NUMBER.sub("#", name) for name in called}) < 2:
            return []
        listed = ", ".join(map(shown, called[:_NAMED])) + (" and more" if len(called) > _NAMED else "")
        return [
            f"the groups in {DEMONSTRATIONS!r} of {str(self.path)!r} are called {listed}, and each is imported as a "
            "demonstration. If they are cameras of one, copy them into one group, such as "
            f"'{DEMONSTRATIONS}/demo_0/NAME': '--camera' then chooses."
        ]

    def _one_size(self, stored: h5py.Dataset, before: Size | None, progress: Callable[[int], None], count: int) -> Size:
        """Height and width of a demonstration's pictures, which must be those of the pictures before, if any."""
        try:
            for seen, (height, width) in enumerate(self._pictures(stored).sizes()):
                progress(count + seen)
                before = before or (height, width)
                if (height, width) != before:
                    sizes = f"{before[1]}x{before[0]} pixels at first, {width}x{height} in {stored.name!r}"
                    raise self._bad(f"mixes picture sizes: {sizes}")
        except BadPicture as error:
            raise self._bad(str(error)) from error
        assert before is not None
        return before

    def _opened(self) -> h5py.File:
        try:
            return h5py.File(self.path, "r", rdcc_nbytes=CHUNK_CACHE, locking=False)
        except ERRORS as error:
            raise self._bad(f"cannot be read: {str(error)[:120]}") from error

    def _find_demonstrations(self, file: h5py.File) -> list[str]:
        """The paths of the groups that are a demonstration each: those in ``data``, at the root, or the whole file."""
        data = own(file, DEMONSTRATIONS)
        if not isinstance(data, h5py.Group):
            groups = _groups(file)
            return [f"/{name}" for name in groups] if self._are_demonstrations(file, groups) else [_WHOLE]
        groups = _groups(data)
        if not groups:
            listed = "".join(f"\n  {name} {described(found)}" for name, found in list(datasets(file).items())[:LISTED])
            raise self._bad(
                f"has no demonstrations in {DEMONSTRATIONS!r}: each must be a group with its own pictures and actions, "
                f"such as '{DEMONSTRATIONS}/demo_0/obs/image'. If the episodes stand one behind the other, as in a "
                f"replay buffer, write each into a group of its own. In the file are:{listed or ' no data sets'}",
                stop="",
            )
        return [f"/{DEMONSTRATIONS}/{name}" for name in groups]

    def _are_demonstrations(self, file: h5py.File, groups: Sequence[str]) -> bool:
        """Whether groups at the root are a demonstration each, and no cameras or sensors of a single one.

        Their names differ in their numbers alone, and no data set stands beside them; the data sets in the first of
        them are mostly the same. Unless they are called as demonstrations are, a table must have a row for each
        picture, as actions and states do.
        """
        patterns = {_NUMBER.sub("#", name) for name in groups}
        if len(groups) < 2 or len(patterns) > 1:
            return False
        if any(isinstance(own(file, name), h5py.Dataset) for name in names(file)):
            return False
        inside = [datasets(file[name]) for name in groups[:_COMPARED]]
        paths, count = Counter(frozenset(found) for found in inside).most_common(1)[0]
        if 2 * count <= len(inside):
            return False
        usual = next(found for found in inside if found.keys() == paths)
        shapes = [one.shape for one in usual.values()]
        counts = {len(one) for one in usual.values() if holds_pictures(one, self._limits)}
        if patterns <= _CALLED:
            return bool(counts)
        return any(len(shape) == 2 and {shape[0], shape[0] + 1} & counts for shape in shapes)

    def _check_is_one(self, found: Mapping[str, h5py.Dataset]) -> None:
        """See that the data sets of a file without a group for each demonstration hold a single one.

        Raises:
            RecordingImportError: They hold several, one behind the other, as a replay buffer does.
        """
        count = len(found[self._camera])
        for name, dataset in found.items():
            if ends := episode_ends(name, dataset, count, self._limits):
                raise self._bad(
                    f"holds several episodes, one behind the other: {name!r} tells of {counted(ends, 'end')} among its "
                    f"{count:,} pictures. Write each episode into a group of its own, such as "
                    f"'{DEMONSTRATIONS}/demo_0/obs/image' and '{DEMONSTRATIONS}/demo_0/actions'"
                )

    def _typical(self, file: h5py.File, camera: str | None) -> tuple[dict[str, h5py.Dataset], list[str]]:
        """The data sets of the demonstration by which all are read, and those of them with pictures.

        It is the first one; where damaged ones are left out, the first that has the camera.
        """
        seen = (datasets(file[name]) for name in (self._declared if self._skip else self._declared[:1]))
        looked_at = ((found, [name for name in found if holds_pictures(found[name], self._limits)]) for found in seen)
        first = next(looked_at)
        return next((one for one in itertools.chain([first], looked_at) if _meant(one[1], camera)), first)

    def _named(self, given: Sequence[str], asked: str | None, option: str, found: dict[str, h5py.Dataset]) -> str:
        """The data set that is meant: by its path, or by the last part of it."""
        meant = _meant(given, asked)
        if asked in meant:
            return asked
        if len(meant) == 1:
            return meant[0]
        if meant:
            many = f"{len(meant)} cameras" if asked is None else f"{len(meant)} data sets {asked!r}"
            listed = "".join(f"\n  --{option} {name}" for name in meant[:LISTED])
            hint = ""
            if self._declared == [_WHOLE] and len({_NUMBER.sub("#", name) for name in meant}) < len(meant):
                hint = f"\nIf each is of another episode, move the episodes' groups into {DEMONSTRATIONS!r}."
            raise self._bad(f"has {many}; choose one:{listed}{hint}", stop="")
        first = self._declared[0]
        listed = "".join(f"\n  {name} {described(dataset)}" for name, dataset in list(found.items())[:LISTED])
        wanted = f"{asked!r} for '--{option}'" if asked is not None else f"pictures ({KINDS})"
        hint = "" if asked is None else did_you_mean(given, asked)
        where = f"{'In' if hint else 'in'} {first!r} are:{listed or ' no data sets'}"
        raise self._bad(f"has no {wanted}; {hint}{where}", stop="")

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
        if not given.shape or len(given) not in (len(times_ns), len(times_ns) - 1):
            raise self._bad(
                f"has {described(given)} as actions in {given.name!r}; there must be one for each of the "
                f"{len(times_ns)} pictures"
            )
        if given.size * given.dtype.itemsize > self._limits.message_bytes:
            raise self._bad(f"declares {given.size:,} numbers as actions in {given.name!r}")
        if given.dtype.kind == "f" or self._fields:
            return self._continuous(given, times_ns)
        try:
            rows = (given.asstr() if h5py.check_string_dtype(given.dtype) else given)[()].tolist()
            return from_choices(rows, times_ns)
        except BadPicture as error:
            raise self._bad(f"{error} ({given.name!r})") from error
        except ERRORS as error:
            raise self._bad(f"is damaged: {given.name!r}: {str(error)[:120]}") from error

    def _check_fields(self, given: h5py.Dataset) -> None:
        """See that the first demonstration has the fields: a name that none has is no damage of one."""
        width = math.prod(given.shape[1:])
        try:
            places_of(self._fields, column_names(str(given.name).rpartition("/")[2], (), min(width, MOST_NUMBERS)))
        except BadCommands as error:
            raise self._bad(f"{error} ({given.name!r})") from error

    def _continuous(self, given: h5py.Dataset, times_ns: Int64[np.ndarray, " n"]) -> ContinuousCommands:
        try:
            values = np.asarray(given[()])
        except ERRORS as error:
            raise self._bad(f"is damaged: {given.name!r}: {str(error)[:120]}") from error
        feature = str(given.name).rpartition("/")[2]
        try:
            rows = values.reshape(len(values), math.prod(values.shape[1:]))
            return from_rows(rows, times_ns, feature, fields=self._fields, most=self._limits.numbers)
        except BadCommands as error:
            raise self._bad(f"{error} ({given.name!r})") from error

    def _bad(self, reason: str, stop: str = ".") -> RecordingImportError:
        return RecordingImportError(f"the HDF5 file {str(self.path)!r} {reason}{stop}")


def _groups(group: h5py.Group) -> list[str]:
    return sorted((name for name in names(group) if isinstance(own(group, name), h5py.Group)), key=natural)


def _meant(given: Sequence[str], asked: str | None) -> list[str]:
    """The data sets of this path, or whose last part it is; all where none is asked for."""
    return [name for name in given if asked is None or name == asked or name.endswith(f"/{asked.strip('/')}")]


def _control_frequency(file: h5py.File) -> float | None:
    """Steps a second of the environment, as robomimic keeps it beside the demonstrations."""
    data = own(file, DEMONSTRATIONS)
    if data is None:
        return None
    try:
        told = json.loads(data.attrs["env_args"])["env_kwargs"]["control_freq"]
    except (*ERRORS, RecursionError):
        return None
    return float(told) if isinstance(told, int | float) and 0.001 <= told <= 10_000 else None
