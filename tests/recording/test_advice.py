"""What is told of a recording from which a model learns little."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import pytest
import strange_worlds
from dmbench_command import Outcome, dmbench
from strange_worlds import SLIDER, SMALL

Run = Callable[..., Outcome]
strange_worlds.register()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(("record", *words), capsys, monkeypatch)


def test_a_single_action_is_told_of(run: Run) -> None:
    words = ("gym:Strange/Choiceless-v0", *SMALL)
    outcome = run(*words)
    assert outcome.code == 0
    assert "  the environment has a single action, '0': no model can learn what an action does" in outcome.out
    (told,) = json.loads(run(*words, "--json").out)["advice"]
    assert told.startswith("the environment has a single action")


def test_episodes_of_two_frames_are_told_of(run: Run, tmp_path: Path) -> None:
    outcome = run(SLIDER, *SMALL, "--set", "max_episode_steps=1")
    assert outcome.code == 0
    assert (
        "  no episode has more than 2 frames, and models learn from 3 in a row: nothing can be trained" in outcome.out
    )
    assert "train on it with" not in outcome.out
    words = (SLIDER, *SMALL, "--set", "max_episode_steps=2", "--out", str(tmp_path / "longer"))
    longer = run(*words)
    assert "no episode" not in longer.out
    assert "train on it with" in longer.out
    assert "advice" not in json.loads(run(*words, "--json").out)
