"""With how many threads a training that is not told computes, and how two ways are compared."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from walking_square import record_walks

from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.hardware.timing import FEWEST_ROUNDS, MOST_ROUNDS, clearly_faster, timed_in_turn
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

CPU = torch.device("cpu")
BUSY = {1: 0.2, 2: 2.0}
QUIET = {1: 0.2, 2: 0.11}
"""Seconds of a step by the number of threads."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


@pytest.fixture(autouse=True)
def two_threads(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Torch has two threads, and every training is long enough to be measured."""
    monkeypatch.setattr("dmotion_bench.learning.hardware.threads.FEWEST_STEPS", 1)
    monkeypatch.delenv("OMP_NUM_THREADS", raising=False)
    before = torch.get_num_threads()
    torch.set_num_threads(2)
    yield
    torch.set_num_threads(before)


class Stopped(Exception):
    """Raised after a training's first step."""


def _begun(
    data: Path, folder: Path, seconds: Mapping[int, float], monkeypatch: pytest.MonkeyPatch, **request: Any
) -> tuple[Run, int]:
    """A run on a machine where steps take so long, stopped after its first step; and the threads of that step."""
    used: list[int] = []

    def in_turn(ways: Mapping[str, Callable[[], object]], *_: object) -> dict[str, tuple[float, ...]]:
        found = {}
        for name, way in ways.items():
            way()
            found[name] = (seconds[used[-1]],) * 3
        return found

    def stop(_: StepReport) -> None:
        used.append(torch.get_num_threads())
        raise Stopped

    monkeypatch.setattr("dmotion_bench.learning.training.conditions.timed_in_turn", in_turn)
    monkeypatch.setattr(
        "dmotion_bench.learning.training.conditions._trial", lambda *_: lambda _: used.append(torch.get_num_threads())
    )
    asked = TrainingRequest(model="dmotion", settings=("batch_size=4", "epochs=0.1"), **request)
    run = open_run(asked, Dataset.open(data), folder, Workspace(folder))
    with pytest.raises(Stopped):
        train(run, training_data(run, Dataset.open(data)), launch("cpu"), stop)
    assert torch.get_num_threads() == 2, "as before the training"
    return Run.open(run.path), used[-1]


@pytest.mark.slow
def test_a_busy_machine_is_said_once_and_computed_on_with_one_thread(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING, "dmotion_bench"):
        run, used = _begun(recorded, tmp_path / "run", BUSY, monkeypatch)
        again, used_again = _begun(recorded, tmp_path / "run", QUIET, monkeypatch)
    assert [record.getMessage() for record in caplog.records] == [
        "this machine is busy: a step takes 2 s with 2 threads and 0.2 s with one, so the training computes with one; "
        "'--threads' chooses another number."
    ]
    assert run.conditions is not None
    assert (run.conditions.threads, dict(run.conditions.threads_probe)) == (1, {"2": 2.0, "1": 0.2})
    assert run.conditions == again.conditions
    assert used == used_again == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seconds", "variable", "asked", "probe"),
    [
        (QUIET, None, {}, {"2": 0.11, "1": 0.2}),
        (BUSY, "2", {}, {}),
        (BUSY, None, {"threads": 2}, {}),
    ],
)
def test_all_threads_compute_on_a_quiet_machine_and_where_somebody_chose_their_number(
    recorded: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    seconds: Mapping[int, float],
    variable: str | None,
    asked: Mapping[str, int],
    probe: Mapping[str, float],
) -> None:
    if variable is not None:
        monkeypatch.setenv("OMP_NUM_THREADS", variable)
    with caplog.at_level(logging.WARNING, "dmotion_bench"):
        run, used = _begun(recorded, tmp_path / "run", seconds, monkeypatch, **asked)
    assert run.conditions is not None
    assert (run.conditions.threads, used, dict(run.conditions.threads_probe)) == (2, 2, probe)
    assert not caplog.records


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


@pytest.mark.parametrize(("other", "rounds"), [(0.3, FEWEST_ROUNDS), (0.11, MOST_ROUNDS)])
def test_few_rounds_are_enough_where_one_way_is_far_ahead(
    other: float, rounds: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.learning.hardware.timing._seconds", lambda way, _: way())
    seconds = timed_in_turn({"usual": lambda: 0.1, "other": lambda: other}, CPU)
    assert seconds == {"usual": (0.1,) * rounds, "other": (other,) * rounds}
