"""A validation loss that is no number: the training diverged, or the model fails in its validation alone."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import torch
from noise_world import write_noise
from sound_models import Sound, SoundConfig

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import RunError
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.model import Losses, ModelInputs
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.validation import why_not_finite
from dmotion_bench.workspace import Workspace


class Diverging(Sound):
    """Its weights are infinite after a step."""

    def losses(self, batch):
        losses = super().losses(batch)
        return Losses(total=losses.total * math.inf)


def test_a_training_that_diverges_stops_before_its_first_validation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    dataset = write_noise(tmp_path / "noise-tiny", episodes=12, lengths=[5] * 12)
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Diverging)
    monkeypatch.setattr("dmotion_bench.learning.runs.start.model_class", lambda name: Diverging)
    settings = ("batch_size=1", "epochs=2", "validations=1")
    request = TrainingRequest(model="ed-cnn", labels="all", settings=settings)
    run = open_run(request, dataset, tmp_path / "run", Workspace(tmp_path))
    steps: list[int] = []
    with pytest.raises(RunError, match=r"^training diverged before step 1: the loss is inf\. Try a lower rate"):
        train(run, training_data(run, dataset), launch("cpu"), lambda report: steps.append(report.step))
    assert steps == [1]


def test_finite_weights_point_at_the_model_and_others_at_the_rate() -> None:
    model = Sound(SoundConfig(), ModelInputs(height=16, width=16, actions=Discrete.numbered(4)))
    said = why_not_finite(model, math.nan, 7)
    with torch.no_grad():
        next(model.parameters()).fill_(math.inf)

    assert said == (
        "the validation loss is nan after step 7, although all weights are finite: Sound.losses gives no finite number "
        "in evaluation mode, or for some frames."
    )
    assert "training diverged before step 7: the loss is nan. Try a lower rate" in why_not_finite(model, math.nan, 7)
