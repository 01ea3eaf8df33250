"""Entries with the gain captured: it stands on the board with its references, and a forged one is found."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from known_model import Known, write_run

from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.gain import GainScoring
from dmotion_bench.scoring.report import read_report, write_report
from dmotion_bench.scoring.samples import read_samples
from dmotion_bench.scoring.score import Scores, score_model, score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.board import make_boards
from leaderboard.build import entry_of_run
from leaderboard.check import CheckSettings, check_entry
from leaderboard.entry import Entry
from leaderboard.page import make_page

SETTINGS = ScoreSettings(resamples=100, gain=GainScoring(moments=5, sequences=8, horizon=3))


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Workspace, Path]:
    """A workspace with a run whose gain was scored; read only."""
    made = Workspace(tmp_path_factory.mktemp("gain"))
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=200, frames=32
    )
    record_dataset(made.data / "grid", recipe)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)
        run = write_run(made.runs / "known", Dataset.open(made.data / "grid"))
        score_run(run.path, metrics=("gain",), settings=SETTINGS)
    return made, run.path


@pytest.fixture
def entry(measured: tuple[Workspace, Path]) -> Entry:
    return entry_of_run(measured[1])


@pytest.mark.slow
def test_a_sound_entry_holds_and_stands_on_the_board(measured: tuple[Workspace, Path], entry: Entry) -> None:
    verdict = check_entry(entry, measured[0])
    (board,) = make_boards([entry])
    gains = {row.name: row.figures["planning_gain"].mean for row in board.rows if "planning_gain" in row.figures}

    assert verdict.findings == ()
    assert verdict.holds
    assert verdict.samples == entry.content["samples"]["rows"] == 3 * entry.figures["planning_gain"]["n"]  # references
    assert gains.keys() == {"dmotion", "random actions", "true simulator as the model"}
    assert gains["true simulator as the model"] > gains["random actions"]
    assert "best of 8 action sequences" in make_page([entry])


@pytest.mark.slow
def test_a_forged_pick_is_found_by_scoring_anew(measured: tuple[Workspace, Path], tmp_path: Path) -> None:
    workspace, run = measured
    folder = run / "report"
    report, samples = read_report(folder), read_samples(folder / "samples.parquet")
    assert report is not None
    rows = samples.to_pylist()
    first = next(row for row in rows if row["predictor"] == "model")
    first["gain"] = first["best_gain"] + 1
    forged = type(samples).from_pylist(rows, samples.schema)
    figures = {name: one.to_json() for name, one in figures_of(forged, "model", resamples=100).items()}
    try:
        write_report(folder, type(report)(**(vars(report) | {"figures": figures})), forged)
        lie = entry_of_run(run)
        assert check_entry(lie, workspace, CheckSettings(score=False)).holds
        findings = check_entry(lie, workspace).findings
    finally:
        write_report(folder, report, samples)

    assert any("1 of 12 differ" in finding and "gain of model" in finding for finding in findings), findings


@pytest.mark.slow
@pytest.mark.parametrize("setting", [{"gain_moments": "many"}, {"gain_horizon": -1}, {"gain_objective": "nothing"}])
def test_settings_that_cannot_be_are_a_finding(
    measured: tuple[Workspace, Path], entry: Entry, setting: dict[str, object]
) -> None:
    content = copy.deepcopy(dict(entry.content))
    content["settings"] |= setting

    findings = check_entry(Entry(content), measured[0]).findings

    assert any("gain" in finding for finding in findings), findings


@pytest.mark.slow
def test_the_gain_of_another_version_is_not_checked(
    measured: tuple[Workspace, Path], entry: Entry, monkeypatch: pytest.MonkeyPatch
) -> None:
    content = copy.deepcopy(dict(entry.content))
    content["settings"]["gain_version"] = 7

    asked = list[tuple[str, ...]]()

    def scored(*of: Any, metrics: tuple[str, ...], **how: Any) -> Scores:
        asked.append(metrics)
        return score_model(*of, metrics=metrics, **how)

    monkeypatch.setattr("leaderboard.check.score_model", scored)
    for settings in (CheckSettings(score=False), CheckSettings()):
        verdict = check_entry(Entry(content), measured[0], settings)

        assert not verdict.holds
        assert verdict.findings == ()
        (said,) = verdict.missing
        assert said.startswith("version: the gain captured was measured by version 7")
    assert asked == [()]
