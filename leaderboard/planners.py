"""Which planners were tuned on which tasks: ``planners.json``.

A planner whose settings were chosen by looking at some tasks does better on them than on others. A row of control says
so of itself. An entry names the version that planned it; the file says on which tasks of which data sets that version
was tuned: on the first ``tasks`` of the data set with that fingerprint.
"""

from __future__ import annotations

import functools
import json
from collections.abc import Mapping
from importlib import resources


@functools.cache
def _tuned_tasks() -> Mapping[str, Mapping[str, int]]:
    """The number of tasks that a planner was tuned on, by its version and the data set's fingerprint."""
    stored = json.loads(resources.files(__package__).joinpath("planners.json").read_text())
    return {
        version: {data["fingerprint"]: data["tasks"] for data in planner["tuned_on"]}
        for planner in stored["planners"]
        for version in planner["versions"]
    }


def tuned_share(version: str | int, fingerprint: str, tasks: int) -> float | None:
    """The share of the first ``tasks`` tasks of a data set on which a planner was tuned.

    None where nothing is known of that version.
    """
    known = _tuned_tasks().get(str(version))
    return None if known is None else min(known.get(fingerprint, 0), tasks) / tasks
