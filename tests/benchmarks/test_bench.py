"""``dmbench bench``: a broken plug-in costs a sentence, and the original is compared at its own best setting."""

from __future__ import annotations

import json
from importlib.metadata import EntryPoint, entry_points
from typing import Any

import pytest
import torch
from dmbench_command import dmbench
from older_network import OlderNetwork

from dmotion_bench import registry
from dmotion_bench.benchmarks import original
from dmotion_bench.benchmarks.machine import processor
from dmotion_bench.benchmarks.original import compare, rates_in_turn
from dmotion_bench.learning.model import TrainingConfig


class Explosive(OlderNetwork):
    """Somebody's model that cannot be trained."""

    def losses(self, batch: Any) -> Any:
        raise ZeroDivisionError("by hand")


@pytest.fixture
def _plug_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [("away", "no_such_module:Model"), ("explosive", "benchmarks.test_bench:Explosive")]
    points = [EntryPoint(name=name, value=value, group=registry.MODELS) for name, value in broken]
    monkeypatch.setattr(EntryPoint, "load", _load(EntryPoint.load))

    def with_plug_ins(group: str) -> Any:
        return [*entry_points(group=group), *(points if group == registry.MODELS else [])]

    monkeypatch.setattr(registry, "entry_points", with_plug_ins)


def _load(load: Any) -> Any:
    return lambda point: Explosive if point.name == "explosive" else load(point)


@pytest.mark.usefixtures("_plug_ins")
def test_a_broken_plug_in_is_told_and_the_others_are_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ran(only: str) -> Any:
        return dmbench(["bench", "--only", only, "--seconds", "0.1", "--json"], capsys, monkeypatch)

    away = ran("away")
    assert away.code == 1
    assert "train[away] could not be measured: the model 'away' is registered as 'no_such_module:Model'" in away.err
    assert [one["name"] for one in json.loads(away.out)["failures"]] == ["train[away]", "plan[away]"]

    both = ran("train[e")
    told = json.loads(both.out)
    assert [one["name"] for one in told["results"]] == ["train[ed-cnn-compact]"]
    assert told["failures"] == [{"name": "train[explosive-compact]", "said": "it raised ZeroDivisionError: by hand"}]
    assert told["processor"] == processor()
    assert told["threads"] == torch.get_num_threads()


class Counted:
    """A step whose time is what its clock says."""

    now = 0.0

    def __init__(self, seconds: float, batch_size: int) -> None:
        self.seconds, self.config, self.taken = seconds, TrainingConfig(epochs=1, batch_size=batch_size), 0

    def __call__(self) -> None:
        Counted.now += self.seconds
        self.taken += 1


def test_steps_are_timed_in_turn_until_each_has_had_its_time() -> None:
    slow, fast = Counted(3.0, 32), Counted(0.5, 8)
    rates = rates_in_turn({"slow": slow, "fast": fast}, 2.0, lambda: Counted.now)  # type: ignore[dict-item]
    assert rates == {"slow": pytest.approx(32 / 3), "fast": pytest.approx(16)}
    assert (slow.taken, fast.taken) == (1 + 1, 1 + 4)  # one first each, untimed


def test_the_ratio_is_of_each_ones_best_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = {"batches of 8": 2.0, "batches of 32": 1.5, "bf16": 30.0, "float32": 50.0}
    threads: list[int] = []

    def rates(steps: Any, seconds: float, clock: Any) -> dict[str, float]:
        threads.append(torch.get_num_threads())
        return {name: speeds[name] * len(threads) for name in steps}

    monkeypatch.setattr(original, "rates_in_turn", rates)
    monkeypatch.setattr(original, "TrainingStep", lambda *_, **__: None)
    monkeypatch.setattr(original, "has_bf16", lambda device: True)
    before = torch.get_num_threads()
    found = {one.name: one for one in compare("dmotion", 1.0)}

    assert {name: one.value for name, one in found.items()} == {
        "train_original[one thread]": 2.0,
        "train_compact[one thread]": 50.0,
        "compact_over_original[one thread]": 25.0,
        "train_original[all threads]": 4.0,
        "train_compact[all threads]": 100.0,
        "compact_over_original[all threads]": 25.0,
    }
    assert (found["train_original[one thread]"].setting, found["train_compact[one thread]"].setting) == (
        "batches of 8",
        "float32",
    )
    assert (threads, torch.get_num_threads()) == ([1, before], before)


def test_the_original_is_run_as_the_original_runs() -> None:
    (step, *_) = original.original_steps("dmotion").values()
    assert (step.config.precision, step.config.channels_last, step.config.optimizer) == ("float32", False, "adam")
    assert not step._model.channels_last
    assert {one.config.batch_size for one in original.original_steps("dmotion").values()} == {8, 32}
