"""A training of a few steps on made-up walks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.4", "validations=3", "ema=0.9")
NARROW = ("latent=32", "hidden=32")
"""Settings of WM-AE: with its wide layers, most of such a training would be to write their weights."""


class Stopped(Exception):
    """Raised by a progress callback."""


def short_run(data: Path, folder: Path, **request: Any) -> Run:
    return open_run(
        TrainingRequest(model="dmotion", settings=SETTINGS, **request), Dataset.open(data), folder, Workspace(folder)
    )


def train_short(run: Run, data: Path, stop_at: int | None = None) -> None:
    def on_step(report: StepReport) -> None:
        if report.step == stop_at:
            raise Stopped

    train(run, training_data(run, Dataset.open(data)), launch("cpu"), on_step)
