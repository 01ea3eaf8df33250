"""Tables that are made in seconds, and speeds that nobody measures."""

from __future__ import annotations

from typing import Any

import torch

from dmotion_bench.reproduction.speeds import Episodes, Speeds
from dmotion_bench.reproduction.table import Column, Entrant, Table, World
from dmotion_bench.specs import Preset

SHORT = ("epochs=1", "precision=float32", "batch_size=16")
TABLE = Table(
    title="three budgets of a model of video, two of a model of actions",
    worlds=(World(environment="grid_world", episodes=12, frames=7),),
    entrants=(
        Entrant(model="lapo", labels=("one-shot", "1", "8"), settings=SHORT),
        Entrant(model="ed-cnn", labels=("one-shot", "2", "100%"), settings=SHORT),
    ),
    columns=(Column(name="prediction", metrics=("prediction",)),),
    preset=Preset.TINY,
)
FEW = ("samples=3", "horizon=2", "iterations=1", "elites=2")
CONTROL = Table(
    title="control in two columns",
    worlds=(World(environment="planar_push", episodes=12, frames=30, tasks=3),),
    entrants=(Entrant(model="ed-cnn", labels=("100%",), settings=("epochs=0.2", "precision=float32")),),
    columns=(
        Column(name="first", metrics=("control",), objective="centres", planner_set=FEW, references=("oracle",)),
        Column(name="second", metrics=("prediction", "control"), objective="tracked", planner_set=FEW),
    ),
    preset=Preset.TINY,
)


class Known(Speeds):
    """Speeds that nobody measures."""

    def __init__(self) -> None:
        super().__init__(device=torch.device("cpu"))

    def episodes(self, recording: Any) -> Episodes:
        return Episodes(frames_per_s=100.0, frames=7.0)

    def triplets_per_s(self, model: str, arch: str | None) -> float:
        return {"lapo": 50.0, "ed-cnn": 20.0}[model]

    def control_steps_per_s(self, model: str) -> float:
        return 0.5

    def oracle_steps_per_s(self, recording: Any, scoring: Any) -> float:
        return 4.0
