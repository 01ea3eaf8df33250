"""Runs scored on another data set than their own stand on its board, marked, and their entries can be checked."""

from __future__ import annotations

import copy
import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest
from known_model import Known, write_run
from made_up_import import write_import
from torch import Tensor

from dmotion_bench.learning.runs.run import Run
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
from leaderboard.verdict import Verdict

from .conftest import SETTINGS

pytestmark = pytest.mark.slow

QUICK = CheckSettings(score=False)
RUN = "dmotion-grid_world-tiny-s0"
ON = Path("report/on/other")
ALPHABETICAL = ("down", "left", "right", "up")


OTHER = DatasetRecipe(environment="grid_world", policy="random", seed=9, episodes=30, frames=12)


def _model(patch: pytest.MonkeyPatch, kind: type[Known]) -> None:
    patch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: kind)


@pytest.fixture(scope="module")
def elsewhere(scored_workspace: Workspace, tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """The first run, scored on a data set of another seed and on an import of it; read only."""
    workspace = Workspace(tmp_path_factory.mktemp("elsewhere"))
    shutil.copytree(scored_workspace.root, workspace.root, dirs_exist_ok=True)
    record_dataset(workspace.data / "other", OTHER)
    dataset = Dataset.open(workspace.data / "other")
    imported = write_import(workspace.data / "recordings", dataset, actions=ALPHABETICAL)
    with pytest.MonkeyPatch.context() as patch:
        _model(patch, Known)
        native = write_run(workspace.runs / "dmotion-other-s0", dataset, offset=0.3)
        for run in (workspace.runs / RUN, native.path):
            score_run(run, settings=SETTINGS, data=dataset.path)
        _model(patch, ByAction)
        score_run(workspace.runs / RUN, settings=SETTINGS, data=imported.path)
    return workspace


def _copy(parts: tuple[str, ...], source: Workspace, target: Workspace) -> None:
    for part in parts:
        shutil.copytree(source.root / part, target.root / part)


@pytest.fixture
def transferred(workspace: Workspace, elsewhere: Workspace) -> Entry:
    """The first run, scored on a data set of another seed; a run that was trained there stands beside it."""
    _copy(("data/other", "runs/dmotion-other-s0", f"runs/{RUN}/{ON}"), elsewhere, workspace)
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
    (workspace.runs / RUN / "report" / "report.json").unlink()
    [verdict] = check_paths([Path(RUN)], workspace, quick=True)
    assert verdict.holds  # a run that was scored elsewhere alone lacks nothing


def test_labels_are_counted_again_where_the_data_set_of_the_training_is_here(
    workspace: Workspace, transferred: Entry
) -> None:
    """The run says the same as its entry."""
    manifest = json.loads((workspace.runs / RUN / "run.json").read_text())
    manifest["result"] |= {"labels": {"demonstrations": 3}, "labels_total": 3}
    (workspace.runs / RUN / "run.json").write_text(json.dumps(manifest))
    content = copy.deepcopy(dict(transferred.content))
    content["labels"] = {"asked": "one-shot", "given": {"demonstrations": 3}, "total": 3}

    counted = check_entry(Entry(content), workspace)
    shutil.rmtree(workspace.data / "grid_world-tiny" / "labels")
    not_counted = check_entry(Entry(content), workspace)

    assert counted.findings == (
        "labels.given, by the budget one-shot and the data set: the entry says {'demonstrations': 3}, it is "
        "{'demonstrations': 4}",
    )
    assert not_counted.findings == ()
    assert "labels: 'grid_world-tiny' is here without them, so they were not counted again" in not_counted.remarks


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


class ByAction(Known):
    """Brightens the current frame more for a higher number of the action."""

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return current + 0.1 * (1 + action.to(current)).reshape(-1, 1, 1, 1)


@pytest.fixture
def on_import(workspace: Workspace, elsewhere: Workspace, monkeypatch: pytest.MonkeyPatch) -> Entry:
    """The first run, scored on an import that lists its actions by the alphabet."""
    _model(monkeypatch, ByAction)
    report = "report/on/recordings"
    _copy(("data/recordings", f"runs/{RUN}/{report}"), elsewhere, workspace)
    return entry_of_run(workspace.runs / RUN, workspace.runs / RUN / report)


def test_an_entry_on_an_import_is_marked_and_names_the_actions_that_were_taken(
    workspace: Workspace, on_import: Entry
) -> None:
    assert on_import.content["dataset"]["trained_on"]["environment"] == "grid_world"
    page = make_page([on_import, entry_of_run(workspace.runs / RUN)])
    assert "trained on grid_world-tiny" in page
    assert "grid_world-tiny (grid_world), another data set" in page

    dataset = Dataset.open(workspace.data / "recordings")
    assert on_import.pictures
    for picture in on_import.pictures:
        taken = dataset.states(picture["episode"]).actions[picture["step"]]
        assert picture["action"] == ALPHABETICAL[taken]


def test_an_entry_on_an_import_is_checked_against_it(workspace: Workspace, on_import: Entry) -> None:
    assert check_entry(on_import, workspace) == Verdict(
        entry=f"{RUN} on recordings",
        findings=(),
        figures=len(on_import.figures),
        samples=on_import.content["samples"]["rows"],
        weights=on_import.content["weights"],
        seed=on_import.content["seed"],
        run=RUN,
    )
    content = copy.deepcopy(dict(on_import.content))
    del content["dataset"]["trained_on"]["environment"]
    assert any(
        finding.startswith("dataset.trained_on: ") for finding in check_entry(Entry(content), workspace, QUICK).findings
    )


def test_without_the_data_of_the_training_an_entry_on_an_import_is_not_checked(
    workspace: Workspace, on_import: Entry
) -> None:
    shutil.rmtree(workspace.data / "grid_world-tiny")
    verdict = check_entry(on_import, workspace, QUICK)
    assert any(missing.startswith("data set of the training: 'recordings' is an import") for missing in verdict.missing)
    assert verdict.findings == ()


def test_without_the_data_of_the_training_nobody_knows_which_episodes_are_new(
    workspace: Workspace, transferred: Entry
) -> None:
    shutil.rmtree(workspace.data / "grid_world-tiny")
    verdict = check_entry(transferred, workspace, QUICK)
    assert [one.partition(" '")[0] for one in verdict.missing] == ["data set of the training: only"]
    assert verdict.findings == ()


def test_an_entry_on_a_copy_of_the_training_does_not_hold(
    workspace: Workspace, on_import: Entry, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Scored where nobody looked, as a changed dmbench could."""
    own = Dataset.open(workspace.data / "grid_world-tiny")
    copied = write_import(workspace.data / "copied", own, seed=18)
    with monkeypatch.context() as patch:
        patch.setattr("dmotion_bench.scoring.transfer.copied_episodes", lambda *_: [])
        score_run(workspace.runs / RUN, settings=SETTINGS, data=copied.path)
    entry = entry_of_run(workspace.runs / RUN, workspace.runs / RUN / "report/on/copied")
    (finding,) = check_entry(entry, workspace).findings
    assert re.match(r"data set: 4 of the 5 test episodes of 'copied' show the same as", finding)
