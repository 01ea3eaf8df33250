"""The gain captured: what models' favourite sequences truly bring, beside the best that could be had."""

from __future__ import annotations

import json
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pytest
from known_model import Known, NoConfig, write_run
from planning.worlds import PerfectGridModel

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UnknownName
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.pairing import compare_runs
from dmotion_bench.planning.objectives.pixel import Pixel
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.differences import differences
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.gain import GainScoring, _key, gain_tables, known_truth, reason_against
from dmotion_bench.scoring.kept_gain import FORMAT, kept
from dmotion_bench.scoring.prediction import MODEL, Execution
from dmotion_bench.scoring.report import read_report
from dmotion_bench.scoring.samples import GAIN, SampleRows, read_samples
from dmotion_bench.scoring.score import is_scored, score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import cache_folder

FEW = GainScoring(moments=6, sequences=10, horizon=3)
QUICK = ScoreSettings(horizon=1, resamples=100, gain=FEW)


@pytest.fixture(scope="module")
def pushed(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A Grid World whose test episodes move something; its cache knows what can be gained."""
    path = tmp_path_factory.mktemp("data") / "grid"
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=100, frames=32
    )
    record_dataset(path, recipe)
    dataset = Dataset.open(path)
    known_truth(dataset, "test", FEW, Execution())
    return dataset


@pytest.fixture
def no_simulator(monkeypatch: pytest.MonkeyPatch) -> None:
    def gone(*_: Any) -> Any:
        raise AssertionError("the simulator was asked for")

    monkeypatch.setattr("dmotion_bench.scoring.gain.task_environment", gone)


def _figures(samples: pa.Table, who: str = MODEL) -> Any:
    return figures_of(samples, who, resamples=100)["planning_gain"]


def _rows(gains: list[float], best: list[float], episodes: list[int], who: str = MODEL) -> pa.Table:
    rows, count = SampleRows(GAIN, who), len(gains)
    columns = {"gain": np.array(gains), "best_gain": np.array(best), "episode": np.array(episodes)}
    rows.add(columns | {"step": np.arange(count), "ahead": np.full(count, 5)})
    return rows.table()


def test_the_figure_is_a_share_of_all_that_could_be_gained() -> None:
    samples = _rows([0.5, 0.0, -0.1], [0.5, 0.3, 0.2], [1, 1, 2])
    figure = figures_of(samples, MODEL, resamples=100, fewest=2)["planning_gain"]

    assert figure.mean == pytest.approx(0.4)
    assert figure.n == 3
    assert figure.low is not None
    assert figure.high is not None
    assert figure.low <= figure.mean <= figure.high
    assert (_figures(samples).low, _figures(samples).episodes) == (None, 2)
    assert figure.std == pytest.approx(np.std([1, 0, -0.5]))


def test_moments_of_two_stretches_at_one_frame_are_all_compared() -> None:
    """Frame 3 of episode 1 is a moment three times, with other goals; twice as much can be gained."""
    first = _rows([0.5, 0.1, 0.0, 0.2], [0.5, 0.4, 0.4, 0.2], [1, 1, 1, 2])
    frames = pa.array([3, 3, 3, 0], pa.int32())
    first = first.set_column(first.column_names.index("step"), "step", frames)
    second = first.set_column(first.column_names.index("gain"), "gain", pa.array([0.25, 0.4, 0.1, 0.2], pa.float32()))

    (found,) = differences([first], [second])

    assert found.difference.n == 4
    for mine, samples in ((found.first, first), (found.second, second)):
        assert mine == pytest.approx(figures_of(samples, MODEL)["planning_gain"].mean)
    (fewer,) = differences([first], [second.filter(pc.greater(second["best_gain"], 0.41))])
    assert (fewer.difference.n, fewer.first, fewer.second) == (1, pytest.approx(1.0), pytest.approx(0.5))


@pytest.mark.slow
def test_a_perfect_model_picks_as_the_true_frames_do(pushed: Dataset, no_simulator: None) -> None:
    tables = pa.concat_tables(gain_tables(PerfectGridModel(2).eval(), pushed, "test", FEW, Execution()))
    model, oracle, chance = (_figures(tables, who) for who in (MODEL, "oracle", "random"))

    assert model.mean == oracle.mean
    assert 0.8 < oracle.mean <= 1
    assert chance.mean < 0.3
    assert model.n == len(known_truth(pushed, "test", FEW, Execution()).moments)


@pytest.mark.slow
def test_a_model_that_sees_no_change_brings_what_the_first_sequence_brings(pushed: Dataset, no_simulator: None) -> None:
    still = Known(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4))).eval()
    tables = pa.concat_tables(gain_tables(still, pushed, "test", FEW, Execution()))
    first = [moment.gains[0] for moment in known_truth(pushed, "test", FEW, Execution()).moments]
    mine = tables.filter(pc.equal(tables["predictor"], MODEL))

    assert mine["gain"].to_pylist() == pytest.approx(first)
    assert mine["action"].to_pylist() == [0] * len(first)


@pytest.mark.slow
def test_what_is_kept_is_what_was_found(pushed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = known_truth(pushed, "test", FEW, Execution())
    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path))
    anew = known_truth(pushed, "test", FEW, Execution())

    assert [moment.offset for moment in anew.moments] == [moment.offset for moment in before.moments]
    assert all((one.after == other.after).all() for one, other in zip(anew.moments, before.moments, strict=True))
    assert (anew.oracle == before.oracle).all()
    assert (anew.sequences == before.sequences).all()


@pytest.mark.slow
@pytest.mark.parametrize("spoil", ["digit", "cut", "key", "list"])
def test_a_damaged_cache_is_made_again(
    pushed: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    spoil: str,
) -> None:
    (sound_file,) = cache_folder(pushed.path).glob("gain-*.json")
    sound = sound_file.read_text()
    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path))
    content = json.loads(sound)
    spoilt = {
        "digit": lambda: sound.replace('\\"now\\": 1.0', '\\"now\\": 1.5'),
        "cut": lambda: sound[: len(sound) // 2],
        "key": lambda: json.dumps({name: value for name, value in content.items() if name != "known"}),
        "list": lambda: json.dumps(content | {"known": []}),
    }[spoil]()
    assert spoilt != sound
    file = tmp_path / "gain.json"
    monkeypatch.setattr("dmotion_bench.scoring.gain._place", lambda *_: file)
    file.write_text(spoilt)

    known_truth(pushed, "test", FEW, Execution())

    assert json.loads(file.read_text()) == content
    assert ["is damaged" in record.message for record in caplog.records] == [True]


def _kept(dataset: Dataset, file: Path, known: Any) -> Any:
    """What is taken of a file with a right checksum."""
    text = known if isinstance(known, str) else json.dumps(known)
    file.write_text(json.dumps({"format": FORMAT, "crc32": zlib.crc32(text.encode()), "known": text}))
    sequences = known_truth(dataset, "test", FEW, Execution()).sequences
    return kept(file, json.loads(_sound(dataset)["known"])["key"], dataset, "test", sequences)


def _sound(dataset: Dataset) -> dict[str, Any]:
    (file,) = cache_folder(dataset.path).glob("gain-*.json")
    content: dict[str, Any] = json.loads(file.read_text())
    return content


FORGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "nested deeply": lambda _: "[" * 200_000,
    "an array": lambda known: [known],
    "no such episode": lambda known: _with_moment(known, task=[10**9, 0, 5]),
    "a task before the episode": lambda known: _with_moment(known, task=[known["moments"][0]["task"][0], -3, 5]),
    "a goal behind the episode": lambda known: _with_moment(known, task=[known["moments"][0]["task"][0], 0, 10**6]),
    "parts of a frame": lambda known: _with_moment(known, task=[known["moments"][0]["task"][0], 0.5, 5]),
    "an offset behind the goal": lambda known: _with_moment(known, offset=40),
    "an offset before the start": lambda known: _with_moment(known, offset=-1),
    "too few sequences": lambda known: _with_moment(known, after=[0.5]),
    "no numbers": lambda known: _with_moment(known, now=None),
    "an oracle's pick that is none": lambda known: known | {"oracle": [999] * len(known["oracle"])},
    "an oracle's pick from behind": lambda known: known | {"oracle": [-1] * len(known["oracle"])},
    "an oracle's pick too few": lambda known: known | {"oracle": known["oracle"][1:]},
    "an enormous pick": lambda known: known | {"oracle": [2**64 - 1] * len(known["oracle"])},
}


def _with_moment(known: dict[str, Any], **fields: Any) -> dict[str, Any]:
    return known | {"moments": [known["moments"][0] | fields, *known["moments"][1:]]}


@pytest.mark.parametrize("forged", FORGED)
def test_a_forged_cache_is_no_cache(pushed: Dataset, tmp_path: Path, forged: str) -> None:
    known = json.loads(_sound(pushed)["known"])

    assert _kept(pushed, tmp_path / "gain.json", known) is not None
    assert _kept(pushed, tmp_path / "gain.json", FORGED[forged](known)) is None


def test_moments_of_training_episodes_are_not_taken_for_those_of_the_test(pushed: Dataset, tmp_path: Path) -> None:
    known = json.loads(_sound(pushed)["known"])
    other = _with_moment(known, task=[int(pushed.split("train")[0]), *known["moments"][0]["task"][1:]])

    assert _kept(pushed, tmp_path / "gain.json", other) is None


def test_a_cache_is_read_however_much_there_is_to_keep(
    pushed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.scoring.kept_gain.LARGEST", 0)
    monkeypatch.setattr("dmotion_bench.scoring.kept_gain.MOST_VALUES", 0)

    assert _kept(pushed, tmp_path / "gain.json", json.loads(_sound(pushed)["known"])) is not None


def _not_installed(*_: Any) -> Any:
    raise UnknownName("environment", "of another package", [])


def test_what_is_kept_is_used_where_the_environment_is_not_installed(
    pushed: Dataset, no_simulator: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    before = known_truth(pushed, "test", FEW, Execution())
    monkeypatch.setattr("dmotion_bench.planning.tasks.environment_class", _not_installed)

    assert reason_against(pushed, "test", FEW) is None
    there = known_truth(pushed, "test", FEW, Execution())
    for one, other in zip(there.moments, before.moments, strict=True):
        assert one.problem.task == other.problem.task
        np.testing.assert_array_equal(one.problem.goal_frame, other.problem.goal_frame)


def test_what_an_earlier_release_kept_does_not_stand_in_for_an_environment_that_may_set_goals(
    pushed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    known = json.loads(_sound(pushed)["known"])
    earlier = {name: value for name, value in known.items() if name != "recorded_goals"}
    assert _kept(pushed, tmp_path / "gain.json", earlier) is not None
    sequences = known_truth(pushed, "test", FEW, Execution()).sequences
    monkeypatch.setattr("dmotion_bench.planning.tasks.environment_class", _not_installed)

    assert kept(tmp_path / "gain.json", known["key"], pushed, "test", sequences) is None


@pytest.mark.slow
def test_an_objective_that_learns_from_video_can_be_picked_by(pushed: Dataset) -> None:
    scoring = GainScoring(moments=2, sequences=5, horizon=2, objective="tracked-belief")
    tables = pa.concat_tables(gain_tables(PerfectGridModel(2).eval(), pushed, "test", scoring, Execution()))

    assert _figures(tables).mean == _figures(tables, "oracle").mean
    assert known_truth(pushed, "test", scoring, Execution()).moments  # out of the cache


def test_an_objective_with_the_fields_of_another_does_not_take_its_picks(
    pushed: Dataset, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.scoring.gain.make_objective", lambda *_: Pixel())
    keys = [_key(pushed, "test", replace(FEW, objective=name)) for name in ("pixel", "mine")]

    assert keys[0] != keys[1]
    assert _key(pushed, "test", FEW)["objective"]["name"] == ""  # as in files that there are


def test_other_settings_have_moments_of_their_own(pushed: Dataset, no_simulator: None) -> None:
    with pytest.raises(AssertionError, match="asked for"):
        known_truth(pushed, "test", GainScoring(moments=6, sequences=10, horizon=2), Execution())
    with pytest.raises(AssertionError, match="asked for"):
        known_truth(pushed, "validation", FEW, Execution())


@pytest.fixture
def run(pushed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)
    return write_run(tmp_path / "first", pushed)


@pytest.mark.slow
def test_a_report_has_the_gain_unless_it_is_left_out(run: Run) -> None:
    report = score_run(run.path, metrics=None, settings=QUICK)
    kept = score_run(run.path, metrics=("rollout",), settings=QUICK)

    assert report.settings["metrics"] == ["prediction", "rollout", "gain"]
    assert report.settings["gain_horizon"] == 3
    assert kept.figures == report.figures
    assert {"random", "oracle"} <= report.reference.keys()


@pytest.mark.slow
def test_a_report_without_the_gain_is_written_as_before(run: Run) -> None:
    report = score_run(run.path, metrics=("prediction",), settings=QUICK)
    samples = run.path / "report" / "samples.parquet"

    assert not [name for name in report.settings if name.startswith("gain")]
    assert "best_gain" not in pa.parquet.read_schema(samples).names
    assert read_samples(samples)["best_gain"].null_count == report.samples["rows"]


@pytest.mark.slow
def test_other_moments_are_scored_anew(run: Run) -> None:
    first = score_run(run.path, metrics=("gain",), settings=QUICK)
    fewer = replace(QUICK, gain=replace(FEW, moments=3))
    second = score_run(run.path, metrics=("gain",), settings=fewer, renew=False)

    assert first.figures["planning_gain"]["n"] > second.figures["planning_gain"]["n"] > 0


@pytest.mark.slow
def test_runs_are_compared_at_the_same_moments(
    run: Run, pushed: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    still = score_run(run.path, metrics=("gain",), settings=QUICK)
    perfect = write_run(tmp_path / "second", pushed)
    monkeypatch.setattr(Run, "model", property(lambda _: PerfectGridModel(2).eval()))
    better = score_run(perfect.path, metrics=("gain",), settings=QUICK)

    (difference,) = compare_runs(perfect.path, run.path)

    assert difference.figure == "planning_gain"
    assert difference.difference.mean == pytest.approx(
        better.figures["planning_gain"]["mean"] - still.figures["planning_gain"]["mean"]
    )
    assert difference.difference.mean > 0


@pytest.mark.slow
def test_where_no_sequence_brings_anything_the_other_figures_are_computed(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    tried, settings = list[None](), replace(QUICK, gain=replace(FEW, sequences=16))
    monkeypatch.setattr("dmotion_bench.scoring.gain.find_moment", lambda *_: tried.append(None))

    report = score_run(run.path, metrics=None, settings=settings)
    once = len(tried)
    again = score_run(run.path, metrics=None, settings=settings, renew=False)

    assert report.settings["metrics"] == ["prediction", "rollout"]
    assert report.remarks["gain"].startswith("not measured: none of 16 action sequences brings an object nearer")
    assert again.figures == report.figures
    assert len(tried) == once > 0  # it is kept that nothing was found
    assert is_scored(run.path, None, settings)
    with pytest.raises(LabelsNotAvailable, match=r"none of 16 action sequences .* leave it out of '--metrics'"):
        score_run(run.path, metrics=("gain",), settings=settings)


def test_a_gain_that_cannot_be_is_refused(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    for wrong in ({"moments": 0}, {"sequences": 0}, {"horizon": 0}, {"seed": -1}, {"objective_set": ("a=1",)}):
        with pytest.raises(InvalidSetting):
            GainScoring(**wrong)
    with pytest.raises(InvalidSetting, match="sequences times horizon is 300000"):
        GainScoring.from_json(GainScoring(sequences=3000, horizon=100).to_json())
    monkeypatch.setattr("dmotion_bench.scoring.gain._stretches", lambda *_: [])
    other = replace(QUICK, gain=GainScoring(moments=1))
    with pytest.raises(LabelsNotAvailable, match="no test episode has a stretch of up to 29 steps in which"):
        score_run(run.path, metrics=("gain",), settings=other)
    monkeypatch.setattr("dmotion_bench.scoring.score.DEFAULT_METRICS", ())
    report = score_run(run.path, metrics=None, settings=other)
    assert report.remarks["gain"].startswith("not measured: no test episode has a stretch of up to 29 steps in which")
    assert read_report(run.path / "report") == report
