"""With how many threads a training that is not told computes, and how two ways are compared."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from walking_square import record_walks

from dmotion_bench.learning.devices import launch
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.timing import FEWEST_ROUNDS, clearly_faster, timed_in_turn
from dmotion_bench.learning.training import train
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

CPU = torch.device("cpu")
SETTINGS = ("batch_size=16", "epochs=0.05", "validations=1")
BUSY = {1: 0.2, 2: 2.0}
QUIET = {1: 0.2, 2: 0.11}
"""Seconds of a step by the number of threads."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Torch has two threads, and every training is long enough to be measured."""
    monkeypatch.setattr("dmotion_bench.learning.threads.FEWEST_STEPS", 1)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


def _trained(
    data: Path, folder: Path, seconds: Mapping[int, float], monkeypatch: pytest.MonkeyPatch, **request: Any
) -> Run:
    """A run on a machine where steps take so long."""

    def in_turn(ways: Mapping[str, Callable[[], object]], _: torch.device) -> dict[str, tuple[float, ...]]:
        found = {}
        for name, way in ways.items():
            used: list[int] = []
            with monkeypatch.context() as patched:
                patched.setattr("torch.set_num_threads", used.append)
                way()
            found[name] = (seconds[used[0]],) * 3
        return found

    monkeypatch.setattr("dmotion_bench.learning.conditions.timed_in_turn", in_turn)
    asked = TrainingRequest(model="dmotion", settings=SETTINGS, **request)
    run = open_run(asked, Dataset.open(data), folder, Workspace(folder))
    train(run, training_data(run, Dataset.open(data)), launch("cpu"), lambda _: None)
    return run


def test_a_busy_machine_is_said_once_and_computed_on_with_one_thread(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "dmotion_bench"):
        run = _trained(recorded, tmp_path / "busy", BUSY, monkeypatch)
    assert [record.getMessage() for record in caplog.records if "busy" in record.getMessage()] == [
        "this machine is busy: a step takes 2 s with 2 threads and 0.2 s with one, so the training computes with one; "
        "'--threads' chooses another number."
    ]
    kept = Run.open(run.path)
    assert kept.conditions is not None
    assert (kept.conditions.threads, dict(kept.conditions.threads_probe)) == (1, {"2": 2.0, "1": 0.2})
    assert torch.get_num_threads() == 2  # as before the training

    alone = _trained(recorded, tmp_path / "asked", BUSY, monkeypatch, threads=1)
    assert alone.conditions is not None
    assert dict(alone.conditions.threads_probe) == {}
    assert alone.result is not None
    assert kept.result is not None
    assert kept.result["weights"] == alone.result["weights"]


def test_a_quiet_machine_computes_with_all_threads(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "dmotion_bench"):
        run = _trained(recorded, tmp_path / "quiet", QUIET, monkeypatch)
    assert run.conditions is not None
    assert run.conditions.threads == 2
    assert not caplog.records


def test_a_number_of_threads_that_somebody_set_is_not_measured(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("OMP_NUM_THREADS", "2")
    run = _trained(recorded, tmp_path / "set", BUSY, monkeypatch)
    assert run.conditions is not None
    assert (run.conditions.threads, dict(run.conditions.threads_probe)) == (2, {})


def test_ways_take_turns_and_the_first_of_each_does_not_count() -> None:
    called: list[str] = []
    seconds = timed_in_turn({name: lambda name=name: called.append(name) for name in "ab"}, CPU)  # type: ignore[misc]
    assert called == ["a", "b"] * (len(called) // 2)
    assert len(seconds["a"]) == len(seconds["b"]) == len(called) // 2 - 1 >= FEWEST_ROUNDS


@pytest.mark.parametrize(
    ("other", "wins"),
    [
        ((0.8, 0.8, 0.8, 0.8), True),
        ((0.97, 0.97, 0.97, 0.97), False),  # within the margin
        ((0.5, 0.5, 1.2, 1.2), False),  # as often slower
        ((0.5, 0.5, 0.5, 9.0), True),
    ],
)
def test_another_way_must_win_clearly_and_often(other: tuple[float, ...], wins: bool) -> None:
    assert clearly_faster(other, (1.0,) * 4) is wins
