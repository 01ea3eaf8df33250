"""What a path is."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest
from pushed_squares import write_squares

from dmotion_bench.api.viewing import data_of
from dmotion_bench.errors import RunMissing, UnknownName, UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.episodes import choose_episodes
from dmotion_bench.viewing.target import Target, find_target
from dmotion_bench.workspace import Workspace


def test_a_name_or_a_path(workspace: Workspace, dataset: Dataset, run: Run) -> None:
    for given in (dataset.path, Path(dataset.name)):
        assert find_target(given, workspace) == Target("data set", workspace.data / dataset.name)
    for given in (run.path, Path(run.name)):
        assert find_target(given, workspace) == Target("run", workspace.runs / run.name)


def test_a_report_belongs_to_its_run(workspace: Workspace, run: Run) -> None:
    report = run.path / "report"
    report.mkdir()
    (report / "report.json").write_text("{}")
    try:
        for given in (report, Path(run.name) / "report"):
            assert find_target(given, workspace) == Target("report", run.path.resolve())
    finally:
        (report / "report.json").unlink()
        report.rmdir()


def test_a_run_without_a_report_is_to_be_scored(workspace: Workspace, run: Run) -> None:
    for given in (run.path / "report", Path(run.name) / "report"):
        with pytest.raises(RunMissing, match=f"has no report; score it with 'dmbench score {run.name}'"):
            find_target(given, workspace)


def test_a_saved_scene(workspace: Workspace, tmp_path: Path) -> None:
    (tmp_path / "a.rrd").touch()
    assert find_target(tmp_path / "a.rrd", workspace) == Target("recording", tmp_path / "a.rrd")


def test_a_misspelt_name_gets_the_close_one(workspace: Workspace, dataset: Dataset, run: Run) -> None:
    with pytest.raises(UnknownName, match="did you mean 'squares-tiny'"):
        find_target(Path("sqares-tiny"), workspace)
    with pytest.raises(UnknownName, match=f"did you mean '{run.name}'"):
        find_target(Path(f"runs/{run.name}x"), workspace)


def test_something_else_is_told_what_is_wanted(workspace: Workspace, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=r"dataset.json.*run.json.*report.json"):
        find_target(tmp_path, workspace)


def test_episodes_asked_for_are_shown_once_and_in_order(dataset: Dataset) -> None:
    assert choose_episodes(dataset, [4, 2, 4], None) == [4, 2]
    assert choose_episodes(dataset, [], None) == [0, 1, 2]
    assert choose_episodes(dataset, [], "test") == dataset.split("test").tolist()


def test_an_episode_that_is_not_there(dataset: Dataset) -> None:
    with pytest.raises(UsageError, match="has no episode 10; it has 0 to 9"):
        choose_episodes(dataset, [10], None)
    other = int(dataset.split("train")[0])
    with pytest.raises(UsageError, match=f"episode {other} of squares-tiny is not in the test split"):
        choose_episodes(dataset, [other], "test")


def test_a_split_without_episodes_is_told(tmp_path: Path) -> None:
    dataset = write_squares(tmp_path / "one", episodes=1)
    assert choose_episodes(dataset, [], None) == [0]
    for asked in ([], [0]):
        with pytest.raises(UsageError, match="one has no episode in the test split; name another"):
            choose_episodes(dataset, asked, "test")


def test_a_report_on_another_data_set_belongs_to_both(workspace: Workspace, run: Run, dataset: Dataset) -> None:
    report = run.path / "report/on" / dataset.name
    report.mkdir(parents=True)
    (report / "report.json").write_text("{}")
    try:
        expected = Target("report", run.path.resolve(), workspace.data / dataset.name)
        for given in (report, Path(run.name) / "report/on" / dataset.name):
            assert find_target(given, workspace) == expected
        report.rename(report.with_name("elsewhere"))
        with pytest.raises(UnknownName, match="elsewhere"):
            find_target(report.with_name("elsewhere"), workspace)
    finally:
        shutil.rmtree(run.path / "report")


@pytest.mark.parametrize("place", ["validation", "on/squares-tiny/validation", "on/squares-tiny/generic-risk"])
def test_a_report_of_validation_episodes_or_of_a_column_is_itself(workspace: Workspace, run: Run, place: str) -> None:
    report = run.path / "report" / place
    report.mkdir(parents=True)
    (report / "report.json").write_text("{}")
    data = workspace.data / "squares-tiny" if place.startswith("on") else None
    try:
        for given in (report, Path(run.name) / "report" / place):
            assert find_target(given, workspace) == Target("report", run.path.resolve(), data, report.resolve())
        (deeper := report / "more").mkdir()
        (deeper / "report.json").write_text("{}")
        with pytest.raises(UsageError, match="cannot be shown"):
            find_target(deeper, workspace)
    finally:
        shutil.rmtree(run.path / "report")


def test_data_are_of_one_finished_run(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match="name that run alone, without --live"):
        data_of([Target("run", tmp_path)], tmp_path / "data", Workspace(tmp_path), live=True)
