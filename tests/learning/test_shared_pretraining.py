"""A training that is taken over: what other labels taught stays with the run that paid for them."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
import torch
from sound_models import SoundVideo
from torch import Tensor
from walking_square import record_walks

from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.shared_pretraining import take_over
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace


class Shifting(SoundVideo):
    """Its latent is how far brightness has moved to the right; ``align`` writes the rows of shown actions alone."""

    def _code(self, current: Tensor, following: Tensor) -> Tensor:
        columns = torch.linspace(-1, 1, current.shape[-1])
        return ((following - current) * columns).mean((2, 3))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


@pytest.fixture
def trained(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[Workspace, str], tuple[Run, bool]]:
    """Trains ``Shifting`` in a workspace; also says whether it took a training over."""
    for module in ("learning.runs.manifest", "learning.runs.start", "learning.training.shared_pretraining"):
        monkeypatch.setattr(f"dmotion_bench.{module}.model_class", lambda name: Shifting)

    def with_labels(workspace: Workspace, labels: str) -> tuple[Run, bool]:
        settings = ("batch_size=4", "epochs=0.2", "validations=2")
        asked = TrainingRequest(model="lapo", labels=labels, settings=settings, threads=1)
        dataset = Dataset.open(recorded)
        run = open_run(asked, dataset, None, workspace)
        source = take_over(run)
        train(run, training_data(run, dataset), launch("cpu"), lambda report: None)
        return Run.open(run.path), source is not None

    return with_labels


@pytest.mark.parametrize("labels", ["1", "none"])
def test_a_run_ends_as_it_does_alone(
    trained: Callable[[Workspace, str], tuple[Run, bool]], tmp_path: Path, labels: str
) -> None:
    alone, _ = trained(Workspace(tmp_path / "alone"), labels)
    beside = Workspace(tmp_path / "beside")
    first, _ = trained(beside, "one-shot")
    after, is_taken = trained(beside, labels)
    assert is_taken
    assert first.result is not None
    assert alone.result is not None
    assert after.result is not None
    assert after.result["labels_total"] == (1 if labels == "1" else 0)
    assert after.result["weights"] == alone.result["weights"] != first.result["weights"]
