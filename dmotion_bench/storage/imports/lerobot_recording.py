"""A LeRobot data set as a recording: one segment an episode, the pictures out of videos or of tables."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int64, UInt8

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import BadPicture, CompressedPicture
from dmotion_bench.storage.imports.commands import Commands, action_name, from_choices
from dmotion_bench.storage.imports.continuous_commands import BadCommands, ContinuousCommands, from_rows, places_of
from dmotion_bench.storage.imports.episode_faults import EpisodeFaults, Size
from dmotion_bench.storage.imports.lerobot_layout import ACTION_NAMES, LeRobotLayout, Placed
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.pixels import shape_of, to_rgb
from dmotion_bench.storage.imports.recording import Segment, Survey
from dmotion_bench.storage.video.file import VideoFile

FLOATS: Final = ("float16", "float32", "float64")
ROWS: Final = 16  # of a table with pictures that are held at a time
TIMES: Final = "timestamp"
MOST_OFF: Final = 0.05  # of an interval of a picture: so far may a time stamp be off
CENTURY_S: Final = 2**31  # less than one: times are kept in 64 bits


class LeRobotRecording:
    """One data set's folder.

    Args:
        path: The folder.
        camera: The feature of the pictures, ``"observation.images.front"``, or the last part of its name; None for the
            only one.
        actions: The feature of the actions, or the last part of its name; None for none.
        action_fields: Names of the numbers that count in continuous actions; none for all.
        limits: What the files may make us do.
        skip_damaged: Leave damaged episodes out.

    Raises:
        RecordingImportError: Not a data set that can be read, or it lacks the features.
    """

    def __init__(
        self,
        path: Path,
        *,
        camera: str | None,
        actions: str | None,
        action_fields: Sequence[str] = (),
        limits: ImportLimits,
        skip_damaged: bool = False,
    ) -> None:
        self.path, self._limits, self.unreadable = path, limits, 0
        self._fields, self._skip = tuple(action_fields), skip_damaged
        self._layout = LeRobotLayout(path, limits)
        self._camera = self._layout.camera(camera)
        self._actions = None if actions is None else self._layout.numbers(actions)
        kind = self._layout.kind(self._actions or "")
        self._continuous = self._actions is not None and (bool(self._fields) or kind in FLOATS)
        if self._fields:
            self._check_fields(self._actions or "")
        self._stated = self._layout.stated_actions(self._actions or "") if self._continuous else None
        self._vocabulary = [] if self._continuous else self._known_actions()
        self._placed: list[Placed] = []
        self._taken: list[Float[np.ndarray, " n"]] = []  # when, in intervals of a picture, for each episode
        self._size = (0, 0)
        self._numbers: tuple[Path, Any] | None = None  # the table of numbers that was read last

    def sha256(self) -> str:
        """Over the hashes of the files that are read, in the order of their names."""
        digest = hashlib.sha256()
        for path in self._layout.files(self._camera):
            with path.open("rb") as opened:
                digest.update(hashlib.file_digest(opened, "sha256").digest())
        return digest.hexdigest()

    def survey(self, progress: Callable[[int], None] = lambda pictures: None) -> Survey:
        """Read the tables; of the pictures only the first of each file.

        Raises:
            RecordingImportError: As the files deserve it.
        """
        named = self._layout.episodes(self._camera)
        faults = EpisodeFaults(skip=self._skip, several=len(named) > 1)
        sound: list[tuple[Placed, Float[np.ndarray, " n"], Segment]] = []
        sizes, of_files, count = list[Size](), dict[Path, Size](), 0
        for placed in named:
            name = f"episode {placed.number}"
            with faults.of(name):
                self._layout.require_files(placed)
                size = self._picture_size(placed) if placed.video is None else self._video_size(placed.video, of_files)
                taken = self._when_taken(placed)
                times = np.rint((taken - taken[0]) * (1e9 / self._layout.fps)).astype(np.int64)
                commands = self._commands(placed, times)
                segment = Segment(times_ns=times, commands=commands, name=name, source=placed.source)
                sound.append((placed, taken, segment))
                sizes.append(size)
                count += placed.frames
            progress(count)
        if not sound:
            raise faults.nothing_left()
        if len(set(sizes)) > 1 and not self._skip:
            raise self._layout.bad(f"mixes picture sizes: {sorted(set(sizes))[:10]}")
        kept = faults.of_usual_size([segment.name for _, _, segment in sound], sizes)
        self._placed = [sound[place][0] for place in kept]
        self._taken = [sound[place][1] for place in kept]
        self._size = sizes[kept[0]]
        return Survey(
            camera=self._camera,
            height=self._size[0],
            width=self._size[1],
            segments=[sound[place][2] for place in kept],
            skipped=faults.skipped,
        )

    def pictures(self, segment: int, wanted: Int64[np.ndarray, " m"]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        """Decode the episode's stretch of its video, or its rows of a table."""
        placed = self._placed[segment]
        if placed.video is None:
            yield from self._from_table(placed, wanted.tolist())
            return
        with VideoFile(placed.video, pixels=self._limits.pixels) as video:
            seconds = placed.start_s + self._taken[segment][wanted] / self._layout.fps
            yield from video.frames_at(seconds.tolist(), within=0.5 / self._layout.fps)

    def _video_size(self, file: Path, known: dict[Path, Size]) -> Size:
        if file not in known:
            with VideoFile(file, pixels=self._limits.pixels) as video:
                known[file] = (video.height, video.width)
        return known[file]

    def _picture_size(self, placed: Placed) -> Size:
        (picture,) = self._stored(placed, [0])
        try:
            shape = shape_of(picture, self._limits)
        except BadPicture as error:
            raise self._damaged(placed, 0, error) from error
        if shape.is_deep:
            raise self._layout.bad(
                f"has pictures in {self._camera!r} that are grey with 16 bits a pixel, as depth is stored; depth is no "
                "picture: choose another camera with '--camera KEY'"
            )
        return shape.height, shape.width

    def _from_table(self, placed: Placed, wanted: list[int]) -> Iterator[UInt8[np.ndarray, "h w 3"]]:
        for number, picture in zip(wanted, self._stored(placed, wanted), strict=True):
            try:
                pixels = to_rgb(picture, self._limits)
            except BadPicture as error:
                raise self._damaged(placed, number, error) from error
            if pixels.shape[:2] != self._size:
                height, width = pixels.shape[:2]
                raise self._layout.bad(
                    f"mixes picture sizes: {width}x{height} pixels at frame {number} of episode {placed.number}"
                )
            yield pixels

    def _damaged(self, placed: Placed, number: int, error: BadPicture) -> RecordingImportError:
        return self._layout.bad(f"has a picture that {error} (frame {number} of episode {placed.number})")

    def _stored(self, placed: Placed, wanted: list[int]) -> Iterator[CompressedPicture]:
        """Some of an episode's pictures, still packed; a few rows of the table are held at a time."""
        import pyarrow.parquet as parquet
        from pyarrow import ArrowException

        rows = self._rows(placed)
        waiting = list(reversed(wanted))
        try:
            with parquet.ParquetFile(placed.data, pre_buffer=False, buffer_size=1 << 20) as table:
                if self._camera not in table.schema_arrow.names:
                    raise self._layout.bad(f"lacks the column {self._camera!r} in {placed.data.name!r}")
                start = 0
                for group in range(table.num_row_groups):
                    stop = start + table.metadata.row_group(group).num_rows
                    if waiting and start <= rows[waiting[-1]] < stop:
                        at = start
                        for batch in table.iter_batches(
                            ROWS, row_groups=[group], columns=[self._camera], use_threads=False
                        ):
                            while waiting and rows[waiting[-1]] < at + len(batch):
                                frame = waiting.pop()
                                yield self._picture(placed, frame, batch.column(0)[rows[frame] - at].as_py())
                            at += len(batch)
                            if not waiting or rows[waiting[-1]] >= stop:
                                break
                    start = stop
        except (ArrowException, OSError) as error:
            raise self._layout.bad(f"has a damaged table {placed.data.name!r}: {str(error)[:120]}") from error
        if waiting:
            raise self._layout.bad(f"lacks frame {waiting[-1]} of episode {placed.number}")

    def _picture(self, placed: Placed, frame: int, stored: Any) -> CompressedPicture:
        """A picture as Hugging Face's ``Image`` keeps it: its bytes, or the name of a file beside the table."""
        data = stored.get("bytes") if isinstance(stored, dict) else stored
        if not isinstance(data, bytes):
            file = self._layout.picture_file(self._camera, placed.number, frame)
            if file.stat().st_size > self._limits.message_bytes:
                raise self._layout.bad(
                    f"has a picture of more than {self._limits.message_bytes >> 20} MiB: {file.name!r}"
                )
            data = file.read_bytes()
        return CompressedPicture(stamp_ns=0, format="png", data=data)

    def _rows(self, placed: Placed) -> list[int]:
        """The rows of an episode in its table, in the order of its frames."""
        table = self._table(placed)
        inside = np.flatnonzero(table.column("episode_index").to_numpy() == placed.number)
        if not np.array_equal(table.column("frame_index").to_numpy()[inside], np.arange(placed.frames)):
            raise self._layout.bad(f"lacks rows of episode {placed.number}, or has them out of order")
        rows: list[int] = inside.tolist()
        return rows

    def _when_taken(self, placed: Placed) -> Float[np.ndarray, " n"]:
        """When each picture of an episode was taken, in intervals of a picture: by the time stamps, if there are any.

        A time stamp that is as good as a whole interval is one: 32 bits keep few digits, and edges should not move.

        Raises:
            RecordingImportError: The time stamps cannot be.
        """
        fps, taken = self._layout.fps, np.arange(placed.frames, dtype=np.float64)
        table = self._table(placed)
        if TIMES in table.column_names:
            stamps = table.column(TIMES).take(self._rows(placed)).to_numpy(zero_copy_only=False).astype(np.float64)
            interval = float(np.median(np.diff(stamps))) if placed.frames > 1 else 1 / fps
            if not abs(interval * fps - 1) <= MOST_OFF:
                raise self._layout.bad(
                    f"says that it has {fps:g} frames a second, but the time stamps of episode {placed.number} are "
                    f"{interval:.3g} s apart"
                )
            back = np.flatnonzero(~(np.diff(stamps) > 0))
            if len(back):
                raise self._layout.bad(f"goes back in time at frame {back[0] + 1} of episode {placed.number}")
            whole = np.rint(stamps * fps)
            taken = whole if np.abs(stamps * fps - whole).max() <= MOST_OFF else stamps * fps
        if not np.abs(taken / fps).max() < CENTURY_S:
            raise self._layout.bad(f"has pictures in episode {placed.number} at times that cannot be")
        return taken

    def _table(self, placed: Placed) -> Any:
        """The numbers of an episode's frames; episodes stand side by side in few files."""
        if self._numbers is None or self._numbers[0] != placed.data:
            columns = ["episode_index", "frame_index", *([self._actions] if self._actions is not None else [])]
            self._numbers = placed.data, self._layout.table(placed.data, columns, also=(TIMES,))
        return self._numbers[1]

    def _commands(self, placed: Placed, times_ns: Int64[np.ndarray, " n"]) -> Commands | None:
        if self._actions is None:
            return None
        column = self._table(placed).column(self._actions)
        if self._continuous:
            return self._continuous_commands(placed, column, times_ns)
        try:
            return from_choices(column.take(self._rows(placed)).to_pylist(), times_ns, self._vocabulary)
        except BadPicture as error:
            raise self._layout.bad(f"{error} (feature {self._actions!r}, episode {placed.number})") from error

    def _check_fields(self, key: str) -> None:
        """See that the data set has the fields, where it names all: a name that none has is no damage of an episode."""
        names = self._layout.number_names(key)
        if not names or self._layout.features[key].get("shape") != [len(names)]:
            return
        try:
            places_of(self._fields, names)
        except BadCommands as error:
            raise self._layout.bad(f"{error} (feature {key!r})") from error

    def _continuous_commands(
        self, placed: Placed, column: Any, times_ns: Int64[np.ndarray, " n"]
    ) -> ContinuousCommands:
        key = self._actions or ""
        try:
            return from_rows(
                _matrix(column, self._rows(placed), self._limits.numbers),
                times_ns,
                key,
                names=self._layout.number_names(key),
                fields=self._fields,
                stated=self._stated,
                most=self._limits.numbers,
            )
        except BadCommands as error:
            raise self._layout.bad(f"{error} (feature {key!r}, episode {placed.number})") from error

    def _known_actions(self) -> list[str]:
        """The names of the actions in the order of their numbers, where ``data export`` has left them."""
        try:
            names = [action_name(name) for name in self._layout.action_names(self._actions or "")]
        except BadPicture as error:
            raise self._layout.bad(f"{error} ({ACTION_NAMES} of the feature {self._actions!r})") from error
        if len(set(names)) < len(names):
            twice = next(name for name in names if names.count(name) > 1)
            raise self._layout.bad(f"names two actions {twice!r} ({ACTION_NAMES} of the feature {self._actions!r})")
        return names


def _matrix(column: Any, rows: list[int], most: int) -> np.ndarray[Any, Any]:
    """Some rows of a column of numbers, or of lists of numbers that are all as long; the last may lack numbers.

    That one leads to no picture, and is left out then.

    Raises:
        BadCommands: They are something else.
    """
    import pyarrow as pa
    import pyarrow.compute as compute

    values = column.take(pa.array(rows, pa.int64())).combine_chunks()
    width = 1
    if pa.types.is_list(values.type) or pa.types.is_fixed_size_list(values.type) or pa.types.is_large_list(values.type):
        if len(values) and not values[-1].as_py():
            values = values[:-1]
        lengths = compute.list_value_length(values)
        if lengths.null_count or len(compute.unique(lengths)) > 1:
            raise BadCommands("has actions with different numbers of components")
        width = lengths[0].as_py() if len(lengths) else 1
        values = values.flatten()
    if len(values) > most:
        raise BadCommands(f"holds {len(values):,} numbers as actions, more than the {most:,} that can be imported")
    if not (pa.types.is_floating(values.type) or pa.types.is_integer(values.type)):
        raise BadCommands(f"holds {values.type} as actions, which is no number")
    needed = values[: (len(rows) - 1) * width]
    if needed.null_count:
        raise BadCommands("lacks numbers of its actions")
    values = needed if values.null_count else values
    count = len(rows) - (len(values) < len(rows) * width)
    matrix: np.ndarray[Any, Any] = values.to_numpy(zero_copy_only=False).reshape(count, width)
    return matrix
