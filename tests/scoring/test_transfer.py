"""A run scored on other data than its own: its figures are marked, kept apart, and never of what it was trained on."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import RunMismatch, RunMissing
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.pairing import compare_runs, scored_on
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.report import read_report, read_report_samples
from dmotion_bench.scoring.score import score_model, score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.transfer import transfer_folders
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset

from .conftest import write_dataset

MakeRun = Callable[..., Run]
QUICK = ScoreSettings(horizon=3, resamples=100)


@pytest.fixture
def other(tmp_path: Path) -> Dataset:
    """Of another seed: the same rules, other episodes."""
    return write_dataset(tmp_path / "data/other", seed=4)


def _score(run: Run, dataset: Dataset | None = None, **options: Any) -> Any:
    return score_run(run.path, settings=QUICK, data=None if dataset is None else dataset.path, **options)


@pytest.mark.slow
def test_the_figures_are_those_of_the_other_data_set(make_run: MakeRun, other: Dataset, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", offset=0.1)
    report = _score(run, other)

    expected = score_model(run.model, other, settings=QUICK)
    assert report.figures == {name: one.to_json() for name, one in expected.figures.items()}
    samples = read_report_samples(run.path / "report/on/other", report)
    assert samples is not None
    assert set(samples["episode"].to_pylist()) == set(other.split("test").tolist())


@pytest.mark.slow
def test_it_is_marked_and_stands_beside_the_run_s_own(
    make_run: MakeRun, grid: Dataset, other: Dataset, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run")
    own = _score(run)
    report = _score(run, other)

    assert report.dataset == {
        "name": "other",
        "environment": "grid_world",
        "fingerprint": other.fingerprint,
        "version": 2,
        "trained_on": {"name": grid.name, "fingerprint": grid.fingerprint},
    }
    assert report.trained_on == grid.name
    assert report.remarks["trained_on"] == f"trained on {grid.name!r}, and scored on 'other'"
    assert "paper" not in report.reference  # it was published for its own data
    assert report.summary()["trained_on"] == grid.name
    assert read_report(run.path / "report") == own
    assert own.trained_on is None
    assert "trained_on" not in own.summary()
    assert transfer_folders(run.path) == [run.path / "report/on/other"] == [run.path / report.place]


@pytest.mark.slow
def test_of_two_data_sets_of_one_name_each_keeps_its_report(make_run: MakeRun, other: Dataset, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    first = _score(run, other)
    namesake = write_dataset(tmp_path / "elsewhere/other", seed=5)
    second = _score(run, namesake)

    places = [run.path / "report/on/other", run.path / f"report/on/other-{namesake.fingerprint[:8]}"]
    assert [read_report(place) for place in places] == [first, second]
    assert transfer_folders(run.path) == places
    assert first.figures != second.figures
    assert _score(run, namesake, renew=False) == second
    assert _score(run, other, renew=False) == first
    for dataset, report in ((other, first), (namesake, second)):
        assert scored_on(run.path, dataset)[0] == report
        compared = {one.figure: one for one in compare_runs(run.path, run.path, dataset)}
        assert compared["mse"].first == pytest.approx(report.figures["mse"]["mean"])


@pytest.mark.slow
def test_a_report_on_a_data_set_of_the_same_name_is_not_taken_for_another(
    make_run: MakeRun, grid: Dataset, other: Dataset, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run")
    _score(run)
    _score(run, other)
    for name in ("other", grid.name):  # of a data set beside the run's own, and of the run's own
        namesake = write_dataset(tmp_path / "elsewhere" / name, seed=5)
        with pytest.raises(RunMissing, match=f"no whole report; score it with .* --data .*elsewhere/{name}"):
            compare_runs(run.path, run.path, namesake)
    report = run.path / "report/report.json"
    stored = json.loads(report.read_text())
    report.write_text(json.dumps(stored | {"dataset": stored["dataset"] | {"fingerprint": "0" * 64}}))
    with pytest.raises(RunMissing, match=r"is not of the data set in .* fingerprint 000000000000; score the run"):
        compare_runs(run.path, run.path, grid)


@pytest.mark.slow
def test_validation_episodes_have_a_report_of_their_own_that_no_leaderboard_reads(
    make_run: MakeRun, other: Dataset, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run")
    test = _score(run, other)
    chosen = score_run(
        run.path, metrics=("prediction",), settings=ScoreSettings(split="validation", resamples=100), data=other.path
    )

    assert chosen.place == Path("report/on/other/validation")
    assert read_report(run.path / chosen.place) == chosen
    assert read_report(run.path / test.place) == test
    assert transfer_folders(run.path) == [run.path / test.place]
    (difference, *_) = compare_runs(run.path, run.path, other, "validation")
    assert difference.first == chosen.figures[difference.figure]["mean"]


@pytest.mark.slow
def test_it_is_kept_while_it_is_true_and_its_own_data_set_is_no_other(
    make_run: MakeRun, grid: Dataset, other: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run")
    first = _score(run, other)
    with monkeypatch.context() as patch:
        patch.setattr("dmotion_bench.scoring.score.score_model", lambda *_, **__: pytest.fail("scored again"))
        assert _score(run, other, renew=False) == first
    assert _score(run, grid).place == Path("report")
    assert not (run.path / "report/on" / grid.name).exists()


@pytest.mark.slow
def test_episodes_that_the_run_was_trained_on_are_refused(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    """Recorded longer with the same seed: of the new test episodes some were the run's training."""
    longer = write_dataset(tmp_path / "data/longer", episodes=60)
    trained = {grid.rows[one].seed for one in (*grid.split("train"), *grid.split("validation"))}
    known = [one for one in longer.split("test").tolist() if longer.rows[one].seed in trained]
    assert known
    with pytest.raises(RunMismatch, match=rf"{len(known)} of the 6 test episodes .* \(episodes {known[0]}.*--seed"):
        _score(make_run(tmp_path / "run"), longer)


@pytest.mark.slow
def test_another_version_of_an_episode_is_no_new_episode(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    """Version 1 draws the same episodes with other pixels; with another seed it is a transfer like any other."""
    drawn_otherwise = write_dataset(tmp_path / "data/first", episodes=60, version=1)
    run = make_run(tmp_path / "run")
    with pytest.raises(RunMismatch, match=r"of the 6 test episodes .* has the seed"):
        _score(run, drawn_otherwise)
    report = _score(run, write_dataset(tmp_path / "data/elsewhere", seed=4, version=1))
    assert "version" not in report.dataset  # it is 1
    assert report.trained_on == grid.name


@pytest.mark.slow
def test_a_trained_layout_in_another_light_is_no_new_episode(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the first picture looks like."""
    longer = write_dataset(tmp_path / "data/longer", episodes=60)
    run = make_run(tmp_path / "run")
    as_it_is = Dataset.video

    def darker(self: Dataset, episode: int) -> np.ndarray:
        frames = as_it_is(self, episode)
        return frames // 2 if self.name == "longer" else frames

    monkeypatch.setattr(Dataset, "video", darker)
    with pytest.raises(RunMismatch, match=r"of the 6 test episodes .* has the seed of"):
        _score(run, longer)


@pytest.mark.slow
def test_without_the_training_s_data_the_report_says_that_nobody_looked(
    make_run: MakeRun, other: Dataset, tmp_path: Path
) -> None:
    run = make_run(tmp_path / "run")
    manifest = json.loads((run.path / "run.json").read_text())
    (run.path / "run.json").write_text(json.dumps(manifest | {"dataset_path": str(tmp_path / "gone")}))
    report = _score(Run.open(run.path), other)
    assert "whether its episodes are new to the run was not looked at" in report.remarks["trained_on"]


@pytest.mark.slow
def test_the_same_seed_with_the_same_split_holds_out_the_same(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    shorter = write_dataset(tmp_path / "data/shorter", frames=10)
    np.testing.assert_array_equal(shorter.split("test"), grid.split("test"))
    assert _score(make_run(tmp_path / "run"), shorter).figures["mse"]["n"] == len(grid.split("test")) * 8


def test_another_environment_is_refused(make_run: MakeRun, tmp_path: Path) -> None:
    record_dataset(tmp_path / "planar", DatasetRecipe(environment="planar_push", policy="push", episodes=4, frames=4))
    with pytest.raises(RunMismatch, match="trained in 'grid_world', and 'planar' is of 'planar_push'"):
        _score(make_run(tmp_path / "run"), Dataset.open(tmp_path / "planar"))


@pytest.mark.slow
@pytest.mark.parametrize(("changes", "said"), [({"width": 64}, "64 x 128 pixels"), ({"actions": 5}, "5 actions")])
def test_a_run_of_other_pictures_or_actions_is_refused(
    make_run: MakeRun, other: Dataset, tmp_path: Path, changes: dict[str, int], said: str
) -> None:
    run = make_run(tmp_path / "run", fingerprint="gone", **changes)
    with pytest.raises(RunMismatch, match=said):
        _score(run, other)


def test_without_data_a_changed_data_set_is_still_an_error(make_run: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(RunMismatch, match="has changed since"):
        _score(make_run(tmp_path / "run", fingerprint="another"))


@pytest.mark.slow
def test_runs_are_compared_where_both_were_scored(make_run: MakeRun, other: Dataset, tmp_path: Path) -> None:
    """One was trained there, the other elsewhere; both saw the same held-out episodes."""
    elsewhere = make_run(tmp_path / "elsewhere", offset=0.2)
    native = make_run(tmp_path / "native", fingerprint=other.fingerprint, dataset=other.name)
    native.manifest["dataset_path"] = str(other.path)
    native.write()
    for run in (elsewhere, native):
        _score(run, other)

    found = {one.figure: one for one in compare_runs(elsewhere.path, native.path, other)}
    assert found["mse"].difference.mean > 0
    assert found["mse"].verdict == "unknown: 3 episodes"
    assert scored_on(native.path, other)[0].trained_on is None
    _score(elsewhere)
    with pytest.raises(RunMismatch, match="were scored on different data sets"):
        compare_runs(elsewhere.path, native.path)


@pytest.mark.slow
def test_control_is_scored_on_the_other_data_set_s_tasks(make_run: MakeRun, tmp_path: Path) -> None:
    recipe = DatasetRecipe(environment="grid_world", policy="random", episodes=20, frames=32, seed=5, tasks=2)
    record_dataset(tmp_path / "data/tasks", recipe)
    run = make_run(tmp_path / "run")
    control = replace(QUICK.control, tasks=2, steps=2)
    report = score_run(
        run.path, metrics=("control",), settings=replace(QUICK, control=control), data=tmp_path / "data/tasks"
    )
    assert report.figures["control_distance[2]"]["n"] == 2
    assert json.loads((run.path / "report/on/tasks/report.json").read_text())["settings"]["control_steps"] == 2
