"""``dmbench bench``: broken plug-ins cost a sentence, speeds are compared with stored ones beyond their noise."""

from __future__ import annotations

import json
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from typing import Any

import pytest
import torch
from dmbench_command import dmbench
from older_network import OlderNetwork

from baselines import original_speed
from baselines.original_speed import compact_over_original, rates_in_turn
from dmotion_bench import entry_points
from dmotion_bench.benchmarks.comparison import Stored, changes
from dmotion_bench.benchmarks.machine import processor
from dmotion_bench.benchmarks.result import Result
from dmotion_bench.benchmarks.rounds import ROUNDS, Yardstick, measure_in_rounds
from dmotion_bench.learning.model import TrainingConfig


class Explosive(OlderNetwork):
    """Somebody's model that cannot be trained."""

    def losses(self, batch: Any) -> Any:
        raise ZeroDivisionError("by hand")


@pytest.fixture
def _plug_ins(monkeypatch: pytest.MonkeyPatch) -> None:
    broken = [("away", "no_such_module:Model"), ("explosive", "benchmarks.test_bench:Explosive")]
    points = [EntryPoint(name=name, value=value, group=entry_points.MODELS) for name, value in broken]
    monkeypatch.setattr(EntryPoint, "load", _load(EntryPoint.load))
    real = entry_points.registered

    def with_plug_ins(group: str) -> Any:
        return [*real(group), *(points if group == entry_points.MODELS else [])]

    monkeypatch.setattr(entry_points, "registered", with_plug_ins)


def _load(load: Any) -> Any:
    return lambda point: Explosive if point.name == "explosive" else load(point)


@pytest.mark.slow
@pytest.mark.usefixtures("_plug_ins")
def test_a_broken_plug_in_is_told_and_the_others_are_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ran(only: str) -> Any:
        return dmbench(["bench", "--only", only, "--seconds", "0.1", "--json"], capsys, monkeypatch)

    away = ran("away")
    assert away.code == 1
    assert "train[away] could not be measured: the model 'away' is registered as 'no_such_module:Model'" in away.err
    assert [one["name"] for one in json.loads(away.out)["failures"]] == [
        "train[away]",
        "plan[away]",
        "plan[away-one-by-one]",
    ]

    both = ran("train[e")
    told = json.loads(both.out)
    assert [one["name"] for one in told["results"]] == ["train[ed-cnn-compact]"]
    assert told["failures"] == [{"name": "train[explosive-compact]", "said": "it raised ZeroDivisionError: by hand"}]
    assert told["processor"] == processor()
    assert told["threads"] == torch.get_num_threads()


def test_an_interruption_keeps_what_was_measured(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def measured(*_: object) -> Iterator[Result]:
        yield _result((3.0,))
        raise KeyboardInterrupt

    monkeypatch.setattr("dmotion_bench.benchmarks.speeds.measure", measured)
    outcome = dmbench(["bench", "--json"], capsys, monkeypatch)
    assert outcome.code == 130
    assert [one["name"] for one in json.loads(outcome.out)["results"]] == [_result((3.0,)).name]
    assert "the speeds measured so far are above. The same command measures all of them again" in outcome.sentence()


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
    rates = rates_in_turn({"slow": slow, "fast": fast}, 2.0, lambda: Counted.now)
    assert rates == {"slow": pytest.approx(32 / 3), "fast": pytest.approx(16)}
    assert (slow.taken, fast.taken) == (1, 4)


def test_the_ratio_is_of_each_ones_best_setting(monkeypatch: pytest.MonkeyPatch) -> None:
    speeds = {"batches of 8": 2.0, "batches of 32": 1.5, "bf16": 30.0, "float32": 50.0}
    threads: list[int] = []

    def rates(steps: Any, seconds: float, clock: Any) -> dict[str, float]:
        threads.append(torch.get_num_threads())
        return {name: speeds[name] * (1 + (len(threads) > ROUNDS)) for name in steps}

    monkeypatch.setattr(original_speed, "rates_in_turn", rates)
    untimed: list[int] = []
    steps = {
        which: dict.fromkeys(names, lambda: untimed.append(len(threads)))
        for which, names in (("original", list(speeds)[:2]), ("compact", list(speeds)[2:]))
    }
    monkeypatch.setattr(original_speed, "original_steps", lambda: steps["original"])
    monkeypatch.setattr(original_speed, "compact_steps", lambda: steps["compact"])
    before = torch.get_num_threads()
    found = {one.name: one for one in compact_over_original(1.0)}

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
    assert (threads, torch.get_num_threads()) == ([1] * ROUNDS + [before] * ROUNDS, before)
    assert untimed == [0] * 4 + [ROUNDS] * 4  # each step once, before the rounds with so many threads


def test_the_original_is_run_as_the_original_runs() -> None:
    (step, *_) = original_speed.original_steps().values()
    assert (step.config.precision, step.config.channels_last, step.config.optimizer) == ("float32", False, "adam")
    assert not step._model.channels_last
    assert {one.config.batch_size for one in original_speed.original_steps().values()} == {8, 32}


def test_work_and_yardstick_are_measured_in_turn() -> None:
    turns: list[str] = []
    now = 0.0

    def work() -> float:
        nonlocal now
        now += 1.0
        turns.append("work")
        return 10.0

    def bound() -> None:
        nonlocal now
        now += 0.25
        turns.append("bound")

    yardstick = Yardstick(name="a bound", amount=5.0, work=bound)
    found = measure_in_rounds("what", "things/s", work, ROUNDS * 2.0, yardstick, clock=lambda: now)
    assert found == Result(
        name="what", unit="things/s", rounds=(10.0,) * ROUNDS, limits=(20.0,) * ROUNDS, limit_name="a bound"
    )
    assert turns == ["work", "bound"] + (["bound"] * 2 + ["work"] * 2) * ROUNDS


def _result(rounds: tuple[float, ...], limits: tuple[float, ...] = (), unit: str = "things/s") -> Result:
    return Result(name="what", unit=unit, rounds=rounds, limits=limits, limit_name="a bound" if limits else "")


@pytest.mark.parametrize(
    ("before", "now", "verdict", "ratio"),
    [
        ((10, 11, 12), (7, 8, 9), "slower", 8 / 11),
        ((10, 11, 12), (13, 14, 15), "faster", 14 / 11),
        ((10, 11, 12), (7, 8, 10), "within noise", 8 / 11),
    ],
)
def test_only_rounds_that_do_not_overlap_are_a_difference(
    before: tuple[float, ...], now: tuple[float, ...], verdict: str, ratio: float
) -> None:
    stored = Stored(processor="", threads=1, results={"what": _result(before)})
    (change,) = changes(stored, [_result(now)])
    assert (change.verdict, change.relative) == (verdict, False)
    assert change.ratio == pytest.approx(ratio)


def test_a_busy_machine_is_not_slower_code() -> None:
    stored = Stored(processor="", threads=1, results={"what": _result((10, 11, 12), (100, 110, 120))})
    (busy,) = changes(stored, [_result((5, 5.5, 6), (50, 55, 60))])
    assert (busy.verdict, busy.relative, busy.ratio) == ("within noise", True, pytest.approx(1.0))
    (slower,) = changes(stored, [_result((5, 5.5, 6), (100, 110, 120))])
    assert (slower.verdict, slower.ratio) == ("slower", pytest.approx(0.5))


def test_what_only_one_run_has_is_not_compared() -> None:
    stored = Stored(processor="", threads=1, results={"what": _result((1,), unit="other things/s")})
    assert not list(changes(stored, [_result((1,))]))


@pytest.mark.slow
def test_a_stored_run_is_compared_with(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    def ran(*words: str) -> Any:
        return dmbench(["bench", "--only", "find_centres", "--seconds", "0.2", *words], capsys, monkeypatch)

    content = json.loads(ran("--json").out)
    (found,) = content["results"]
    assert len(found["rounds"]) == len(found["limits"]) == ROUNDS
    file = tmp_path / "before.json"

    def compared(factor: float, processor: str = content["processor"], *words: str) -> Any:
        rounds = [factor * speed for speed in found["rounds"]]
        changed = content | {"processor": processor, "results": [found | {"rounds": rounds}]}
        file.write_text(json.dumps(changed))
        return ran("--compare", str(file), *words)

    slower = compared(1e3)
    assert slower.code == 1
    assert "Slower: find_centres." in slower.out
    faster = compared(1e-3, "an abacus")
    assert faster.code == 0
    assert "The stored run is of another machine: an abacus, " in faster.out
    assert "Nothing became slower." in faster.out
    assert json.loads(compared(1e3, "an abacus", "--json").out)["changes"][0]["verdict"] == "slower"


@pytest.mark.parametrize(
    ("content", "says"),
    [
        ("[]", "it holds [], not a JSON object"),
        ('{"processor": "p", "threads": 1, "results": [{"rounds": [0], "limits": []}]}', "not all rounds are above"),
        ('{"processor": "p", "threads": 1, "results": [{"rounds": [], "limits": []}]}', "there are 0 rounds"),
        (None, "No such file or directory"),
    ],
)
def test_another_file_costs_a_sentence(
    content: str | None,
    says: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    file = tmp_path / "file.json"
    if content is not None:
        file.write_text(content)
    outcome = dmbench(["bench", "--only", "find_centres", "--compare", str(file)], capsys, monkeypatch)
    assert outcome.code == 2
    assert says in outcome.sentence()
    assert "make such a file with 'dmbench bench --json > FILE'" in outcome.sentence()
