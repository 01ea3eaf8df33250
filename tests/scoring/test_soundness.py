"""Of somebody else's model it is said if its predictions are of chance, or depend on the batch."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from known_model import Known, NoConfig
from pushed_squares import SPEC, squares_episode
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.cli.report_table import show_overview, show_report
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.report import CONTRACT
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.soundness import AT_RANDOM, TOGETHER, unsound_prediction
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

QUICK = ScoreSettings(horizon=3, resamples=100)
INPUTS = ModelInputs(height=128, width=128, actions=Discrete.numbered(4))


class AtRandom(Known):
    """Adds noise to each prediction."""

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return current + 0.1 * torch.randn_like(current)


class Together(Known):
    """Takes the mean over the batch for each one's prediction."""

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return current.mean(0, keepdim=True).expand_as(current)


class NoPixels(AtRandom):
    """Draws nothing that is compared."""

    needs_pixels = False


@pytest.mark.parametrize(
    ("kind", "said"), [(Known, None), (AtRandom, AT_RANDOM), (Together, TOGETHER), (NoPixels, None)]
)
def test_predictions_of_chance_and_of_the_batch_are_found(kind: type[Known], said: str | None, grid: Dataset) -> None:
    assert unsound_prediction(kind(NoConfig(), INPUTS), grid) == said


def test_an_episode_without_a_triplet_is_passed_over(tmp_path: Path) -> None:
    """An environment may end in its first step."""
    inputs = ModelInputs(height=SPEC.height, width=SPEC.width, actions=SPEC.actions)

    def recorded(*lengths: int) -> Dataset:
        recipe = DatasetRecipe(environment="squares", episodes=len(lengths), frames=8, shard_episodes=len(lengths))
        path = tmp_path / "-".join(map(str, lengths))
        with DatasetWriter.create_or_resume(path, recipe, SPEC) as writer:
            writer.write_shard(0, (squares_episode(one, frames) for one, frames in enumerate(lengths)))
            writer.finish()
        return Dataset.open(path)

    assert unsound_prediction(AtRandom(NoConfig(), inputs), recorded(2, 1, 8)) == AT_RANDOM
    assert unsound_prediction(Known(NoConfig(), inputs), recorded(2, 1, 8)) is None
    assert unsound_prediction(AtRandom(NoConfig(), inputs), recorded(2, 1)) is None  # nothing can be tried


def test_such_a_model_is_marked_and_not_called_the_best(
    make_run: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    reports = {}
    for name, kind in (("sound", Known), ("unsound", Together)):
        run = make_run(tmp_path / name, model=name, offset=0.5)
        monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda _, kind=kind: kind)
        reports[run.path] = score_run(run.path, metrics=("prediction",), settings=QUICK, how=Execution())
    (sound, unsound) = reports.values()
    better = replace(unsound, figures={**unsound.figures, "mse": {**sound.figures["mse"], "mean": 0.0}})
    unsound_path = tmp_path / "unsound"

    assert CONTRACT not in sound.remarks
    assert unsound.remarks[CONTRACT] == f"the model breaks it: {TOGETHER}"
    show_overview({unsound_path: better, tmp_path / "sound": sound})
    lines = [line for line in capsys.readouterr().out.splitlines() if "sound" in line]
    assert [line.split()[0] for line in lines] == ["sound", "unsound"]
    assert "best" in lines[0]
    assert "(breaks the contract)" in lines[1]
    show_report(unsound, unsound_path)
    assert TOGETHER in " ".join(capsys.readouterr().out.split())


def test_a_longer_rollout_than_any_episode_is_refused_before_the_report_is_touched(
    make_run: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run", model="known")
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda _: Known)
    report = score_run(run.path, metrics=("rollout",), settings=QUICK)
    with pytest.raises(InvalidSetting, match="has the frames for a rollout of 500 steps; ask for at most 12"):
        score_run(run.path, metrics=("rollout",), settings=replace(QUICK, horizon=500))
    usual = score_run(run.path, metrics=("prediction",), settings=QUICK)

    assert "rollout_mse[3]" in report.figures
    assert "rollout_mse[3]" in usual.figures
