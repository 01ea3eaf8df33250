"""Where episodes end that stand one behind the other in an HDF5 file, as in a replay buffer.

Such files mark the rows: D4RL's ``terminals`` and ``timeouts``, Gymnasium's ``terminated`` and ``truncated`` and RLDS's
``is_last`` the last one of an episode, RLDS's ``is_first`` the first one, and ``step_type`` of dm_env both.
"""

from __future__ import annotations

from typing import Final

import h5py
import numpy as np

from dmotion_bench.storage.imports.hdf5_contents import ERRORS, fault
from dmotion_bench.storage.imports.limits import ImportLimits

_OF_THE_LAST: Final = frozenset(
    {"terminal", "terminals", "terminated", "terminations", "timeout", "timeouts", "truncated", "truncations"}
    | {"done", "dones", "is_last", "is_terminal"}
)
_OF_THE_FIRST: Final = frozenset({"is_first"})
_STEP_TYPE: Final = "step_type"
_LAST: Final = 2  # of dm_env's step types


def episode_ends(name: str, dataset: h5py.Dataset, count: int, limits: ImportLimits) -> int:
    """How many episodes end before the last row, by one data set; 0 if it marks none.

    Several marked rows in turn are one end: some programs mark all rows after a success.

    Args:
        name: Of the data set, perhaps with its groups.
        dataset: It.
        count: Rows that there must be, one for each picture.
        limits: What the file may make us do.
    """
    called = name.rpartition("/")[2].lower()
    if called not in _OF_THE_LAST | _OF_THE_FIRST | {_STEP_TYPE}:
        return 0
    if count > limits.frames or dataset.shape not in ((count,), (count, 1)) or dataset.dtype.kind not in "biuf":
        return 0
    if fault(dataset, limits):
        return 0
    try:
        rows = np.asarray(dataset[()]).reshape(-1)
    except ERRORS:
        return 0
    if called in _OF_THE_FIRST:
        return int(np.count_nonzero(rows[1:]))
    is_last = rows == _LAST if called == _STEP_TYPE else rows != 0
    return int(np.count_nonzero(is_last[:-1] & ~is_last[1:]))
