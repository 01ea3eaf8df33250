"""The three columns of control: by the paper's planner, with knowledge of the task, and generic.

The generic column is the headline. It comes last, so that the runs' own reports hold it.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.reproduction.table import Column, Entrant, Table, World
from dmotion_bench.specs import Preset

_SUPERVISED: Final = ("ed-cnn", "wm-ae", "wm-vae", "cswm", "jepa")
_VIDEO: Final = ("dmotion", "dmotion-no-stn", "lapo", "lam-vae", "clasp")

TABLE: Final = Table(
    title="control by the paper's planner, with knowledge of the task, and generic",
    worlds=(World(environment="robot_push"), World(environment="planar_push")),
    entrants=(
        *(Entrant(model=name, labels=("one-shot",)) for name in _VIDEO),
        *(Entrant(model=name, labels=("100%",)) for name in _SUPERVISED),
    ),
    columns=(
        Column(
            name="paper",
            metrics=("control",),
            planner="cem",
            objective="centres",
            models=("dmotion", "ed-cnn", "wm-ae", "clasp"),
            worlds=("robot_push",),
            references=("oracle",),
        ),
        Column(
            name="with-task-knowledge",
            metrics=("control",),
            planner="icem",
            objective="tabletop",
            models=("dmotion", "ed-cnn"),
            worlds=("robot_push",),
            references=("oracle",),
        ),
        Column(name="generic", metrics=("prediction", "gain", "control"), planner="icem", objective="tracked"),
    ),
    preset=Preset.SMALL,
    seeds=(0, 1, 2),
)
