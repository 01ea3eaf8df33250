"""``samples.parquet``: every number behind a report's figures, one row per predicted frame.

================== ==================================================================================
``metric``         ``"prediction"`` (single steps), ``"rollout"``, or ``"control"`` (see below)
``predictor``      ``"model"``, or a reference: ``"copy_last"``, ``"agent_moves"``; in control ``"idle"`` and so on
``episode, step``  the action taken at frame ``step`` leads to the predicted frame ``step + 1``
``ahead``          predicted so many steps after the last true frame: 1 for single steps
``action, pushed`` the recorded action, and whether it moves an object
figures            as in the report; null where the frame has no value (see ``position_errors``)
``distance``       of each thing's centre [px], objects first, then the agent if it has a colour; null if not in both
``found``          whether the prediction shows each thing; ``found_truth`` the true frame
``hit_at_1``       H@1 of a rollout in the model's own space; ``reciprocal_rank`` its part of the MRR
``motion``         phi^0 of the true triplet, or any other latent action
================== ==================================================================================

A figure of the report is the mean of its column over the rows of its predictor and metric: all of them, those with
``pushed`` for a name in ``_push``, those with ``ahead == k`` for one in ``[k]``.

In control a row is one moment of one task: ``task`` is its number, ``episode`` and ``step`` where it starts, ``ahead``
how many steps have been taken, ``action`` the next (-1 for none), ``control_distance`` and ``control_lost`` how things
stand then.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from jaxtyping import Shaped

from dmotion_bench.scoring.frame_measures import OBJECTS_ONLY
from dmotion_bench.storage.atomic import atomic_file

PIXEL_COLUMNS = ("mse", "psnr", "ssim")
POSITION_COLUMNS = ("position_error_paper", "position_error", "miss_rate", "false_positive_rate")
OBJECT_COLUMNS = tuple(name + OBJECTS_ONLY for name in POSITION_COLUMNS)
IDENTIFICATION_COLUMNS = (
    "agent_iou",
    "motion_shift_error",
    "motion_probe_accuracy",
    "mse_true_motion",
    "motion_swap_change",
)
RANK_COLUMNS = ("hit_at_1", "reciprocal_rank")
CONTROL_COLUMNS = ("task", "control_distance", "control_lost")
FIGURE_COLUMNS = PIXEL_COLUMNS + POSITION_COLUMNS + OBJECT_COLUMNS + IDENTIFICATION_COLUMNS

SCHEMA = pa.schema(
    [
        ("metric", pa.string()),
        ("predictor", pa.string()),
        ("episode", pa.int32()),
        ("step", pa.int32()),
        ("ahead", pa.int16()),
        ("action", pa.int16()),
        ("pushed", pa.bool_()),
        *((name, pa.float32()) for name in FIGURE_COLUMNS + RANK_COLUMNS),
        ("distance", pa.list_(pa.float32())),
        ("found", pa.list_(pa.bool_())),
        ("found_truth", pa.list_(pa.bool_())),
        ("motion", pa.list_(pa.float32())),
        ("task", pa.int32()),
        ("control_distance", pa.float32()),
        ("control_lost", pa.int16()),
    ]
)


class SampleRows:
    """Collects rows batch by batch; what is kept of a predicted frame is about 150 bytes."""

    def __init__(self, metric: str, predictor: str) -> None:
        self._fixed = {"metric": metric, "predictor": predictor}
        self._batches: list[pa.RecordBatch] = []

    def add(self, columns: Mapping[str, Shaped[np.ndarray, "b *k"]]) -> None:
        """One row for each element of the columns; columns that are not given are null."""
        rows = len(columns["episode"])
        arrays = []
        for field in SCHEMA:
            if field.name in self._fixed:
                arrays.append(pa.array([self._fixed[field.name]] * rows, field.type))
            elif field.name in columns:
                arrays.append(_array(np.asarray(columns[field.name]), field.type))
            else:
                arrays.append(pa.nulls(rows, field.type))
        self._batches.append(pa.record_batch(arrays, schema=SCHEMA))

    def table(self) -> pa.Table:
        """All rows, in the order in which they came."""
        return pa.Table.from_batches(self._batches, SCHEMA)


def _array(values: Shaped[np.ndarray, "b *k"], kind: pa.DataType) -> pa.Array:
    if not pa.types.is_list(kind):
        return pa.array(values, kind, from_pandas=True)
    offsets = np.arange(len(values) + 1, dtype=np.int32) * values.shape[1]
    return pa.ListArray.from_arrays(offsets, pa.array(values.reshape(-1), kind.value_type, from_pandas=True))


def column(samples: pa.Table, name: str) -> Shaped[np.ndarray, " n"]:
    """One column as numpy; null becomes NaN."""
    values: Shaped[np.ndarray, " n"] = samples[name].to_numpy()
    return values


def vectors(samples: pa.Table, name: str) -> Shaped[np.ndarray, "n d"] | None:
    """A column of equally long lists as a matrix; None where it is null."""
    if not len(samples) or samples[name].null_count:
        return None
    flat = samples[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    matrix: Shaped[np.ndarray, "n d"] = flat.reshape(len(samples), -1)
    return matrix


def write_samples(path: Path, samples: pa.Table) -> None:
    """Replace the file in one step."""
    with atomic_file(path) as file:
        pq.write_table(samples, file, compression="zstd")


def read_samples(path: Path) -> pa.Table:
    """The table that ``write_samples`` wrote.

    Raises:
        OSError, pa.ArrowInvalid: There is none, or it is no such table.
    """
    table: Any = pq.read_table(path)
    for field in SCHEMA:
        if field.name not in table.column_names and field.name in RANK_COLUMNS + CONTROL_COLUMNS:  # of earlier versions
            table = table.append_column(field, pa.nulls(len(table), field.type))
    return table.cast(SCHEMA)
