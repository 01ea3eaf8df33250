"""``episodes.parquet`` and ``tasks.parquet``: where each episode is, and what the control tasks are.

Both are derived: ``dmbench data repair`` makes them again from the shards. A table is read as columns, after its size,
its footer and the number of its rows have been held against the manifest (``parquet_file.py``).
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, SupportsIndex, overload

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Bool, Int

from dmotion_bench.specs import SplitName
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.limits import INDEX_BYTES, LAST_NS, MOST_EPISODES, longest_episode, most_frames
from dmotion_bench.storage.manifest import TABLES, Manifest
from dmotion_bench.storage.mcap_reader import DamagedFile, lost_is_damaged
from dmotion_bench.storage.mcap_writer import Span
from dmotion_bench.storage.parquet_file import largest_file, read_parquet
from dmotion_bench.storage.shard import EpisodeRow, ended_as, file_facts
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.storage.tasks import ControlTask

EPISODES, TASKS = TABLES
_SPANS: Final = ("video", "states", "masks")
_EPISODE_SCHEMA: Final = pa.schema(
    [
        *(pa.field(name, pa.int64(), False) for name in ("episode", "shard", "frames", "start_ns", "seed")),
        *(pa.field(name, pa.string(), False) for name in ("split", "ended")),
        pa.field("interactions", pa.int64(), False),
        *(pa.field(f"{span}_{part}", pa.int64(), False) for span in _SPANS for part in ("offset", "bytes")),
    ]
)
_SOURCE: Final = "source"
_SCHEMA_BY_SOURCE: Final = _EPISODE_SCHEMA.append(pa.field(_SOURCE, pa.int64(), False))
"""Of a data set whose recipe says that it is split by source."""
_TASK_SCHEMA: Final = pa.schema([pa.field(name, pa.int64(), False) for name in ControlTask._fields])
Columns = Mapping[str, np.ndarray]


class EpisodeTable(Sequence[EpisodeRow]):
    """The rows of ``episodes.parquet``, kept as columns: a hundred bytes an episode.

    Attributes:
        columns: One an entry of the schema but ``split``, which the recipe decides; ``source`` where it is known.
    """

    def __init__(self, columns: Columns) -> None:
        self.columns = columns

    @classmethod
    def of(cls, rows: Sequence[EpisodeRow]) -> EpisodeTable:
        """The table of some rows."""
        names = [name for name in _EPISODE_SCHEMA.names if name != "split"]
        names += [_SOURCE] if all(row.source is not None for row in rows) else []
        return cls({name: np.array([_value(row, name) for row in rows], _dtype(name)) for name in names})

    @property
    def lengths(self) -> Int[np.ndarray, " e"]:
        """Frames of each episode."""
        lengths: Int[np.ndarray, " e"] = self.columns["frames"]
        return lengths

    @property
    def sources(self) -> Int[np.ndarray, " e"] | None:
        """The recording that each episode is a part of; None where the split is by episode."""
        return self.columns.get(_SOURCE)

    def __len__(self) -> int:
        return len(self.columns["frames"])

    @overload
    def __getitem__(self, index: SupportsIndex) -> EpisodeRow: ...

    @overload
    def __getitem__(self, index: slice) -> list[EpisodeRow]: ...

    def __getitem__(self, index: SupportsIndex | slice) -> EpisodeRow | list[EpisodeRow]:
        places = range(len(self))[index]
        return self._row(places) if isinstance(places, int) else [self._row(place) for place in places]

    def _row(self, place: int) -> EpisodeRow:
        values: dict[str, Any] = {name: column[place : place + 1].tolist()[0] for name, column in self.columns.items()}
        spans = {name: Span(values.pop(f"{name}_offset"), values.pop(f"{name}_bytes")) for name in _SPANS}
        return EpisodeRow(**values | {"ended": ended_as(values["ended"])} | spans)

    def of_shard(self, shard: int) -> list[EpisodeRow]:
        """The rows of one shard."""
        return [self[index] for index in np.flatnonzero(self.columns["shard"] == shard).tolist()]


def _value(row: EpisodeRow, name: str) -> Any:
    span, _, part = name.rpartition("_")
    if span in _SPANS:
        return getattr(row, span).offset if part == "offset" else getattr(row, span).size
    return getattr(row, name)


def _dtype(name: str) -> Any:
    return object if _SCHEMA_BY_SOURCE.field(name).type == pa.string() else np.int64


def write_episodes(dataset: Path, table: EpisodeTable, split: Mapping[SplitName, Int[np.ndarray, " n"]]) -> None:
    """Write the table of the episodes, in their order."""
    side = {int(episode): name for name, members in split.items() for episode in members}
    schema = _EPISODE_SCHEMA if table.sources is None else _SCHEMA_BY_SOURCE
    columns: dict[str, Any] = {**table.columns, "split": [side[one] for one in table.columns["episode"].tolist()]}
    _write(dataset / EPISODES, pa.table({name: columns[name] for name in schema.names}, schema))


def write_tasks(dataset: Path, tasks: Sequence[ControlTask]) -> None:
    """Write the table of the control tasks."""
    columns = {name: [getattr(task, name) for task in tasks] for name in ControlTask._fields}
    _write(dataset / TASKS, pa.table(columns, _TASK_SCHEMA))


def _write(path: Path, table: pa.Table) -> None:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
    write_atomically(path, buffer.getvalue(), make_folders=False)


def read_episodes(dataset: Path, manifest: Manifest) -> EpisodeTable:
    """The table of the episodes, checked against the manifest.

    Raises:
        DamagedFile: The table is missing, changed, or contradicts the manifest.
    """
    count = manifest.recipe.episodes
    schema = _SCHEMA_BY_SOURCE if manifest.recipe.splits_by_source else _EPISODE_SCHEMA
    columns = dict(_read(dataset, EPISODES, schema, manifest, range(count, count + 1)))
    if not set(columns.pop("split")) <= set(SPLIT_NAMES):
        raise DamagedFile("puts an episode into a split that does not exist")
    for word in set(columns["ended"]):
        try:
            ended_as(word)
        except ValueError as error:
            raise DamagedFile(f"has a row that cannot be: {error}") from None
    _check_episodes(columns, manifest)
    return EpisodeTable(columns)


def read_tasks(dataset: Path, manifest: Manifest, lengths: Int[np.ndarray, " e"]) -> list[ControlTask]:
    """The table of the control tasks, checked against the episodes' lengths.

    Raises:
        DamagedFile: The table is missing, changed, or names frames that do not exist.
    """
    columns = _read(dataset, TASKS, _TASK_SCHEMA, manifest, range(manifest.recipe.tasks + 1))
    episode, start, goal = (columns[name] for name in ControlTask._fields)
    there = (episode >= 0) & (episode < len(lengths))
    wrong = ~there | (start < 0) | (start >= goal) | (goal >= lengths[np.where(there, episode, 0)])
    tasks = [ControlTask(*row) for row in zip(episode.tolist(), start.tolist(), goal.tolist(), strict=True)]
    if wrong.any():
        raise DamagedFile(f"names the task {tuple(tasks[wrong.argmax()])}, which lies outside its episode")
    return tasks


def _check_episodes(columns: Columns, manifest: Manifest) -> None:
    """See that every row can be true, and all of them together."""
    recipe, spec = manifest.recipe, manifest.spec
    episode, shard, frames = columns["episode"], columns["shard"], columns["frames"]
    _refuse(episode != np.arange(recipe.episodes), "is not in the order of the episodes")
    _refuse(shard != episode // recipe.shard_episodes, "is said to be in another shard than the recipe puts it into")
    _refuse((frames < 1) | (frames > recipe.frames), f"has another number of frames than 1 to {recipe.frames:,}")
    _refuse(frames > most_frames(spec), f"has too many frames; {longest_episode(spec)}")
    starts = columns["start_ns"]
    last = (LAST_NS - np.maximum(starts, 0)) // spec.step_ns  # a product of both might not fit in 64 bits
    _refuse((starts < 0) | (frames > last), "starts at no time that a time stamp can say")
    _refuse(columns["seed"] < 0, "has a negative seed")
    if _SOURCE in columns:
        source = columns[_SOURCE]
        _refuse((source < 0) | (source >= MOST_EPISODES), "is a part of a recording of no possible number")
    steps = columns["interactions"]
    _refuse((steps < 0) | (steps >= frames), "has more interactions than steps")
    shards = np.arange(len(manifest.shards))
    if (np.bincount(shard, frames, len(shards)) != [one.frames for one in manifest.shards]).any():
        raise DamagedFile("lists other numbers of frames than dataset.json")
    video = np.array([one.video.size for one in manifest.shards])
    labels = np.array([one.labels.size if one.labels is not None else 0 for one in manifest.shards])
    _check_spans(columns, ("video",), shard, video)
    _check_spans(columns, ("states", "masks"), shard, labels)
    _refuse(columns["video_bytes"] < frames * INDEX_BYTES, "has more frames than its part of the file can hold")


def _check_spans(
    columns: Columns, names: tuple[str, ...], shard: Int[np.ndarray, " e"], sizes: Int[np.ndarray, " s"]
) -> None:
    """See that the spans of a shard follow one another in its file; without a file they are empty."""
    offsets, lengths = (np.stack([columns[f"{name}_{part}"] for name in names], 1) for part in ("offset", "bytes"))
    there = sizes[shard] > 0
    _refuse((~there[:, None] & ((offsets != 0) | (lengths != 0))).any(1), f"has {names[0]} in a file that is not there")
    _refuse((there[:, None] & ((offsets < 1) | (lengths < 1))).any(1), f"has no {names[0]}")
    _refuse((lengths > sizes[shard][:, None] - offsets).any(1), f"has {names[0]} beyond the end of the file")
    owner, first, last = np.repeat(shard, len(names)), offsets.reshape(-1), (offsets + lengths).reshape(-1)
    overlaps = (owner[1:] == owner[:-1]) & (first[1:] < last[:-1]) & (sizes[owner[1:]] > 0)
    _refuse(np.concatenate([[False], overlaps]), f"has {names[0]} where another's is", len(names))


def _refuse(wrong: Bool[np.ndarray, " n"], what: str, entries: int = 1) -> None:
    if wrong.any():
        raise DamagedFile(f"has a row {int(wrong.argmax()) // entries} that contradicts dataset.json: it {what}")


def _read(dataset: Path, name: str, schema: pa.Schema, manifest: Manifest, counts: range) -> Columns:
    """The columns of a table, whose number of rows is one of ``counts``."""
    path, facts = dataset / name, manifest.tables.get(name)
    if not path.is_file():
        raise DamagedFile("is missing")
    if facts is None or facts.size > largest_file(schema, counts[-1]):
        raise DamagedFile("is not what was written")
    with lost_is_damaged():
        if path.stat().st_size != facts.size or file_facts(path) != facts:
            raise DamagedFile("is not what was written")
    table = read_parquet(path, schema, counts, said_by="dataset.json")
    return {name: _column(table.column(name)) for name in schema.names}


def _column(column: pa.ChunkedArray) -> np.ndarray:
    if column.null_count:
        raise DamagedFile("lacks values")
    if not pa.types.is_dictionary(column.type):
        numbers: np.ndarray = column.to_numpy()
        return numbers
    whole = column.unify_dictionaries().combine_chunks()
    words: np.ndarray = np.array(whole.dictionary.to_pylist(), object)
    chosen: np.ndarray = words[whole.indices.to_numpy(zero_copy_only=False)]
    return chosen
