"""Speeds on a device: the code of a GPU, tried on the CPU, and on a GPU where there is one."""

from __future__ import annotations

import json
from typing import Any

import pytest
import torch
from dmbench_command import dmbench

from dmotion_bench.benchmarks import device_speeds
from dmotion_bench.benchmarks.device_speeds import device_works, matrix_products_on
from dmotion_bench.benchmarks.speeds import measure
from dmotion_bench.benchmarks.training_step import TrainingStep

CPU = torch.device("cpu")
NO_GPU = pytest.mark.skipif(not torch.cuda.is_available(), reason="there is no CUDA device here")
DEVICES = [CPU, pytest.param(torch.device("cuda"), marks=[pytest.mark.gpu, NO_GPU])]


@pytest.mark.slow
@pytest.mark.parametrize("device", DEVICES, ids=str)
def test_training_loading_and_planning_are_measured_on_the_device(
    device: torch.device, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(device_speeds, "_EPISODES", 3)
    monkeypatch.setattr(device_speeds, "_TASKS", 1)
    waited: list[torch.device] = []
    wait = device_speeds.wait_for
    monkeypatch.setattr(device_speeds, "wait_for", lambda where: waited.append(where) or wait(where))
    works = device_works({"cswm": ("compact",)}, 0.01, device)
    at = f"@{device.type}"
    assert list(works) == [f"load_triplets{at}", f"train[cswm-compact]{at}", f"plan[cswm]{at}"]
    for name, work in works.items():
        waited.clear()
        result = work()
        assert (result.name, len(result.rounds)) == (name, 6)
        assert result.value > 0
        assert result.limit is not None
        assert len(waited) >= 6  # rounds, each of which waits for the device
        assert {*waited} == {device}


def test_the_bound_of_a_device_counts_its_operations() -> None:
    assert matrix_products_on(CPU, "float32", 0.0) is None
    yardstick = matrix_products_on(CPU, "float32", 2.0 * 512**3)
    assert yardstick is not None
    assert yardstick.amount == 1.0


def test_a_step_on_the_device_is_the_step_of_the_cpu() -> None:
    """The same network, the same noise: what is timed is the training step and nothing else."""
    steps = [TrainingStep("cswm", "compact", batch_size=4, precision="float32", device=one) for one in (None, CPU)]
    for step in steps:
        torch.manual_seed(0)
        step()
    first, second = (list(step._model.parameters()) for step in steps)
    assert all(torch.equal(one, other) for one, other in zip(first, second, strict=True))


def test_only_a_gpu_adds_its_speeds(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    asked: list[Any] = []
    monkeypatch.setattr("dmotion_bench.benchmarks.speeds.measure", lambda *given: asked.append(given[3]) or [])
    if torch.cuda.is_available():
        pytest.skip("this machine has one")
    outcome = dmbench(["bench", "--json"], capsys, monkeypatch)
    assert (json.loads(outcome.out)["gpu"], asked) == ("", [None])
    refused = dmbench(["bench", "--device", "cuda"], capsys, monkeypatch)
    assert refused.code == 2
    assert "this machine has no CUDA device" in refused.sentence()
    with pytest.raises(Exception, match="no speed named '@cuda'"):
        list(measure("@cuda", 0.1, lambda *_: None))
