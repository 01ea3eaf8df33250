"""``dmbench train --all``: every row, again for nothing, and a failing one that does not stop the others."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
from dmbench_command import Outcome, dmbench
from walking_square import record_walks

from dmotion_bench.learning import table
from dmotion_bench.specs import Supervision

Command = Callable[..., Outcome]


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    record_walks(tmp_path / "data" / "walk-tiny")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(words, capsys, monkeypatch)


def test_all_rows_are_trained_once(run: Command, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnn", "lapo"])
    monkeypatch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot", "2-shot"))
    outcome = run("train", "--all", "--json")
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
    assert json.loads(run("train", "--all", "--json").out)["rows"] == rows


def test_a_failing_row_is_said_and_the_rest_trained(run: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(table, "model_names", lambda: ["ed-cnm", "lapo"])
    monkeypatch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot",))
    outcome = run("train", "--all")
    assert outcome.code == 1
    assert "1 of 2 trainings failed: ed-cnm" in outcome.sentence()
    failed, trained = outcome.out.splitlines()[:2]
    assert "no model named 'ed-cnm'; did you mean 'ed-cnn'?" in failed
    assert trained.startswith("lapo ")
    assert "4 labels" in trained


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("dmotion", "--all"), "leave out MODEL"),
        (("--all", "--labels", "10%", "--set", "epochs=1"), "leave out --labels and --set"),
        ((), "no model is named"),
    ],
)
def test_wrong_words_cost_a_sentence(run: Command, words: tuple[str, ...], says: str) -> None:
    outcome = run("train", *words)
    assert outcome.code == 2
    assert says in outcome.sentence()
