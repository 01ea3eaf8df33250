"""What of a report is kept, what it may hold, and what is said where that is not so."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench.errors import DmbenchError, InvalidSetting, RunCorrupt
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.report import Report
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.standing import with_standing
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset

FEW = ("samples=3", "horizon=2", "iterations=1", "elites=2")
QUICK = ScoreSettings(horizon=3, resamples=100, control=ControlScoring(tasks=3, steps=3, planner_set=FEW))


def report_with(group: str, **settings: Any) -> Report:
    """A report of one group of figures, with other settings than it would have; an ellipsis leaves one out."""
    own = QUICK.to_json((group,)) | settings
    return Report(
        **{name: name for name in ("run", "model", "arch", "preset", "weights")},
        **{name: {} for name in ("labels", "dataset", "training", "versions", "figures", "reference")},
        seed=0,
        settings={name: value for name, value in own.items() if value is not ...},
    )


@pytest.mark.parametrize("group", ["gain", "control"])
def test_an_objective_that_is_not_installed_is_told_of(group: str) -> None:
    with pytest.raises(
        DmbenchError, match=r"report holds .* by what is not installed here: .*'luck'.* Install the pac"
    ):
        with_standing(QUICK, report_with(group, **{f"{group}_objective": "luck"}), ("prediction",))
    assert with_standing(QUICK, report_with(group), ("prediction",)) == QUICK


@pytest.mark.parametrize(
    ("group", "wrong", "said"),
    [
        ("gain", {"gain_moments": ...}, "the gain captured by settings that cannot be .'gain_moments' is missing"),
        ("gain", {"gain_moments": "many"}, "moments is 'many'"),
        ("control", {"control_steps": ...}, "control by settings that cannot be .'control_steps' is missing"),
        ("control", {"control_tasks": "all"}, "control by settings that cannot be"),
        ("control", {"control_planner_set": 3}, "control by settings that cannot be"),
        ("control", {"control_planner_set": [3]}, "control by settings that cannot be"),
        ("control", {"control_planner_set": ["samples=-1"]}, "samples is -1"),
    ],
)
def test_settings_that_cannot_be_are_told_of(group: str, wrong: dict[str, Any], said: str) -> None:
    with pytest.raises(RunCorrupt, match=said):
        with_standing(QUICK, report_with(group, **wrong), ("prediction",))


@pytest.mark.slow
def test_control_that_could_not_be_read_again_is_not_begun(
    make_run: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recipe = DatasetRecipe(environment="grid_world", policy="random", episodes=12, frames=32, tasks=4)
    record_dataset(tmp_path / "data", recipe)
    run = make_run(tmp_path / "run", fingerprint=Dataset.open(tmp_path / "data").fingerprint)
    monkeypatch.setattr(Run, "dataset_path", tmp_path / "data")
    asked: list[str] = []
    how = Execution(progress=lambda what, done, total: asked.append(what))
    rows = score_run(run.path, metrics=("control",), settings=QUICK).samples["rows"]

    shutil.rmtree(run.path / "report")
    monkeypatch.setattr("dmotion_bench.scoring.samples.MOST_SAMPLES", rows - 1)
    with pytest.raises(InvalidSetting, match=rf"control tasks, .* would make {rows} samples, .*'--tasks'"):
        score_run(run.path, metrics=("control",), settings=QUICK, how=how)
    assert not asked
    fewer = replace(QUICK, control=replace(QUICK.control, tasks=2))
    assert score_run(run.path, metrics=("control",), settings=fewer).samples["rows"] < rows
