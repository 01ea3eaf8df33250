"""``samples.parquet``: every number behind a report's figures, one row per predicted frame.

================== ==================================================================================
``metric``         ``"prediction"`` (single steps), ``"rollout"``, or ``"control"`` or ``"gain"`` (see below)
``predictor``      ``"model"``, or a reference: ``"copy_last"``, ``"agent_moves"``; in control ``"idle"`` and so on
``episode, step``  the action taken at frame ``step`` leads to the predicted frame ``step + 1``
``ahead``          predicted so many steps after the last true frame: 1 for single steps
``action, pushed`` the recorded action, and whether it moves an object; null for a continuous action
``command``        the numbers of a continuous action, in their units, null for none; only there if actions are
                   continuous
figures            as in the report; null where the frame has no value (see ``position_errors``)
``distance``       of each thing's centre [px], objects first, then the agent if it has a colour; null if not in both
``found``          whether the prediction shows each thing; ``found_truth`` the true frame
``hit_at_1``       H@1 of a rollout in the model's own space; ``reciprocal_rank`` its part of the MRR
``motion``         phi^0 of the true triplet, or any other latent action
``probe_...``      of each true factor that was probed: a whole and the errors of the linear and of the small
                   probe, then the same of their controls (``probes.py``); null where it was not probed
``state_probe_...`` of the places of the agents and of the objects: squared distances [m^2] of the true ones from the
                   mean, and from what a probe reads in the model's state (``state_probes.py``)
``codes``          that the latent action is made of, as many of each codebook, one's after the other's;
                   ``codebook_sizes`` how many each has
``each_...``       only there in worlds of several agents: a value for each agent of ``each_agent_iou``,
                   ``each_motion_shift_error`` and ``each_motion_probe_accuracy``, its ``each_action``, and its
                   ``each_motion``, one agent's after the other's
================== ==================================================================================

In reports of control on continuous actions that were written before they were kept, ``command`` is missing.

A figure of the report is the mean of its column over the rows of its predictor and metric: all of them, those with
``pushed`` for a name in ``_push``, those with ``ahead == k`` for one in ``[k]``. Of a figure of agent k it is the mean
of the k-th values. Of a probe it is 1 - the sum of its errors / the sum of their wholes.

In control a row is one moment of one task: ``task`` is its number, ``episode`` and ``step`` where it starts, ``ahead``
how many steps have been taken, ``action`` the next (-1 for none, or a continuous one), ``control_distance`` and
``control_lost`` how things stand then. The ``metric`` is ``"control_pictures"`` where pictures judge, since the
environment tells no positions; its figures have other names (``figures.py``).

Of the gain captured (``gain.py``) a row is a moment: frame ``step`` of an episode. ``ahead`` is the length of the
sequences, ``action`` the first one of the pick, ``gain`` what it truly brings, ``best_gain`` what the best sequence
brings. The figure is the sum of the one divided by the sum of the other.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from jaxtyping import Float, Int, Shaped

from dmotion_bench.errors import InvalidSetting, RunCorrupt
from dmotion_bench.scoring.frame_measures import OBJECTS_ONLY
from dmotion_bench.scoring.true_factors import FACTORS
from dmotion_bench.storage.atomic import atomic_file
from dmotion_bench.storage.limits import LONGEST_NAME
from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.parquet_file import read_parquet
from dmotion_bench.wording import shown

CONTROL: Final = "control"
PICTURE_CONTROL: Final = "control_pictures"
GAIN: Final = "gain"
PIXEL_COLUMNS = ("mse", "psnr", "ssim")
POSITION_COLUMNS = ("position_error_paper", "position_error", "miss_rate", "false_positive_rate")
OBJECT_COLUMNS = tuple(name + OBJECTS_ONLY for name in POSITION_COLUMNS)
IDENTIFICATION_COLUMNS = (
    "agent_iou",
    "motion_shift_error",
    "motion_probe_accuracy",
    "motion_probe_error",
    "mse_true_motion",
    "motion_swap_change",
    "inverse_accuracy",
    "inverse_error",
)
EACH = "each_"
"""Before the name of a column with a value for each of several agents."""

PROBE = "probe_"
"""Before the name of a column of what probes of a true factor came to."""

STATE_PROBE: Final = "state_probe_"
"""Before the name of a column of what a probe of a state came to."""

STATE_PROBED: Final = ("agent_place", "object_place")
EACH_FIGURES = ("agent_iou", "motion_shift_error", "motion_probe_accuracy")
RANK_COLUMNS = ("hit_at_1", "reciprocal_rank")
GAIN_COLUMNS = ("gain", "best_gain")
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
        ("command", pa.list_(pa.float64())),
        ("task", pa.int32()),
        ("control_distance", pa.float32()),
        ("control_lost", pa.int16()),
        ("gain", pa.float32()),
        ("best_gain", pa.float32()),
        (f"{EACH}action", pa.list_(pa.int16())),
        (f"{EACH}motion", pa.list_(pa.float32())),
        *((EACH + name, pa.list_(pa.float32())) for name in EACH_FIGURES),
        *((PROBE + name, pa.list_(pa.float32())) for name in FACTORS),
        *((STATE_PROBE + name, pa.list_(pa.float32())) for name in STATE_PROBED),
        ("codes", pa.list_(pa.int32())),
        ("codebook_sizes", pa.list_(pa.int32())),
    ]
)

LATENT_COLUMNS: Final = frozenset(
    (
        *(name for name in IDENTIFICATION_COLUMNS if not name.startswith("inverse")),
        "motion",
        *(name for name in SCHEMA.names if name.startswith((EACH, PROBE))),
        "codes",
        "codebook_sizes",
    )
)
"""Of single steps: those that a model's latent actions decide, whatever labels it was given."""

MOST_SAMPLES: Final = 1_000_000
"""Rows of a table that is read; to compare two such tables takes some 650 bytes of memory a row."""
_MOST_LISTED: Final = 2**26  # values in a column of lists
_EACH_COLUMNS: Final = tuple(name for name in SCHEMA.names if name.startswith(EACH))
_INVERSE_COLUMNS: Final = ("inverse_accuracy", "inverse_error")
_PROBE_COLUMNS: Final = (
    *(PROBE + name for name in FACTORS),
    *(STATE_PROBE + name for name in STATE_PROBED),
    "codes",
    "codebook_sizes",
)
LATER_LISTS: Final = (*_EACH_COLUMNS, *_PROBE_COLUMNS)
"""Columns of lists that reports of this version of scoring may lack: they came later."""
_LISTS: Final = ("distance", "found", "found_truth", "motion", "command", *LATER_LISTS)
_LEFT_OUT: Final = (
    "command",
    "motion_probe_error",
    *_INVERSE_COLUMNS,
    *GAIN_COLUMNS,
    *_EACH_COLUMNS,
    *_PROBE_COLUMNS,
)  # of no value
_LATER_COLUMNS: Final = RANK_COLUMNS + CONTROL_COLUMNS + _LEFT_OUT


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


def action_column(actions: Int[np.ndarray, " b"] | Float[np.ndarray, "b a"]) -> dict[str, Shaped[np.ndarray, "b *a"]]:
    """The column that holds recorded actions, by its name: ``action`` or ``command``."""
    return {"action": actions} if actions.ndim == 1 else {"command": actions}


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
    """A column of equally long lists as a matrix; None where it is null or was not written."""
    if not len(samples) or name not in samples.column_names or samples[name].null_count:
        return None
    flat = samples[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    matrix: Shaped[np.ndarray, "n d"] = flat.reshape(len(samples), -1)
    return matrix


def require_readable(rows: int, *, of_tasks: bool = False) -> None:
    """Check that so many samples can be read again.

    Args:
        rows: Of a report.
        of_tasks: Whether control tasks make too many of them.

    Raises:
        InvalidSetting: They are too many.
    """
    if rows > MOST_SAMPLES:
        what, instead = "the test episodes", "score the run on a data set with fewer episodes ('--data')"
        if of_tasks:
            what, instead = "the control tasks, with what else the report holds,", "work on fewer of them ('--tasks')"
        raise InvalidSetting(f"{what} would make {rows:,} samples, and a report can have {MOST_SAMPLES:,}; {instead}.")


def write_samples(path: Path, samples: pa.Table) -> None:
    """Replace the file in one step."""
    there = (name for name in _LEFT_OUT if name in samples.column_names)
    samples = samples.drop_columns([name for name in there if samples[name].null_count == len(samples)])
    with atomic_file(path) as file:
        pq.write_table(samples, file, compression="zstd")


def read_samples(path: Path, rows: int | None = None) -> pa.Table:
    """The table that ``write_samples`` wrote.

    Args:
        path: Its file.
        rows: How many it must have, if that is known.

    Raises:
        RunCorrupt: There is none, or it is no such table.
    """
    counts = range(MOST_SAMPLES + 1) if rows is None else range(rows, rows + 1)
    try:
        table = read_parquet(
            path, SCHEMA, counts, said_by="report.json", most_listed=_MOST_LISTED, optional=_LATER_COLUMNS
        )
        for field in SCHEMA:
            if field.name not in table.column_names:
                table = table.append_column(field, pa.nulls(len(table), field.type))
        return _checked(table.select(SCHEMA.names))
    except DamagedFile as error:
        raise RunCorrupt(
            f"the samples {shown(str(path))} cannot be used: the table {error}; delete the folder of the report and "
            "score the run again."
        ) from None


def _checked(table: pa.Table) -> pa.Table:
    """The table with texts in place of words of a dictionary.

    Raises:
        DamagedFile: A value is missing or cannot be.
    """
    for name in ("metric", "predictor"):
        words = set(pc.unique(table[name]).cast(pa.string()).to_pylist())
        if wrong := [word for word in words if word is None or len(word) > LONGEST_NAME]:
            raise DamagedFile(f"has a {name} that cannot be: {shown(wrong[0])}")
    for name in ("episode", "step", "ahead"):
        if table[name].null_count or (len(table) and pc.min(table[name]).as_py() < 0):
            raise DamagedFile(f"has a row without {name}, or with one below zero")
    for name in _LISTS:
        lengths = pc.drop_null(pc.list_value_length(table[name]))
        if len(lengths) and len(pc.unique(lengths)) > 1:
            raise DamagedFile(f"has lists of different lengths in the column {name}")
    return table.cast(SCHEMA)
