"""How much faster the compact networks train than the original's, both at whatever setting is best for them.

The original trains the paper's networks in float32 on contiguous images, with Adam. How fast that goes depends on the
batch, and how fast the compact networks go on the precision; which is better differs from processor to processor. So
all are measured in turn and the best of each is compared: per second of one thread's CPU time, which other work on
the machine does not lengthen much, and per second on all threads.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from statistics import median
from typing import Any, Final, Protocol, runtime_checkable

import torch

from dmotion_bench.benchmarks.result import Result
from dmotion_bench.benchmarks.rounds import ROUNDS
from dmotion_bench.benchmarks.training_step import TrainingStep
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.learning.model import TrainingConfig

MODEL: Final = "dmotion"
BATCHES: Final = (8, 32)
ORIGINAL: Final[Mapping[str, Any]] = {
    "optimizer": "adam",
    "schedule": "constant",
    "precision": "float32",
    "channels_last": False,
    "clip_norm": 0.0,
}
"""How the original of the paper trains, eagerly."""


def original_steps() -> Mapping[str, TrainingStep]:
    """The paper's networks as the original trains them, by the setting."""
    return {f"batches of {size}": TrainingStep(MODEL, "paper", batch_size=size, **ORIGINAL) for size in BATCHES}


def compact_steps() -> Mapping[str, TrainingStep]:
    """The compact networks, by the setting."""
    precisions = ("bf16", "float32") if has_bf16(torch.device("cpu")) else ("float32",)
    return {precision: TrainingStep(MODEL, "compact", precision=precision) for precision in precisions}


def compact_over_original(seconds: float) -> Iterator[Result]:
    """The compact networks over the original's, each at its best setting, each setting measured for so long."""
    original, compact = original_steps(), compact_steps()
    for threads, clock, unit, label in (
        (1, time.process_time, "triplets/CPU s", "one thread"),
        (torch.get_num_threads(), time.perf_counter, "triplets/s", "all threads"),
    ):
        with _threads(threads):
            for step in (*original.values(), *compact.values()):
                step()  # the first one also sets up what later ones reuse
            rates = [rates_in_turn({**original, **compact}, seconds / ROUNDS, clock) for _ in range(ROUNDS)]
        best = {}
        for which, steps in (("original", original), ("compact", compact)):
            rounds = {setting: tuple(one[setting] for one in rates) for setting in steps}
            setting = max(steps, key=lambda name: median(rounds[name]))
            best[which] = rounds[setting]
            yield Result(name=f"train_{which}[{label}]", unit=unit, rounds=rounds[setting], setting=setting)
        yield Result(
            name=f"compact_over_original[{label}]",
            unit=f"times as many {unit}",
            rounds=tuple(fast / slow for fast, slow in zip(best["compact"], best["original"], strict=True)),
        )


@runtime_checkable
class Step(Protocol):
    """A training step that is timed."""

    config: TrainingConfig

    def __call__(self) -> object:
        """Train one batch."""


def rates_in_turn(
    steps: Mapping[str, Step], seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Triplets a second of some steps; always the one that has had the least time goes on, so all see the same load."""
    spent, done = dict.fromkeys(steps, 0.0), Counter[str]()
    while (name := min(spent, key=spent.__getitem__)) not in done or spent[name] < seconds:
        began = clock()
        steps[name]()
        spent[name] += clock() - began
        done[name] += steps[name].config.batch_size
    return {name: done[name] / spent[name] for name in steps}


@contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
