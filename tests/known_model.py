"""A model that learns nothing, and finished runs of it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
import torch
from torch import Tensor

from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run, RunSpec
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.dataset import Dataset


def stands_for_every_model(patch: pytest.MonkeyPatch) -> None:
    """Have the runs of every name be runs of ``Known``."""
    patch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)


@dataclass(frozen=True, kw_only=True)
class NoConfig:
    """There is nothing to choose."""


class Known(ForwardModel[NoConfig]):
    """Predicts the current frame, brightened by ``offset``."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = "nobody, nowhere"
    Config: ClassVar[type] = NoConfig
    offset: Tensor

    def __init__(self, config: NoConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.register_buffer("offset", torch.zeros(1))

    def losses(self, batch: TripletBatch) -> Losses:
        return Losses(total=torch.zeros(()))

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return current + self.offset


class Raising(Known):
    """Fails in its losses."""

    def losses(self, batch: TripletBatch) -> Losses:
        raise KeyError("boom")


def spec_with(**changes: Any) -> RunSpec:
    """What a run of DMotion with one label of each action asks for, but for the changes."""
    asked: dict[str, Any] = {
        "model": "dmotion",
        "arch": "compact",
        "config": {},
        "training": {"epochs": 1},
        "preset": "tiny",
        "labels": "one-shot",
        "seed": 0,
        "dataset": "grid",
        "fingerprint": "f",
        "height": 128,
        "width": 128,
        "actions": 4,
    }
    return RunSpec(**(asked | changes))


def write_run(path: Path, dataset: Dataset, /, *, offset: float = 0.0, finished: bool = True, **changes: Any) -> Run:
    """A run of ``spec_with``; who opens it has to patch the model in."""
    spec = spec_with(**{"dataset": dataset.name, "fingerprint": dataset.fingerprint, **changes})
    run = Run.create_or_open(path, spec, dataset_path=dataset.path, versions={})
    run.write()
    if finished:
        weights = {"offset": torch.tensor([offset])}
        checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
        run.finish(result_of(weights))
    return run


def result_of(weights: Mapping[str, Tensor]) -> dict[str, Any]:
    """What a training that took five steps says of itself."""
    return {
        "weights": checkpoint.weights_hash(weights),
        "steps": 5,
        "triplets": 20,
        "seconds": 1.5,
        "triplets_per_s": 100.0,
        "parameters": 1,
        "best_step": 5,
        "validation_loss": 0.8,
        "labels": {"demonstrations": 4},
        "labels_total": 4,
        "device": "cpu",
        "processes": 1,
    }
