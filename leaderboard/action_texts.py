"""The actions of control as an entry holds them: a text for each task, which reads back bit for bit."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.agents import NO_ACTION
from dmotion_bench.scoring.reference_control import QUICK
from dmotion_bench.scoring.samples import column, vectors
from dmotion_bench.scoring.standing import samples_of

METRIC: Final = "control"
"""As settings name it; where pictures judge its samples have another name (``samples_of``)."""
NOTHING: Final = "none"
"""In place of a continuous action where none was taken."""


def actions_of(samples: pa.Table) -> dict[str, list[dict[str, Any]]]:
    """The actions in each task as an entry holds them; quick references are left out, as they can be repeated."""
    rows = samples_of(samples, (METRIC,))
    planned = [name for name in np.unique(rows["predictor"].to_numpy(zero_copy_only=False)) if name not in QUICK]
    return {name: list(_tasks(rows.filter(pc.equal(rows["predictor"], name)))) for name in planned}


def _tasks(rows: pa.Table) -> Iterator[dict[str, Any]]:
    task, ahead, actions = column(rows, "task"), column(rows, "ahead"), vectors(rows, "command")
    actions = column(rows, "action") if actions is None else actions
    for number in np.unique(task).tolist():
        mine = np.flatnonzero(task == number)
        taken = actions[mine[np.argsort(ahead[mine])]][:-1]  # behind the last moment stands no action
        yield {"task": int(number), "actions": " ".join(map(as_text, taken))}


def as_text(action: Any) -> str:
    """An action in an entry; numbers of continuous ones are as short as they can be and still read back bit for bit."""
    if not np.ndim(action):
        return str(int(action))
    return NOTHING if np.isnan(action).any() else ",".join(repr(float(number)) for number in action)


def read_action(text: str, spec: ActionSpec) -> int | list[float] | None:
    """The action that ``as_text`` wrote; None if it is none of the environment's."""
    if isinstance(spec, Discrete):
        return int(text) if text.lstrip("-").isdigit() and -1 <= int(text) < len(spec) else None
    if text == NOTHING:
        return [float("nan")] * spec.width
    numbers = [float(number) for number in text.split(",")]
    return numbers if spec.fault(np.array([numbers])) is None else None


def is_none(action: int | list[float] | None) -> bool:
    """Whether an action that was read says that none was taken."""
    return action == NO_ACTION if isinstance(action, int) else action is not None and bool(np.isnan(action).any())


def are_kept(control: Mapping[str, Any]) -> bool:
    """Whether an entry of continuous actions holds them; those of before say -1, as of no action, everywhere."""
    return not control or any(one["actions"].strip("-1 ") for tasks in control.values() for one in tasks)
