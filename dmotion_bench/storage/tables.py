"""``episodes.parquet`` and ``tasks.parquet``: where each episode is, and what the control tasks are.

Both are derived: ``dmbench data repair`` makes them again from the shards.
"""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Int

from dmotion_bench.specs import SplitName
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.mcap_writer import Span
from dmotion_bench.storage.shard import EpisodeRow, ended_as, file_facts
from dmotion_bench.storage.tasks import ControlTask

EPISODES: Final = "episodes.parquet"
TASKS: Final = "tasks.parquet"
_SPANS: Final = ("video", "states", "masks")
_EPISODE_SCHEMA: Final = pa.schema(
    [
        *(pa.field(name, pa.int64(), False) for name in ("episode", "shard", "frames", "start_ns", "seed")),
        *(pa.field(name, pa.string(), False) for name in ("split", "ended")),
        pa.field("interactions", pa.int64(), False),
        *(pa.field(f"{span}_{part}", pa.int64(), False) for span in _SPANS for part in ("offset", "bytes")),
    ]
)
_TASK_SCHEMA: Final = pa.schema([pa.field(name, pa.int64(), False) for name in ControlTask._fields])


def _write(path: Path, table: pa.Table) -> None:
    buffer = io.BytesIO()
    pq.write_table(table, buffer, compression="zstd", write_page_checksum=True)
    write_atomically(path, buffer.getvalue())


def write_episodes(dataset: Path, rows: Sequence[EpisodeRow], split: Mapping[SplitName, Int[np.ndarray, " n"]]) -> None:
    """Write the table of the episodes, in their order."""
    side = {int(episode): name for name, members in split.items() for episode in members}
    columns: dict[str, list[Any]] = {
        name: [getattr(row, name) for row in rows]
        for name in ("episode", "shard", "frames", "start_ns", "seed", "ended", "interactions")
    }
    columns["split"] = [side[row.episode] for row in rows]
    for span in _SPANS:
        columns[f"{span}_offset"] = [getattr(row, span).offset for row in rows]
        columns[f"{span}_bytes"] = [getattr(row, span).size for row in rows]
    _write(dataset / EPISODES, pa.table({name: columns[name] for name in _EPISODE_SCHEMA.names}, _EPISODE_SCHEMA))


def write_tasks(dataset: Path, tasks: Sequence[ControlTask]) -> None:
    """Write the table of the control tasks."""
    columns = {name: [getattr(task, name) for task in tasks] for name in ControlTask._fields}
    _write(dataset / TASKS, pa.table(columns, _TASK_SCHEMA))


def _read(dataset: Path, name: str, schema: pa.Schema, manifest: Manifest) -> list[dict[str, Any]]:
    path = dataset / name
    if not path.is_file():
        raise DamagedFile("is missing")
    if file_facts(path) != manifest.tables.get(name):
        raise DamagedFile("is not what was written")
    try:
        table = pq.read_table(path, schema=schema, page_checksum_verification=True)
        rows: list[dict[str, Any]] = table.to_pylist()
    except (pa.ArrowException, OSError) as error:
        raise DamagedFile(f"cannot be read: {error}") from None
    return rows


def read_episodes(dataset: Path, manifest: Manifest) -> list[EpisodeRow]:
    """The table of the episodes, checked against the manifest.

    Raises:
        DamagedFile: The table is missing, changed, or contradicts the manifest.
    """
    rows = []
    for number, values in enumerate(_read(dataset, EPISODES, _EPISODE_SCHEMA, manifest)):
        row = _row(values)
        if (
            row.episode != number
            or not 0 <= row.shard < len(manifest.shards)
            or not 1 <= row.frames <= manifest.recipe.frames
        ):
            raise DamagedFile(f"has a row {number} that contradicts dataset.json")
        rows.append(row)
    if len(rows) != manifest.recipe.episodes or sum(row.frames for row in rows) != sum(
        shard.frames for shard in manifest.shards
    ):
        raise DamagedFile(f"lists {len(rows)} episodes; dataset.json says {manifest.recipe.episodes}")
    return rows


def _row(values: dict[str, Any]) -> EpisodeRow:
    video, states, masks = (Span(values[f"{name}_offset"], values[f"{name}_bytes"]) for name in _SPANS)
    try:
        ended = ended_as(values["ended"])
    except ValueError as error:
        raise DamagedFile(f"has a row that cannot be: {error}") from None
    return EpisodeRow(
        episode=values["episode"],
        shard=values["shard"],
        frames=values["frames"],
        start_ns=values["start_ns"],
        seed=values["seed"],
        ended=ended,
        interactions=values["interactions"],
        video=video,
        states=states,
        masks=masks,
    )


def read_tasks(dataset: Path, manifest: Manifest, lengths: Int[np.ndarray, " e"]) -> list[ControlTask]:
    """The table of the control tasks, checked against the episodes' lengths.

    Raises:
        DamagedFile: The table is missing, changed, or names frames that do not exist.
    """
    tasks = [ControlTask(**values) for values in _read(dataset, TASKS, _TASK_SCHEMA, manifest)]
    for task in tasks:
        if not (0 <= task.episode < len(lengths) and 0 <= task.start < task.goal < lengths[task.episode]):
            raise DamagedFile(f"names the task {tuple(task)}, which lies outside its episode")
    return tasks
