"""Control with continuous actions: Planar Push by displacements, two frozen planners, the protocol's test tasks.

It is a table of its own, since labels of continuous actions are counted in transitions and not in demonstrations of
each action. A model of video has as many as it has by default.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.planning.columns import COLUMNS, HEADLINE, TEST, TRAININGS
from dmotion_bench.reproduction.table import Column, Entrant, Table, World, frozen_column
from dmotion_bench.specs import Preset

_SETTINGS: Final = ("actions=continuous",)

TABLE: Final = Table(
    title="control with continuous actions by frozen planners on test tasks, and prediction",
    worlds=(
        World(
            environment="planar_push",
            name="continuous",
            settings=_SETTINGS,
            control_on=World.for_tasks("planar_push", TEST, _SETTINGS),
        ),
    ),
    entrants=(Entrant(model="dmotion", labels=("64",)), Entrant(model="ed-cnn", labels=("100%",))),
    columns=(
        Column(name="prediction", metrics=("prediction", "gain")),
        *(frozen_column(one.name) for one in COLUMNS.values() if one.continuous),
        frozen_column(HEADLINE.name),
    ),
    preset=Preset.SMALL,
    seeds=tuple(range(TRAININGS)),
)
