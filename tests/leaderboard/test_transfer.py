"""Runs scored on another data set than their own stand on its board, marked, and their entries can be checked."""

from __future__ import annotations

import copy
from pathlib import Path
from typing import Any

import pytest
from known_model import write_run

from dmotion_bench.learning.run import Run
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.score import score_run
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.board import make_boards
from leaderboard.build import build, entry_of_run
from leaderboard.check import CheckSettings, check_entry, check_paths
from leaderboard.entry import Entry
from leaderboard.entry_file import read_entries
from leaderboard.page import make_page

from .conftest import SETTINGS

pytestmark = pytest.mark.slow

QUICK = CheckSettings(score=False)
RUN = "dmotion-grid_world-tiny-s0"
ON = Path("report/on/other")


@pytest.fixture
def transferred(workspace: Workspace) -> Entry:
    """The first run, scored on a data set of another seed; a run that was trained there stands beside it."""
    record_dataset(
        workspace.data / "other",
        DatasetRecipe(environment="grid_world", policy="random", seed=9, episodes=30, frames=12),
    )
    dataset = Dataset.open(workspace.data / "other")
    native = write_run(workspace.runs / "dmotion-other-s0", dataset, offset=0.3)
    for run in (workspace.runs / RUN, native.path):
        score_run(run, settings=SETTINGS, data=dataset.path)
    return entry_of_run(workspace.runs / RUN, workspace.runs / RUN / ON)


def test_it_stands_on_the_other_board_marked_and_paired(workspace: Workspace, transferred: Entry) -> None:
    entries = [transferred, *(entry_of_run(workspace.runs / name) for name in (RUN, "dmotion-other-s0"))]
    boards = {board.dataset: board for board in make_boards(entries)}

    assert set(boards) == {"grid_world-tiny", "other"}
    rows = {row.title: row for row in boards["other"].rows if row.kind == "measured"}
    assert set(rows) == {"dmotion", "dmotion (trained on grid_world-tiny)"}
    assert rows["dmotion (trained on grid_world-tiny)"].is_best
    assert rows["dmotion"].behind is not None  # the same episodes: they can be paired
    page = make_page(entries)
    assert "trained on grid_world-tiny" in page
    assert "or trained on another data set" in page
    assert transferred.pictures


def test_building_takes_it_along(workspace: Workspace, transferred: Entry, tmp_path: Path) -> None:
    built = build(workspace.all_runs(), [], tmp_path / "site")
    assert (built.measured, built.left_out) == (3 + 1 + 1, {})
    assert transferred.slug in {entry.slug for entry in read_entries(tmp_path / "site/entries")}

    (workspace.runs / RUN / ON / "samples.parquet").unlink()
    assert f"{RUN} on other" in build(workspace.all_runs(), [], tmp_path / "site").left_out


def test_a_sound_entry_holds(workspace: Workspace, transferred: Entry) -> None:
    assert check_entry(transferred, workspace).findings == ()
    verdicts = check_paths([Path(RUN)], workspace, quick=True)
    assert [verdict.findings for verdict in verdicts] == [(), ()]  # its own report, and this one


@pytest.mark.parametrize(
    ("trained_on", "said"),
    [
        (None, "dataset.trained_on: "),
        ({"name": "other", "fingerprint": "0" * 64}, "dataset.trained_on: "),
    ],
)
def test_where_it_was_trained_counts(
    workspace: Workspace, transferred: Entry, trained_on: dict[str, Any] | None, said: str
) -> None:
    content = copy.deepcopy(dict(transferred.content))
    if trained_on is None:
        del content["dataset"]["trained_on"]
    else:
        content["dataset"]["trained_on"] = trained_on
    assert any(finding.startswith(said) for finding in check_entry(Entry(content), workspace, QUICK).findings)


def test_an_entry_of_its_own_data_set_cannot_be_passed_off_as_of_another(workspace: Workspace) -> None:
    content = copy.deepcopy(dict(entry_of_run(workspace.runs / RUN).content))
    content["dataset"]["trained_on"] = {"name": "elsewhere", "fingerprint": "0" * 64}
    findings = check_entry(Entry(content), workspace, QUICK).findings
    assert any(finding.startswith("dataset.trained_on: ") for finding in findings)


def test_a_figure_that_was_changed_is_found(workspace: Workspace, transferred: Entry) -> None:
    content = copy.deepcopy(dict(transferred.content))
    content["figures"]["mse"]["mean"] *= 0.9
    assert any("mse.mean" in finding for finding in check_entry(Entry(content), workspace, QUICK).findings)
    assert Run.open(workspace.runs / RUN).spec.dataset == "grid_world-tiny"
