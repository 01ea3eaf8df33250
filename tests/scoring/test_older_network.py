"""A network that only knows contiguous images is checked, trained, scored, planned with and shown like any other."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest
import torch
from older_network import OlderNetwork

from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.samples import read_samples
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.testing import check_model
from dmotion_bench.workspace import Workspace
from leaderboard.pictures import take_pictures


@pytest.mark.slow
@pytest.mark.parametrize("channels_last", [False, True])
def test_it_goes_all_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, channels_last: bool) -> None:
    for module in ("start", "manifest"):
        monkeypatch.setattr(f"dmotion_bench.learning.runs.{module}.model_class", lambda name: OlderNetwork)
    recipe = recipe_for("grid_world", Preset.TINY, episodes=12, frames=32, tasks=1)
    record_dataset(str(tmp_path / "data"), recipe)
    dataset = Dataset.open(str(tmp_path / "data"))
    settings = ("epochs=0.05", "batch_size=4", *(["channels_last=true"] if channels_last else []))
    run = open_run(TrainingRequest(model="older", settings=settings), dataset, tmp_path / "run", Workspace(tmp_path))
    if channels_last:
        with pytest.raises(RuntimeError, match="view"):  # so the test would notice images of another memory format
            train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
        return

    check_model(OlderNetwork)
    train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
    default = ScoreSettings()
    quick = ("samples=2", "horizon=2", "iterations=1", "elites=1")
    control = replace(default.control, planner="cem", planner_set=quick, tasks=1, steps=2)
    few = replace(default, horizon=3, resamples=100, control=control)
    report = score_run(str(run.path), metrics=("prediction", "rollout", "control"), settings=few)

    assert {"mse", "mse_true_motion", "rollout_mse[3]", "control_distance[2]"} <= set(report.figures)
    trained = Run.open(str(run.path))
    assert take_pictures(trained, dataset, read_samples(run.path / "report/samples.parquet"))
    frames = dataset.video(0)[:2]
    with torch.no_grad():
        assert trained.model.predict(frames[:1], frames[1:], 2).shape == (1, 3, 128, 128)
