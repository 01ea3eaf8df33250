"""How much faster the compact networks train than the original's, both at whatever setting is best for them.

The original trains the paper's networks in float32 on contiguous images, with Adam. How fast that goes depends on the
batch, and how fast the compact networks go on the precision; which is better differs from processor to processor. So
all are measured in turn and the best of each is compared: per second of one thread's CPU time, which other work on
the machine does not lengthen much, and per second on all threads.
"""

from __future__ import annotations

import contextlib
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from typing import Any, ClassVar, Final, Protocol, runtime_checkable

import torch

from dmotion_bench.benchmarks.result import Result
from dmotion_bench.benchmarks.training_step import TrainingStep
from dmotion_bench.learning.optimization import has_bf16
from dmotion_bench.registry import model_class, model_names

BATCHES: Final = (8, 32)


@runtime_checkable
class HasOriginal(Protocol):
    """A model class that has the networks of its paper's published code as an architecture of its own.

    Attributes:
        original_arch: Its name.
        original_training: How the published code trains it: fields of ``TrainingConfig``.
    """

    original_arch: ClassVar[str]
    original_training: ClassVar[Mapping[str, Any]]


def models_with_original() -> list[str]:
    """The installed models that say how their original is trained; those that cannot be loaded are left out."""
    found = []
    for name in model_names():
        with contextlib.suppress(Exception):  # somebody else's model may raise anything; measuring it says so
            kind: object = model_class(name)
            if isinstance(kind, HasOriginal) and "original_arch" in vars(kind):
                found.append(name)
    return found


def original_steps(model: str) -> dict[str, TrainingStep]:
    """The original's networks as the original trains them, by the setting."""
    kind: Any = model_class(model)
    arch, training = kind.original_arch, kind.original_training
    return {f"batches of {size}": TrainingStep(model, arch, batch_size=size, **training) for size in BATCHES}


def compact_steps(model: str) -> dict[str, TrainingStep]:
    """The networks of the model's first architecture, by the setting."""
    precisions = ("bf16", "float32") if has_bf16(torch.device("cpu")) else ("float32",)
    arch = model_class(model).architectures[0]
    return {precision: TrainingStep(model, arch, precision=precision) for precision in precisions}


def compare(model: str, seconds: float) -> Iterator[Result]:
    """The compact networks over the original's, each at its best setting, each setting measured for so long."""
    original, compact = original_steps(model), compact_steps(model)
    for threads, clock, unit, label in (
        (1, time.process_time, "triplets/CPU s", "one thread"),
        (torch.get_num_threads(), time.perf_counter, "triplets/s", "all threads"),
    ):
        with _threads(threads):
            rates = rates_in_turn({**original, **compact}, seconds, clock)
        best = {}
        for which, steps in (("original", original), ("compact", compact)):
            setting = max(steps, key=rates.__getitem__)
            best[which] = rates[setting]
            yield Result(name=f"train_{which}[{label}]", value=rates[setting], unit=unit, setting=setting)
        yield Result(
            name=f"compact_over_original[{label}]",
            value=best["compact"] / best["original"],
            unit=f"times as many {unit}",
        )


def rates_in_turn(
    steps: Mapping[str, TrainingStep], seconds: float, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Triplets a second of some steps; always the one that has had the least time goes on, so all see the same load."""
    spent, done = dict.fromkeys(steps, 0.0), Counter[str]()
    for step in steps.values():
        step()  # the first one also sets up what later ones reuse
    while (name := min(spent, key=spent.__getitem__)) not in done or spent[name] < seconds:
        began = clock()
        steps[name]()
        spent[name] += clock() - began
        done[name] += steps[name].config.batch_size
    return {name: done[name] / spent[name] for name in steps}


@contextlib.contextmanager
def _threads(count: int) -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
