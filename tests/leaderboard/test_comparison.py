"""Differences are paired: the same frames, and 'better' only where the interval says so."""

from __future__ import annotations

import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from dmotion_bench.cli.report_table import show_overview
from dmotion_bench.errors import RunMismatch, RunMissing
from dmotion_bench.pairing import compare_runs, scored
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.differences import behind, differences, standing
from dmotion_bench.scoring.figures import ROLLOUT_COLUMNS
from dmotion_bench.scoring.gain import GainScoring
from dmotion_bench.scoring.report import Report, read_report, read_report_samples, write_report
from dmotion_bench.scoring.samples import SampleRows
from dmotion_bench.scoring.statistics import EpisodeBootstrap, wilson
from dmotion_bench.workspace import Workspace
from leaderboard.comparison import difference_by_episode, figures_by_samples, sums_by_episode

S0, S1, CSWM = "dmotion-grid_world-tiny-s0", "dmotion-grid_world-tiny-s1", "cswm-grid_world-tiny-10pct-s0"


def _rows(workspace: Workspace, run: str) -> list[dict[str, float]]:
    table = pq.read_table(workspace.runs / run / "report/samples.parquet")
    return [row for row in table.to_pylist() if row["predictor"] == "model"]


@pytest.mark.slow
def test_every_figure_is_the_mean_of_the_frames_differences(scored_workspace: Workspace) -> None:
    found = {one.figure: one for one in compare_runs(scored_workspace.runs / S0, scored_workspace.runs / CSWM)}
    rows = {name: _rows(scored_workspace, name) for name in (S0, CSWM)}
    second = {(row["metric"], row["episode"], row["step"], row["ahead"]): row for row in rows[CSWM]}

    assert {"mse", "mse_push", "ssim", "position_error", "rollout_mse[1]", "rollout_miss_rate[3]"} <= set(found)
    for figure, one in found.items():
        base, _, ahead = figure.removeprefix("rollout_").rstrip("]").partition("[")
        name = base.removesuffix("_push")
        apart = []
        for row in rows[S0]:
            other = second[row["metric"], row["episode"], row["step"], row["ahead"]]
            wanted = row["metric"] == ("rollout" if ahead else "prediction")
            wanted &= not ahead or row["ahead"] == int(ahead)
            wanted &= base == name or bool(row["pushed"])
            if wanted and row[name] is not None and other[name] is not None:
                apart.append((row[name], other[name]))
        assert one.difference.n == len(apart), figure
        assert one.difference.mean == pytest.approx(np.mean([a - b for a, b in apart]), rel=1e-6, abs=1e-9), figure
        assert (one.first, one.second) == pytest.approx(tuple(np.mean(apart, axis=0)), rel=1e-9), figure


def test_the_other_way_round_it_is_the_other_sign(scored_workspace: Workspace) -> None:
    one, other = (
        {found.figure: found for found in compare_runs(scored_workspace.runs / a, scored_workspace.runs / b)}
        for a, b in ((S0, CSWM), (CSWM, S0))
    )

    assert one["mse"].difference.mean == -other["mse"].difference.mean
    assert one["mse"].better == "first"
    assert other["mse"].better == "second"
    assert one["psnr"].better == "first"


def test_sums_over_episodes_tell_the_same_as_the_samples(scored_workspace: Workspace) -> None:
    tables = [pq.read_table(scored_workspace.runs / name / "report/samples.parquet") for name in (S0, CSWM)]
    for figure in ("mse", "mse_push", "position_error_paper"):
        rows = [
            [row for row in table.to_pylist() if row["predictor"] == "model" and row["metric"] == "prediction"]
            for table in tables
        ]
        rows = [[row for row in own if not figure.endswith("_push") or row["pushed"]] for own in rows]
        values = [np.array([row[figure.removesuffix("_push")] for row in own], float) for own in rows]
        wanted = EpisodeBootstrap(np.array([row["episode"] for row in rows[0]])).mean(values[0] - values[1])

        found = difference_by_episode(*([sums_by_episode(table)[figure]] for table in tables))

        assert wanted is not None
        assert found is not None
        assert found.mean == pytest.approx(wanted.mean, rel=1e-9)
        assert (found.low is None) == (wanted.low is None)
        if wanted.low is not None:
            assert (found.low, found.high) == pytest.approx((wanted.low, wanted.high), rel=1e-9)
        assert found.n == wanted.n


def test_sums_of_the_gain_captured_tell_the_same_as_the_samples(workspace: Workspace) -> None:
    first, second = (_with_control(workspace, name, PLANNED, GainScoring()) for name in (S0, CSWM))
    samples = [scored(run)[1] for run in (first, second)]
    better_one = samples[1].set_column(
        samples[1].column_names.index("gain"), "gain", pc.multiply(samples[1]["gain"], 0.5).cast(pa.float32())
    )
    tables = [samples[0], better_one]
    sums = [sums_by_episode(table)["planning_gain"] for table in tables]
    (wanted,) = (one for one in differences(*([table] for table in tables)) if one.figure == "planning_gain")
    found = difference_by_episode(sums[:1], sums[1:])

    assert found is not None
    assert found.mean == pytest.approx(wanted.difference.mean)
    assert (found.low, found.high) == pytest.approx((wanted.difference.low, wanted.difference.high))


def test_seeds_are_averaged_before_they_are_compared() -> None:
    episodes = {"episode": [3, 5, 9], "n": [2, 4, 1]}
    seeds = [{**episodes, "sum": [2.0, 8.0, 1.0]}, {**episodes, "sum": [4.0, 0.0, 3.0]}]
    one = [{**episodes, "sum": [1.0, 2.0, 1.0]}]

    found = difference_by_episode(seeds, one)

    assert found is not None
    assert found.mean == pytest.approx((3 - 1 + 4 - 2 + 2 - 1) / 7)
    assert difference_by_episode(seeds, [{**one[0], "n": [2, 4, 2]}]) is None
    assert difference_by_episode([], one) is None


def test_several_trainings_are_compared_by_their_mean(scored_workspace: Workspace) -> None:
    both, one = [scored_workspace.runs / S0, scored_workspace.runs / S1], scored_workspace.runs / CSWM
    found = {one.figure: one for one in compare_runs(both, one)}
    each = [{one.figure: one for one in compare_runs(run, one)} for run in both]
    tables = [pq.read_table(run / "report/samples.parquet") for run in (*both, one)]
    sums = [sums_by_episode(table) for table in tables]

    assert found.keys() == each[0].keys()
    for figure in ("mse", "mse_push", "psnr", "rollout_mse[2]"):
        assert found[figure].first == pytest.approx(np.mean([own[figure].first for own in each]))
        assert found[figure].difference.mean == pytest.approx(np.mean([own[figure].difference.mean for own in each]))
    by_episode = difference_by_episode([own["mse"] for own in sums[:2]], [sums[2]["mse"]])
    mse = found["mse"].difference
    assert by_episode is not None
    assert (mse.low, mse.high) == pytest.approx((by_episode.low, by_episode.high))
    assert compare_runs([both[0]], [one]) == compare_runs(both[0], one)


def test_only_trainings_that_differ_in_their_seed_have_a_mean(scored_workspace: Workspace) -> None:
    first, second, other = (scored_workspace.runs / name for name in (S0, S1, CSWM))
    with pytest.raises(RunMismatch, match=r"no trainings of one model: they differ in model, labels\."):
        compare_runs([first, other], second)
    with pytest.raises(RunMismatch, match="several of the trainings have the seed 1"):
        compare_runs(first, [second, second])


def test_a_metric_that_one_training_lacks_is_left_out(workspace: Workspace) -> None:
    first, other = (_with_control(workspace, name, PLANNED, GainScoring()) for name in (S0, CSWM))
    told = list[str]()
    found = compare_runs([first, workspace.runs / S1], other, warn=told.append)

    assert {one.figure for one in compare_runs(first, other)} > {one.figure for one in found} > {"mse"}
    assert told == [
        f"'{S1}' has no figures of {metric}, as others have; score it for them, too." for metric in ("gain", "control")
    ]


def test_runs_that_saw_other_frames_are_not_compared(workspace: Workspace) -> None:
    report = workspace.runs / S1 / "report/report.json"
    content = json.loads(report.read_text())
    report.write_text(json.dumps(content | {"dataset": content["dataset"] | {"fingerprint": "0" * 64}}))

    with pytest.raises(RunMismatch, match=r"different data sets: 'grid_world-tiny' \(\w{12}\) and .* \(0{12}\)\."):
        compare_runs(workspace.runs / S0, workspace.runs / S1)


PLANNED = ControlScoring(tasks=3, steps=2)


def _with_control(workspace: Workspace, run: str, scoring: ControlScoring, gain: GainScoring) -> Path:
    """Give a run's report made-up samples of control and of the gain captured."""
    folder = workspace.runs / run / "report"
    report = read_report(folder)
    assert report is not None
    samples = read_report_samples(folder, report)
    assert samples is not None
    tasks, moments = np.arange(6), np.array([0, 1, 2])
    controlled, gained = SampleRows("control", "model"), SampleRows("gain", "model")
    rows = {"task": np.repeat(tasks, 3), "episode": np.repeat(tasks, 3), "ahead": np.tile(moments, 6)}
    distance = 1 - 0.1 * rows["ahead"] * (1 + rows["task"])
    controlled.add(rows | {"step": np.zeros(18), "control_distance": distance, "control_lost": np.zeros(18)})
    moment = {"episode": tasks, "step": np.zeros(6), "ahead": np.full(6, gain.horizon)}
    gained.add(moment | {"gain": 0.1 * tasks, "best_gain": np.ones(6)})
    settings = {**report.settings, **scoring.to_json(), **gain.to_json()}
    write_report(
        folder, replace(report, settings=settings), pa.concat_tables([samples, controlled.table(), gained.table()])
    )
    return workspace.runs / run


def test_figures_that_were_measured_with_other_settings_are_left_out(workspace: Workspace) -> None:
    first = _with_control(workspace, S0, PLANNED, GainScoring())
    told = list[str]()

    def compared(scoring: ControlScoring, gain: GainScoring) -> set[str]:
        told.clear()
        shutil.copytree(workspace.runs / S1, workspace.runs / "other", dirs_exist_ok=True)
        second = _with_control(workspace, "other", scoring, gain)
        return {one.figure for one in compare_runs(first, second, warn=told.append)}

    everything = compared(replace(PLANNED, tasks=2), GainScoring(moments=50))  # of them the same ones are paired
    assert {"mse", "control_distance[2]", "planning_gain"} <= everything
    assert told == []
    for scoring, said in (
        (replace(PLANNED, planner="icem"), "control_planner is 'cem' of the first and 'icem' of the second"),
        (replace(PLANNED, objective="pixel"), "control_objective is None of the first and 'pixel' of the second"),
        (replace(PLANNED, seed=1), "control_seed is 0 of the first and 1 of the second"),
    ):
        uncontrolled = {name for name in everything if not name.startswith("control")}
        assert compared(scoring, GainScoring()) == uncontrolled
        assert len(told) == 1
        assert said in told[0]
    assert compared(PLANNED, GainScoring(objective="pixel")) == everything - {"planning_gain"}
    assert "gain_objective is None of the first and 'pixel' of the second" in told[0]


def test_it_is_said_that_a_run_was_scored_on_more_tasks_than_the_other(workspace: Workspace) -> None:
    first, second = (_with_control(workspace, name, PLANNED, GainScoring()) for name in (S0, S1))
    report = read_report(second / "report")
    assert report is not None
    samples = read_report_samples(second / "report", report)
    assert samples is not None
    fewer = samples.filter(pc.fill_null(pc.less(samples["task"], 4), True))
    write_report(second / "report", report, fewer)
    told = list[str]()
    found = {one.figure: one for one in compare_runs(first, second, warn=told.append)}

    assert found["control_distance[2]"].difference.n == 4
    assert [sentence.partition(";")[0] for sentence in told] == [f"'{S0}' has more samples of control than '{S1}'"]
    told.clear()
    assert compare_runs(first, first, warn=told.append)
    assert told == []


def test_predictions_of_another_precision_or_version_are_not_compared(workspace: Workspace) -> None:
    path = workspace.runs / S1 / "report/report.json"
    report = json.loads(path.read_text())
    path.write_text(json.dumps(report | {"settings": report["settings"] | {"precision": "bf16"}}))
    with pytest.raises(RunMismatch, match=r"prediction and rollout .*: precision is 'float32' of the first and 'bf16'"):
        compare_runs(workspace.runs / S0, workspace.runs / S1)
    path.write_text(json.dumps(report | {"scoring_version": 0}))
    with pytest.raises(RunMismatch, match=r"prediction and rollout .*: scoring_version is 1 of the first and 0"):
        compare_runs(workspace.runs / S0, workspace.runs / S1)


def test_the_report_of_an_earlier_training_is_not_compared(workspace: Workspace) -> None:
    path = workspace.runs / S1 / "run.json"
    run = json.loads(path.read_text())
    path.write_text(json.dumps(run | {"result": run["result"] | {"weights": "0" * 64}}))
    with pytest.raises(RunMissing, match=f"{S1}' is of an earlier training; score the run with 'dmbench score "):
        compare_runs(workspace.runs / S0, workspace.runs / S1)


def test_a_run_without_a_whole_report_is_not_compared(workspace: Workspace) -> None:
    with (workspace.runs / S1 / "report/samples.parquet").open("ab") as file:
        file.write(b"more")

    with pytest.raises(RunMissing, match="dmbench score"):
        compare_runs(workspace.runs / S0, workspace.runs / S1)


def test_behind_the_best_is_the_paired_difference_of_the_error(scored_workspace: Workspace) -> None:
    (_, best), (_, other) = (scored(scored_workspace.runs / name) for name in (S0, CSWM))
    (expected,) = (
        one for one in compare_runs(scored_workspace.runs / CSWM, scored_workspace.runs / S0) if one.figure == "mse"
    )

    assert behind(other, best) == expected.difference
    assert standing(expected.difference) == "behind"
    itself = behind(best, best)
    assert itself is not None
    assert standing(itself) == "tie"
    assert standing(replace(itself, low=None, high=None)) == "unknown"
    assert behind(other.slice(0, 0), best) is None


def test_the_table_of_many_runs_says_how_far_each_is_behind(
    scored_workspace: Workspace, capsys: pytest.CaptureFixture[str]
) -> None:
    paths = [scored_workspace.runs / name for name in (CSWM, S0, S1)]
    show_overview({path: report for path in paths if (report := read_report(path / "report"))})
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}
    differences = {
        one.figure: one.difference for one in compare_runs(scored_workspace.runs / CSWM, scored_workspace.runs / S1)
    }

    assert " best " in lines[S1]
    assert f" +{differences['mse'].mean:,.0f} ({differences['mse'].low:,.0f} to " in lines[CSWM]


def test_what_was_scored_on_one_episode_alone_is_not_called_a_tie(
    scored_workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def first_episode(folder: Path, report: Report) -> pa.Table:
        samples = read_report_samples(folder, report)
        assert samples is not None
        return samples.filter(pc.equal(samples["episode"], pc.min(samples["episode"])))

    monkeypatch.setattr("dmotion_bench.api.scoring.read_report_samples", first_episode)
    paths = [scored_workspace.runs / name for name in (CSWM, S1)]
    show_overview({path: report for path in paths if (report := read_report(path / "report"))})
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}

    assert " unknown: one episode " in lines[CSWM]


def test_on_a_narrow_terminal_the_names_of_the_runs_stay_whole(
    scored_workspace: Workspace, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("TTY_COMPATIBLE", "1")
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("NO_COLOR", "1")
    report = read_report(scored_workspace.runs / S1 / "report")
    assert report is not None

    show_overview({scored_workspace.runs / S1: report})

    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert max(map(len, printed.splitlines())) <= 80
    figures = {line.split()[0] for line in printed.splitlines() if re.search(r"\d ± \d", line)}
    assert figures == {S1, "agent", "copy", "dmotion"}  # "agent moves", "copy last"
    assert printed.count("miss rate") == 1  # in a part further down


def test_a_run_whose_samples_are_gone_is_not_compared(workspace: Workspace, capsys: pytest.CaptureFixture[str]) -> None:
    (workspace.runs / CSWM / "report/samples.parquet").unlink()
    paths = [workspace.runs / name for name in (CSWM, S0, S1)]
    show_overview({path: report for path in paths if (report := read_report(path / "report"))})
    lines = {line.split()[0]: line for line in capsys.readouterr().out.splitlines() if line.strip()}

    assert " best " in lines[S1]
    assert "(" not in lines[CSWM].partition("10%")[2].replace("(4)", "")


def test_the_interval_of_a_share_that_is_all_alike_may_be_that_of_the_first_entries() -> None:
    samples = pa.table(
        {
            "predictor": ["model"] * 20,
            "metric": ["control"] * 20,
            "episode": np.arange(20),
            "ahead": np.ones(20, np.int64),
            "control_distance": np.linspace(0.3, 0.9, 20),
            "control_lost": np.zeros(20),
            **{name: np.full(20, np.nan) for name in ROLLOUT_COLUMNS},
        }
    )
    now = figures_by_samples(samples, "model", {}, 100)["control_success"]
    assert (now["mean"], now["low"]) == (0, 0)
    assert now["high"] == pytest.approx(wilson(0, 20)[1])
    for high, found in ((0, 0), (0.01, now["high"])):
        said = {"control_success": now | {"high": high}, "control_distance[1]": {"low": 0.6, "high": 0.6}}
        figures = figures_by_samples(samples, "model", said, 100)
        assert figures["control_success"]["high"] == found
        assert figures["control_distance[1]"]["low"] < figures["control_distance[1]"]["high"]


def test_control_is_paired_by_task() -> None:
    """Two models on the same tasks, of which one was given them in another order."""
    tasks, moments = np.arange(20), 4
    generator = np.random.default_rng(0)
    first = 1 - 0.2 * np.arange(moments) + generator.normal(0, 0.3, (20, 1)) * np.array([0, 1, 1, 1])

    def table(distance: np.ndarray, order: np.ndarray) -> pa.Table:
        return pa.table(
            {
                "metric": ["control"] * (20 * moments),
                "episode": np.repeat(tasks[order] // 2, moments),
                "step": np.repeat(tasks[order], moments),
                "ahead": np.tile(np.arange(moments), 20),
                "task": np.repeat(tasks[order], moments),
                "pushed": pa.nulls(20 * moments, pa.bool_()),
                "control_distance": distance[order].reshape(-1),
                "control_lost": np.zeros(20 * moments),
            }
        )

    second = first + np.array([0, 0.05, 0.05, 0.0])
    found = {one.figure: one for one in differences([table(first, tasks)], [table(second, tasks[::-1])])}

    distances = {f"control_distance[{step}]" for step in (1, 2, 3)}
    assert set(found) == {*distances, "control_success", "control_lost"}
    assert found["control_success"].first == np.mean(first[:, 3] <= 0.2)
    assert found["control_distance[2]"].difference.mean == pytest.approx(-0.05)  # of 0.3 between tasks nothing is left
    assert found["control_distance[2]"].difference.std == pytest.approx(0, abs=1e-9)
    assert found["control_distance[2]"].better == "first"
    assert found["control_distance[3]"].better is None
    assert found["control_distance[2]"].difference.n == 20

    sums = sums_by_episode(table(first, tasks).append_column("predictor", pa.array(["model"] * (20 * moments))))
    assert list(sums) == ["control_distance[3]"]
    assert sums["control_distance[3]"]["episode"] == list(range(10))
    assert sums["control_distance[3]"]["n"] == [2] * 10
    np.testing.assert_allclose(sums["control_distance[3]"]["sum"], first[:, 3].reshape(10, 2).sum(1))
