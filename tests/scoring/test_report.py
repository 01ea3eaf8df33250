"""Reports: every figure follows from the samples, and a report stands whole or not at all."""

from __future__ import annotations

import contextlib
import functools
import json
import operator
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from killed_writes import Killed, each_kill, killed_at
from known_model import Known

from dmotion_bench.actions import Continuous
from dmotion_bench.cli.report_table import _shown, show_overview
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, RunCorrupt, RunMismatch, RunMissing, StorageFull
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.pairing import compare_runs
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.references import PublishedFigure, PublishedResult, published_for
from dmotion_bench.scoring.report import read_report, read_report_samples, settled, write_report
from dmotion_bench.scoring.samples import FIGURE_COLUMNS
from dmotion_bench.scoring.score import score_model, score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.statistics import FEWEST_EPISODES
from dmotion_bench.storage.atomic import remove_leftovers
from dmotion_bench.storage.dataset import Dataset

from .conftest import Oracle, write_dataset
from .test_identification import SeesGreen

QUICK = ScoreSettings(horizon=3, resamples=100)
PAPER = PublishedResult(
    model="dmotion",
    environment="grid_world",
    labels="one-shot",
    figures={"mse": PublishedFigure(mean=14.3, std=99.8)},
    source="Yuan et al. 2021",
)

MakeRun = Callable[..., Run]


@pytest.fixture(autouse=True)
def _paper(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.scoring.references.published_results", lambda: [PAPER])


@pytest.mark.slow
def test_every_figure_follows_from_the_samples(make_run: MakeRun, tmp_path: Path) -> None:
    score_run(make_run(tmp_path / "run", offset=0.1).path, settings=QUICK)
    report = json.loads((tmp_path / "run/report/report.json").read_text())
    samples = pq.read_table(tmp_path / "run/report/samples.parquet")

    for predictor, figures in {"model": report["figures"], **report["reference"]}.items():
        if predictor == "paper":
            continue
        assert len(figures) > 10
        for name, figure in figures.items():
            rows = samples.filter(pc.equal(samples["predictor"], predictor))
            base, _, ahead = name.removeprefix("rollout_").rstrip("]").partition("[")
            rows = rows.filter(pc.equal(rows["metric"], "rollout" if ahead else "prediction"))
            if ahead:
                rows = rows.filter(pc.equal(rows["ahead"], int(ahead)))
            if base.endswith("_push"):
                rows = rows.filter(rows["pushed"])
            values = rows[base.removesuffix("_push")].drop_null().to_numpy().astype(float)
            assert figure["n"] == len(values), name
            known = rows.filter(rows[base.removesuffix("_push")].is_valid())
            assert figure["episodes"] == len(known["episode"].unique()), name
            assert figure["mean"] == pytest.approx(values.mean(), rel=1e-9), name
            assert figure["std"] == pytest.approx(values.std(), rel=1e-9), name
            if figure["low"] is None:
                assert figure["episodes"] < FEWEST_EPISODES, name
            else:
                assert figure["low"] <= figure["mean"] <= figure["high"], name


@pytest.mark.slow
def test_the_motion_s_variances_follow_from_the_samples(grid: Dataset) -> None:
    scores = score_model(SeesGreen(), grid, metrics=("prediction",), settings=QUICK)
    rows = [row for row in scores.samples.to_pylist() if row["predictor"] == "model"]
    motion, action = np.array([row["motion"] for row in rows]), np.array([row["action"] for row in rows])

    means = np.array([motion[action == one].mean(0) for one in action])

    within, between = ((motion - means) ** 2).mean(0).sum(), means.var(0).sum()
    assert scores.figures["motion_within_over_between"].mean == pytest.approx(within / between)


@pytest.mark.slow
def test_the_report_says_how_it_was_made(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    score_run(run.path, settings=QUICK)
    report = json.loads((run.path / "report/report.json").read_text())

    assert report["protocol"] == "dmbench-1"
    assert report["weights"] == run.result["weights"]
    assert report["dataset"] == {
        "name": "grid_world-tiny",
        "environment": "grid_world",
        "fingerprint": grid.fingerprint,
        "version": 2,
    }
    assert report["labels"] == {"asked": "one-shot", "given": {"demonstrations": 4}, "total": 4}
    assert report["training"]["seconds"] == 1.5
    assert report["settings"]["metrics"] == ["prediction", "rollout"]
    assert {"python", "torch", "numpy"} <= set(report["versions"])
    assert report["reference"]["paper"]["mse"] == {"mean": 14.3, "std": 99.8, "low": None, "high": None, "n": None}
    assert "Yuan" in report["remarks"]["paper"]


@pytest.mark.slow
def test_many_reports_are_shown_with_the_paired_difference_to_the_best(
    make_run: MakeRun, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [make_run(tmp_path / name).path for name in ("one", "two")]
    show_overview({path: score_run(path, metrics=("prediction",), settings=QUICK) for path in paths})
    lines = capsys.readouterr().out.splitlines()
    assert any("MSE above the best, 95%" in line for line in lines)
    (first, second) = (line.split() for line in lines if line.lstrip().startswith(("one ", "two ")))
    assert "best" in first
    assert "unknown:" in second  # two episodes have no interval


@pytest.mark.slow
def test_a_table_shows_the_last_step_of_control_however_many_there_are() -> None:
    def steps(last: int) -> list[str]:
        return _shown(f"control_distance[{step}]" for step in range(1, last + 1))

    assert steps(50) == [f"control_distance[{step}]" for step in (10, 20, 40, 50)]
    assert steps(100)[-1] == "control_distance[100]"
    assert steps(7) == ["control_distance[7]"]


def test_the_same_run_gives_the_same_bytes(make_run: MakeRun, tmp_path: Path) -> None:
    files = []
    for place in ("a", "b"):
        run = make_run(tmp_path / place / "run")
        score_run(run.path, settings=QUICK)
        files.append([(run.path / "report" / name).read_bytes() for name in ("report.json", "samples.parquet")])

    assert files[0] == files[1]


@pytest.mark.slow
def test_whenever_it_is_killed_a_report_stands_with_its_samples(make_run: MakeRun, tmp_path: Path) -> None:
    """Of the old report and the new one; and the next command leaves no other file behind."""
    path = make_run(tmp_path / "run").path / "report"
    old = score_run(path.parent, settings=QUICK)
    samples = read_report_samples(path, old)
    new, fewer, found = replace(old, remarks={"new": "yes"}), samples.slice(1), set()

    def write(moment: int) -> None:
        shutil.copytree(path, tmp_path / f"{moment}")
        write_report(tmp_path / f"{moment}", new, fewer)

    def check(folder: Path) -> bool:
        report = read_report(folder)
        is_new = report.remarks == new.remarks
        assert read_report_samples(folder, report).equals(fewer if is_new else samples)
        return is_new

    for moment in each_kill(write):
        folder = tmp_path / f"{moment}"
        found.add(was_new := check(folder))
        with contextlib.suppress(Killed), killed_at(moment):  # once more
            write_report(folder, new, fewer)
        assert check(folder) >= was_new
        remove_leftovers(folder)
        assert settled(folder) == folder
        check(folder)
        assert sorted(file.name for file in folder.iterdir()) == ["report.json", "samples.parquet"]
    assert found == {True, False}


@pytest.mark.slow
def test_a_full_disk_between_samples_and_report_loses_no_group_of_figures(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = make_run(tmp_path / "run").path
    first = score_run(path, metrics=("rollout",), settings=QUICK)

    def full(path: Path, data: bytes) -> None:
        raise StorageFull(f"no space left for {path}")

    with monkeypatch.context() as patch:
        patch.setattr("dmotion_bench.scoring.report.write_atomically", full)
        with pytest.raises(StorageFull):
            score_run(path, metrics=("prediction",), settings=QUICK)
    both = score_run(path, metrics=("prediction",), settings=QUICK)
    assert both.settings["metrics"] == ["rollout", "prediction"]
    assert {name: both.figures[name] for name in first.figures} == first.figures
    assert sorted(file.name for file in (path / "report").iterdir()) == ["report.json", "samples.parquet"]


@pytest.mark.slow
def test_the_validation_episodes_are_others(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    path = make_run(tmp_path / "run").path

    score_run(path, metrics=("prediction",), settings=ScoreSettings(split="validation", resamples=100))

    episodes = pq.read_table(path / "report/validation/samples.parquet")["episode"].unique().to_pylist()
    assert episodes == grid.split("validation").tolist()


@pytest.mark.slow
def test_scoring_on_validation_episodes_leaves_the_report_of_the_test(make_run: MakeRun, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    settings = ScoreSettings(split="validation", resamples=100)
    test = score_run(run.path, metrics=("prediction",), settings=QUICK)

    chosen = score_run(run.path, metrics=("prediction",), settings=settings)

    assert chosen.place == Path("report/validation")
    assert read_report(run.path / chosen.place) == chosen
    assert read_report(run.path / test.place) == test
    assert compare_runs(run.path, run.path, split="validation")[0].first == chosen.figures["mse"]["mean"]
    assert compare_runs(run.path, run.path)[0].first == test.figures["mse"]["mean"]
    shutil.rmtree(run.path / "report/validation")
    with pytest.raises(RunMissing, match="--split validation"):
        compare_runs(run.path, run.path, split="validation")


@pytest.mark.slow
def test_what_is_wrong_is_said(make_run: MakeRun, tmp_path: Path) -> None:
    with pytest.raises(RunMissing, match="not finished"):
        score_run(make_run(tmp_path / "unfinished", finished=False).path)
    with pytest.raises(RunMismatch, match="has changed since the run 'other' was trained"):
        score_run(make_run(tmp_path / "other", fingerprint="of another").path)
    run = make_run(tmp_path / "run")
    score_run(run.path, settings=QUICK)
    file = run.path / "report/report.json"
    sound = file.read_text()
    for path, value in (
        ("figures.mse.mean", [1.0]),
        ("figures.mse", None),
        ("figures.mse", {"mean": 1.0}),
        ("figures.rollout_mse[x]", {"mean": 1.0, "std": 0.0, "low": None, "high": None, "n": 1}),
        ("reference.copy_last.mse.n", 2.5),
        ("reference", []),
        ("figures.mse.episodes", [1]),
        ("planning.planner", "x"),
        ("labels.total", "3"),
        ("dataset.trained_on", {"name": "other"}),
        ("settings.metrics", "prediction"),
        ("samples.sha256", 7),
    ):
        report = json.loads(sound)
        *above, last = path.split(".")
        functools.reduce(operator.getitem, above, report)[last] = value
        file.write_text(json.dumps(report))
        with pytest.raises(RunCorrupt, match=rf"report\.{re.escape(path)}.* delete it and score the run again"):
            score_run(run.path, settings=QUICK)
    file.write_text('{"protocol": ')
    with pytest.raises(RunCorrupt, match="delete it and score the run again"):
        score_run(run.path, settings=QUICK)


@pytest.mark.parametrize(
    "content",
    [
        b"[]",
        b"\xff",
        b'{"seed": ' + b"9" * 5000 + b"}",
        b'{"run": ' * 100_000 + b"1" + b"}" * 100_000,
        b'{"seed": NaN}',
    ],
    ids=["list", "text", "digits", "depth", "nan"],
)
def test_a_report_that_no_json_reader_should_be_given_costs_a_sentence(content: bytes, tmp_path: Path) -> None:
    (tmp_path / "report.json").write_bytes(content)
    with pytest.raises(RunCorrupt, match="delete it and score the run again"):
        read_report(tmp_path)


def test_without_labels_nothing_can_be_scored(oracle: Oracle, tmp_path: Path) -> None:
    dataset = write_dataset(tmp_path / "data", episodes=10, frames=6)
    for file in (dataset.path / "labels").iterdir():
        file.unlink()

    with pytest.raises(LabelsNotAvailable):
        score_model(oracle, dataset, settings=QUICK)


@pytest.mark.slow
def test_what_could_not_be_read_again_is_not_scored(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run")
    rows = len(pq.read_table(_scored(run.path)))
    monkeypatch.setattr("dmotion_bench.scoring.samples.MOST_SAMPLES", rows)
    _scored(run.path)
    monkeypatch.setattr("dmotion_bench.scoring.samples.MOST_SAMPLES", rows - 1)
    shutil.rmtree(run.path / "report")
    asked: list[str] = []
    how = Execution(progress=lambda what, done, total: asked.append(what))
    with pytest.raises(InvalidSetting, match=f"would make {rows:,} samples, and a report can have {rows - 1:,}"):
        score_run(run.path, settings=QUICK, how=how)
    assert not asked


def _scored(run: Path) -> Path:
    shutil.rmtree(run / "report", ignore_errors=True)
    score_run(run, settings=QUICK)
    return run / "report/samples.parquet"


def test_episodes_that_are_too_short_have_no_rollouts(make_run: MakeRun, tmp_path: Path) -> None:
    report = score_run(make_run(tmp_path / "run").path, metrics=("rollout",), settings=ScoreSettings())

    assert report.figures == {}
    assert "17 frames" in report.remarks["rollout"]


def test_a_model_that_draws_nothing_is_not_told_that_episodes_are_too_short(
    make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Blind(Known):
        needs_pixels = False

    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Blind)
    report = score_run(make_run(tmp_path / "run").path, metrics=("rollout",), settings=QUICK)

    assert report.figures == {}
    assert "rollout" not in report.remarks


def test_a_published_row_stands_beside_the_run_it_belongs_to() -> None:
    def row(model: str, labels: str, environment: str = "grid_world") -> PublishedResult:
        return PublishedResult(model=model, environment=environment, labels=labels, figures={}, source="")

    rows = [row("a", "100%"), row("a", "10%"), row("b", "one-shot"), row("a", "10%", "robot_push")]

    assert published_for("a", "grid_world", "10%", rows) is rows[1]
    assert published_for("b", "grid_world", "5-shot", rows) is rows[2]
    assert published_for("a", "grid_world", "50%", rows) is None
    assert published_for("c", "grid_world", "10%", rows) is None
    moves = Continuous(names=("dx",), low=(-1.0,), high=(1.0,), units=("m",))
    assert published_for("a", "grid_world", "10%", rows, actions=moves) is None


@pytest.mark.slow
def test_the_columns_of_the_figures_are_in_the_samples(grid: Dataset, oracle: Oracle) -> None:
    samples = score_model(oracle, grid, settings=QUICK).samples

    assert set(FIGURE_COLUMNS) <= set(samples.column_names)
    # 3 test episodes of 12 triplets; 4 rollouts of 3 steps each; 2 references, 1 of them rolled out
    assert len(samples) == 3 * 12 * 3 + 3 * 4 * 3 * 2


def test_settings_without_a_draw_or_a_step_are_refused() -> None:
    for name in ("resamples", "horizon"):
        for wrong in (0, -1):
            with pytest.raises(InvalidSetting, match=f"{name} is {wrong}"):
                ScoreSettings(**{name: wrong})
