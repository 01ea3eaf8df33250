"""Actions as LeRobot's columns: a description, an action for each frame, 32 bits where they hold all of it."""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import pyarrow as pa
from jaxtyping import Shaped

from dmotion_bench.actions import ActionSpec, Discrete, actions_to_json

ACTION: Final = "action"
ACTION_NAMES: Final = "dmbench_actions"  # read back by ``imports/lerobot_recording.py``


def action_feature(spec: ActionSpec, kind: pa.DataType) -> dict[str, Any]:
    """The feature's description; a column of one number is no list to LeRobot."""
    if isinstance(spec, Discrete):
        return {"dtype": "int64", "shape": [1], "names": ["action"], ACTION_NAMES: list(spec.names)}
    single = kind.value_type if pa.types.is_fixed_size_list(kind) else kind
    return {
        "dtype": "float32" if pa.types.is_float32(single) else "float64",
        "shape": [spec.width],
        "names": list(spec.names),
        ACTION_NAMES: actions_to_json(spec),
    }


def action_column(actions: Shaped[np.ndarray, "s *a"], spec: ActionSpec) -> pa.Array:
    """An episode's actions, one for each frame."""
    last = actions[-1:] if len(actions) else np.zeros((1, *spec.shape))
    values = np.concatenate([actions, last]).astype(spec.dtype)
    flat = pa.array(values.reshape(-1))
    return flat if spec.shape in ((), (1,)) else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])


def narrowed(table: pa.Table) -> pa.Table:
    """The table with its actions in 32 bits, if these hold all of them exactly."""
    if ACTION not in table.column_names or pa.types.is_integer(table.schema.field(ACTION).type):
        return table
    values = matrix(table, ACTION)
    with np.errstate(over="ignore"):
        narrow = values.astype(np.float32)
    if (narrow.astype(np.float64) != values).any():
        return table
    flat = pa.array(narrow.reshape(-1))
    column = flat if values.shape[1] == 1 else pa.FixedSizeListArray.from_arrays(flat, values.shape[1])
    return table.set_column(table.column_names.index(ACTION), ACTION, column)


def matrix(table: pa.Table, name: str) -> np.ndarray[Any, Any]:
    """A column as rows of numbers."""
    column = table.column(name).combine_chunks()
    if pa.types.is_fixed_size_list(column.type):
        matrix: np.ndarray[Any, Any] = column.flatten().to_numpy().reshape(len(column), -1)
        return matrix
    values: np.ndarray[Any, Any] = column.to_numpy()[:, None]
    return values
