"""The table of control: the frozen columns, on the test tasks of both pushing worlds.

The planners are those of ``dmotion_bench/planning/columns.py``, and only there; each world holds the hash of its test
tasks. The headline is for every model; the others cost as much again and are for the models below. Prediction and the
gain captured are measured on held-out episodes of the trainings' own data.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.planning.columns import COLUMNS, TEST, TRAININGS
from dmotion_bench.reproduction.table import Column, Entrant, Table, World, frozen_column
from dmotion_bench.specs import Preset

_WORLDS: Final = ("planar_push", "robot_push")
_SUPERVISED: Final = ("ed-cnn", "wm-ae", "wm-vae", "cswm", "jepa")
_VIDEO: Final = ("dmotion", "dmotion-no-stn", "lapo", "lam-vae", "clasp")
_CONTENDERS: Final = ("dmotion", "ed-cnn")
_OF: Final = {
    "generic-belief": _CONTENDERS,
    "generic": _CONTENDERS,
    "paper": (*_CONTENDERS, "wm-ae", "clasp"),
    "task-knowledge": _CONTENDERS,
}
"""The models of each column but the headline."""

TABLE: Final = Table(
    title="control by frozen planners on test tasks (protocols dmbench-2 to dmbench-4), and prediction",
    worlds=tuple(World(environment=name, control_on=World.for_tasks(name, TEST)) for name in _WORLDS),
    entrants=(
        *(Entrant(model=name, labels=("one-shot",)) for name in _VIDEO),
        *(Entrant(model=name, labels=("100%",)) for name in _SUPERVISED),
    ),
    columns=(
        Column(name="prediction", metrics=("prediction", "gain")),
        *(frozen_column(name, _OF.get(name, ())) for name, column in COLUMNS.items() if not column.continuous),
    ),
    preset=Preset.SMALL,
    seeds=tuple(range(TRAININGS)),
)
