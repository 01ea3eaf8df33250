"""A run is scored with as many threads as it was trained with, whatever the machine would take by itself."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import pytest
import torch
from known_model import Known
from torch import Tensor

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.hardware.threads import scoring_shortage, shortage
from dmotion_bench.learning.runs.run import Conditions, Run
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples

MakeRun = Callable[..., Run]
QUICK = ScoreSettings(horizon=3, resamples=100)
SEEN: list[int] = []


class Counting(Known):
    """Notes the number of threads that it predicts with."""

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        SEEN.append(torch.get_num_threads())
        return super().predict(previous, current, action)


@pytest.fixture
def trained(make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[int], Run]:
    """Runs that were trained with so many threads."""

    def make(threads: int) -> Run:
        run = make_run(tmp_path / f"run-{threads}")
        run.begin(Conditions(threads=threads, precision="float32"))
        run.finish({**(run.result or {}), "threads": threads, "precision": "float32"})
        monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Counting)
        SEEN.clear()
        return run

    return make


@pytest.mark.slow
@pytest.mark.parametrize("threads", [2, 3])
def test_scoring_takes_the_number_of_the_training(trained: Callable[[int], Run], threads: int) -> None:
    before = torch.get_num_threads()
    report = score_run(trained(threads).path, settings=QUICK)
    assert set(SEEN) == {threads}
    assert torch.get_num_threads() == before != threads
    assert (report.training["threads"], report.training["precision"]) == (threads, "float32")


@pytest.mark.slow
def test_the_references_of_another_number_are_scored_again(
    trained: Callable[[int], Run], monkeypatch: pytest.MonkeyPatch
) -> None:
    shared, asked = SharedSamples(), []
    get = shared.get

    def noted(key: Mapping[str, object], *rest: Any) -> object:
        asked.append(json.dumps(key, sort_keys=True))
        return get(key, *rest)

    monkeypatch.setattr(shared, "get", noted)
    for threads in (2, 3, 2):
        score_run(trained(threads).path, settings=QUICK, shared=shared)
    assert len(asked) == 6
    assert len(set(asked)) == 4


@pytest.mark.slow
def test_a_number_that_is_not_allowed_is_said(trained: Callable[[int], Run], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("OMP_THREAD_LIMIT", "2")
    score_run(trained(2).path, settings=QUICK)
    with pytest.raises(UsageError, match="computes with 3 threads, and OMP_THREAD_LIMIT allows 2; unset that variable"):
        score_run(trained(3).path, settings=QUICK)


@pytest.mark.slow
def test_older_runs_that_name_no_number_take_what_there_is(make_run: MakeRun, tmp_path: Path) -> None:
    report = score_run(make_run(tmp_path / "run").path, settings=QUICK)
    assert "threads" not in report.training


def test_fewer_cores_are_said() -> None:
    assert scoring_shortage(2, 2) is None
    told = scoring_shortage(4, 2)
    assert told is not None
    assert "4 threads, and 2 cores are free here. It is scored with 4, which gives the same figures" in told


def test_fewer_cores_are_said_of_a_training() -> None:
    assert shortage(2, 4, processes=2) is None
    assert shortage(2, 1) == (
        "this run computes with 2 threads, and 1 core is free here. It goes on so, which gives the same weights and "
        "takes several times as long; '--threads 1 --out DIR' begins another run."
    )
    assert shortage(1, 1, processes=2) == (
        "this run computes with 2 processes of 1 thread each, and 1 core is free here. It goes on so, which gives the "
        "same weights and takes several times as long."
    )
