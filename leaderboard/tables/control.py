"""The table of control: the frozen columns, on the test tasks of both pushing worlds.

Planners, their models and the test tasks are those of ``dmotion_bench/planning/columns.py``, and only there. Prediction
and the gain captured are measured on held-out episodes of the trainings' own data.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.planning.columns import COLUMNS, TEST, TEST_TASKS, TRAININGS
from dmotion_bench.reproduction.table import Column, Entrant, Table, World, frozen_column
from dmotion_bench.specs import Preset

_SUPERVISED: Final = ("ed-cnn", "wm-ae", "wm-vae", "cswm", "jepa")
_VIDEO: Final = ("dmotion", "dmotion-no-stn", "lapo", "lam-vae", "clasp")

TABLE: Final = Table(
    title="control by frozen planners on test tasks (protocols dmbench-2 to dmbench-4), and prediction",
    worlds=tuple(World(environment=name, control_on=World.for_tasks(name, TEST)) for name in TEST_TASKS),
    entrants=(
        *(Entrant(model=name, labels=("one-shot",)) for name in _VIDEO),
        *(Entrant(model=name, labels=("100%",)) for name in _SUPERVISED),
    ),
    columns=(Column(name="prediction", metrics=("prediction", "gain")), *map(frozen_column, COLUMNS)),
    preset=Preset.SMALL,
    seeds=tuple(range(TRAININGS)),
)
