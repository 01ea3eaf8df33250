"""Tables I and II of the paper: prediction in both worlds, and control of the robot by the paper's planner and cost.

Models and label budgets are those of the published rows (``leaderboard/paper.json``). The networks are the compact
ones; the paper's are ``dmbench train dmotion --arch paper``.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.reproduction.table import Column, Entrant, Table, World

_SUPERVISED: Final = ("wm-ae", "wm-vae", "ed-cnn", "cswm")
_VIDEO: Final = ("clasp", "dmotion-no-stn", "dmotion")

TABLE: Final = Table(
    title="tables I and II of the DMotion paper",
    worlds=(World(environment="grid_world"), World(environment="robot_push")),
    entrants=(
        *(Entrant(model=name, labels=("100%", "10%")) for name in _SUPERVISED),
        *(Entrant(model=name, labels=("one-shot",)) for name in _VIDEO),
    ),
    columns=(
        Column(name="prediction", metrics=("prediction", "rollout")),
        Column(
            name="control",
            metrics=("control",),
            planner="cem",
            objective="centres",
            models=("wm-ae", "ed-cnn", "clasp", "dmotion"),
            worlds=("robot_push",),
            references=("oracle",),
        ),
    ),
    seeds=(0, 1, 2),
)
