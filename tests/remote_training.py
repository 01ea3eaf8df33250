"""A training that kills its own process at a step; processes that start quickly, as torch is loaded once for all."""

from __future__ import annotations

import multiprocessing
import os
import signal
from collections.abc import Mapping
from pathlib import Path

import torch

from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.storage import object_store
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.6", "validations=3", "hard_share=0.5", "window=24", "precision=float32")


def train_from(where: str, folder: Path, kill_at: int | None = None) -> Run:
    """Train to the end, or kill this process after a step."""

    def on_step(report: StepReport) -> None:
        if report.step == kill_at:
            os.kill(os.getpid(), signal.SIGKILL)

    dataset = Dataset.open(where)
    asked = TrainingRequest(model="ed-cnn", labels="100%", settings=SETTINGS, threads=1)
    run = open_run(asked, dataset, folder, Workspace(folder.parent))
    train(run, training_data(run, dataset), launch("cpu"), on_step)
    return Run.open(folder)


def killed(where: str, folder: Path, kill_at: int) -> int:
    """The exit code of a process that trains until it is killed."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__, "baselines.encoder_decoder"])
    process = context.Process(target=_train_as, args=(dict(os.environ), object_store.PAUSES, where, folder, kill_at))
    process.start()
    process.join(120)
    return process.exitcode or 0


def _train_as(environment: Mapping[str, str], pauses: tuple[float, ...], *given: object) -> None:
    os.environ.update(environment)
    object_store.PAUSES, object_store.PATIENCE_S = pauses, 0.5
    torch.set_num_threads(1)
    train_from(*given)  # type: ignore[arg-type]
