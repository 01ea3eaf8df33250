"""``dmbench train --all``: every row, again for nothing, and a failing one that does not stop the others."""

from __future__ import annotations

import json
import shutil
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import Outcome, dmbench, ended_by_ctrl_c, interrupted_once, start_dmbench
from walking_square import record_walks

from dmotion_bench.api import side_by_side, training
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import training_data
from dmotion_bench.learning.training import table
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.lock import held

Command = Callable[..., Outcome]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    record_walks(tmp_path / "data" / "walk-tiny")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(words, capsys, monkeypatch)


@pytest.mark.slow
def test_all_rows_are_trained_once(run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnn", "lapo"])
    monkeypatch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot", "2-shot"))
    outcome = run("train", "--all", "--workers", "1", "--json")
    assert (outcome.code, outcome.err) == (0, "")
    rows = json.loads(outcome.out)["rows"]
    assert [(row["model"], row["budget"], row["error"]) for row in rows] == [
        ("ed-cnn", "100%", None),
        ("ed-cnn", "10%", None),
        ("lapo", "one-shot", None),
        ("lapo", "2-shot", None),
    ]
    assert rows[0]["labels"] > rows[1]["labels"]
    assert [row["labels"] for row in rows[2:]] == [4, 8]
    assert {path.name for path in (tmp_path / "runs").iterdir()} == {Path(row["run"]).name for row in rows}
    assert json.loads(run("train", "--all", "--workers", "1", "--json").out)["rows"] == rows


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_several_seeds_are_the_trainings_of_each(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, workers: str
) -> None:
    asked = ("--labels", "2-shot", "--set", "warp=true", "--json")
    alone = json.loads(
        run("train", "dmotion", *asked, "--seed", "4", "--threads", "1", "--out", str(tmp_path / "alone")).out
    )
    outcome = run("train", "dmotion", *asked, "--seeds", "0,4", "--workers", workers)
    assert outcome.code == 0
    rows = json.loads(outcome.out)["rows"]
    runs = [Run.open(row["run"]) for row in rows]
    assert [(row["model"], row["budget"], row["seed"], row["labels"]) for row in rows] == [
        ("dmotion", "2-shot", 0, 8),
        ("dmotion", "2-shot", 4, 8),
    ]
    assert [own.path.name for own in runs] == [f"dmotion-walk-tiny-2-shot-warp_true-s{seed}" for seed in (0, 4)]
    alike = [own.result["weights"] for own in (Run.open(alone["run"]), runs[1]) if own.result is not None]
    assert alike[0] == alike[1]


@pytest.mark.slow
def test_all_models_are_trained_with_several_seeds(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnn", "ed-cnm"])
    monkeypatch.setitem(table.BUDGETS, Supervision.ACTIONS, ("100%",))
    outcome = run("train", "--all", "--seeds", "1,2", "--workers", "1")
    assert outcome.code == 1
    assert "2 of 4 trainings failed: ed-cnm s1, ed-cnm s2; run the same command" in outcome.sentence()
    trained = [line.split()[:3] for line in outcome.out.splitlines()[:2]]
    assert trained == [["ed-cnn", "s1", "100%"], ["ed-cnn", "s2", "100%"]]


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (("dmotion", "--seeds", "0,x"), "--seeds holds 'x'; give whole numbers, such as 0,1,2."),
        (("dmotion", "--seeds", ""), "--seeds holds nothing; give whole numbers, such as 0,1,2."),
        (("dmotion", "--seeds", "0,1,01"), "--seeds names 1 twice; name each number once."),
        (("--all", "--seeds", "3,3"), "--seeds names 3 twice; name each number once."),
        (("dmotion", "--seeds", "0,1", "--labels", "5000"), "more labelled transitions than the data set has, "),
        (("dmotion", "--seeds", "1", "--seed", "2"), "--seeds makes several runs; leave out --seed."),
        (("dmotion", "--seeds", "1", "--out", "a", "--devices", "2"), "leave out --out and --devices."),
        (("--all", "--seeds", "1", "--set", "epochs=1"), "--all chooses these for every model; leave out --set."),
        (("--seeds", "1"), "no model is named"),
        (("ed-cnn", "--seeds", "1"), "give it a share of them"),
        (("dmotion", "--workers", "2"), "give --all or --seeds to train several."),
    ],
)
def test_what_several_seeds_cannot_share_is_refused(run: Command, words: tuple[str, ...], told: str) -> None:
    outcome = run("train", *words)
    assert outcome.code == 2
    assert told in outcome.sentence()


@pytest.mark.slow
def test_a_failing_row_is_said_and_the_rest_trained(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnm", "lapo"])
    monkeypatch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot",))
    outcome = run("train", "--all", "--workers", "1")
    assert outcome.code == 1
    assert "1 of 2 trainings failed: ed-cnm" in outcome.sentence()
    failed, trained = outcome.out.splitlines()[:2]
    assert "no model named 'ed-cnm'; did you mean 'ed-cnn'?" in failed
    assert trained.startswith("lapo ")
    assert "4 labels" in trained


@pytest.mark.slow
def test_a_run_that_another_process_trains_is_no_failure_of_its_model(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnn", "lapo"])
    monkeypatch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot",))
    monkeypatch.setitem(table.BUDGETS, Supervision.ACTIONS, ("100%",))
    (busy := tmp_path / "runs" / "lapo-walk-tiny-s0").mkdir(parents=True)
    with held(busy):
        outcome = run("train", "--all", "--workers", "1")
    assert outcome.code == 1
    assert "another process is at 1 of 2 trainings: lapo; run the same command later" in outcome.sentence()
    assert outcome.out.splitlines()[1].split(maxsplit=2) == ["lapo", "one-shot", "being trained by another process."]


@pytest.mark.slow
def test_models_trained_beside_each_other_are_those_trained_in_turn(
    run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnm", "ed-cnn", "lapo"])
    monkeypatch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot", "2-shot"))
    weights = {}
    for workers in ("1", "2"):
        with using_threads(2):  # which one process computes with, and many beside each other do not
            outcome = run("train", "--all", "--workers", workers, "--json")
        assert outcome.code == 1
        rows = json.loads(outcome.out)["rows"]
        assert [(row["model"], row["budget"]) for row in rows] == [
            *(("ed-cnm", ""), ("ed-cnn", "100%"), ("ed-cnn", "10%"), ("lapo", "one-shot"), ("lapo", "2-shot"))
        ]
        assert "did you mean 'ed-cnn'?" in rows[0]["error"]
        runs = [Run.open(row["run"]) for row in rows[1:]]
        weights[workers] = [own.result["weights"] for own in runs if own.result is not None]
        assert {own.conditions.threads for own in runs if own.conditions is not None} == {1}
        assert not list(tmp_path.glob(".jobs-*"))
        shutil.move(tmp_path / "runs", tmp_path / f"by-{workers}")
    assert len(weights["1"]) == 4
    assert weights["1"] == weights["2"]
    told = {}
    for workers in ("1", "2"):
        shutil.copytree(tmp_path / "by-1", tmp_path / "runs")
        outcome = run("score", "--all", "--workers", workers, "--json")
        assert outcome.code == 0, outcome.err
        told[workers] = json.loads(outcome.out)["reports"]
        assert len(told[workers]) == 4
        assert not list(tmp_path.glob(".jobs-*"))
        samples = sorted((tmp_path / "runs").glob("*/report/samples.parquet"))
        told[f"samples {workers}"] = [path.read_bytes() for path in samples]
        shutil.rmtree(tmp_path / "runs")
    assert told["1"] == told["2"]
    assert told["samples 1"] == told["samples 2"]


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
def test_every_training_is_told_how_many_threads_read(
    workers: str, run: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    told: list[int | None] = []

    def data(*given: Any, **named: Any) -> Any:
        told.append((*given, *named.values())[2])
        return training_data(*given, **named)

    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnn"])
    monkeypatch.setattr(table, "training_data", data)
    monkeypatch.setattr(training, "training_data", data)
    monkeypatch.setattr(side_by_side, "make_executor", lambda *_, **__: SerialExecutor())
    monkeypatch.setattr(side_by_side.Hands, "at_once", lambda hands, jobs: int(workers))
    assert run("train", "--all", "--stream", "--loaders", "3").code == 0
    assert told == [3, 3]


@pytest.mark.slow
def test_ctrl_c_ends_all_jobs_and_says_how_to_go_on(tmp_path: Path) -> None:
    record_walks(tmp_path / "data" / "walk-tiny")
    process = start_dmbench(("train", "--all", "--workers", "2"), tmp_path)
    workers = interrupted_once(process, lambda: len(list(tmp_path.glob("runs/*/run.json"))) >= 2, signal.SIGINT)
    ended_by_ctrl_c(process, workers, tmp_path)


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("dmotion", "--all"), "leave out MODEL"),
        (("--all", "--labels", "10%", "--set", "epochs=1"), "leave out --labels and --set"),
        ((), "no model is named"),
        (("lapo", "--workers", "2"), "--workers shares many runs among workers; give --all"),
    ],
)
def test_wrong_words_cost_a_sentence(run: Command, words: tuple[str, ...], says: str) -> None:
    outcome = run("train", *words)
    assert outcome.code == 2
    assert says in outcome.sentence()
