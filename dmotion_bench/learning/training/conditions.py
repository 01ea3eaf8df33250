"""The conditions of a training that begins: threads and precision, as asked for, or whichever are faster here.

What is not asked for is measured: a model and an optimiser that are thrown away afterwards take some real steps in
each way. One thread is faster than all where other work keeps the cores busy: threads that share a step wait for the
one that got no core.

All processes that train together take these steps at the same time, for a model may ask the others in its losses.
"""

from __future__ import annotations

import functools
import logging
import statistics
from collections.abc import Callable, Sequence

import torch

from dmotion_bench.learning.data.curriculum import Part
from dmotion_bench.learning.hardware.precision import PRECISIONS, Precision, settled
from dmotion_bench.learning.hardware.threads import has_choice_of_threads, using_threads
from dmotion_bench.learning.hardware.timing import clearly_faster, timed_in_turn
from dmotion_bench.learning.runs.manifest import Conditions, RunSpec
from dmotion_bench.learning.training.companions import Companions
from dmotion_bench.learning.training.optimizer import learning_rate, optimizer_of, set_learning_rate
from dmotion_bench.learning.training.step import Stepper

_log = logging.getLogger(__name__)


def choose_conditions(
    spec: RunSpec, parts: Sequence[Part], device: torch.device, companions: Companions, threads: int | None = None
) -> Conditions:
    """What a training is to compute with from its first step to its last; each process measures for itself.

    Args:
        spec: What is asked for.
        parts: Of the training.
        device: Where it runs.
        companions: The processes that share a batch.
        threads: Asked for; None: as many as torch has, or a single one where that is clearly faster.
    """
    steps, precision = parts[-1].stop, settled(spec.training_config.precision, parts[-1].stop, device)
    step = functools.cache(lambda: _trial(spec, parts, device, companions))
    by_threads: dict[str, float] = {}
    if threads is None and has_choice_of_threads(steps, device, companions.world):
        tried = precision or "bf16"
        counts = {str(count): count for count in (torch.get_num_threads(), 1)}
        rounds = timed_in_turn(
            {name: functools.partial(_with_threads, count, step(), tried) for name, count in counts.items()}, device
        )
        by_threads = {name: statistics.median(seconds) for name, seconds in rounds.items()}
        usual, alone = rounds.values()
        threads = 1 if clearly_faster(alone, usual) else None
        if threads == 1:
            _log.warning(
                "this machine is busy: a step takes %.2g s with %s threads and %.2g s with one, so the training "
                "computes with one; '--threads' chooses another number.",
                *(by_threads[str(torch.get_num_threads())], torch.get_num_threads(), by_threads["1"]),
            )
    threads = threads or torch.get_num_threads()
    if precision is not None:
        return Conditions(threads=threads, precision=precision, threads_probe=by_threads)
    ways: dict[str, Callable[[], object]] = {
        name: functools.partial(_with_threads, threads, step(), name) for name in PRECISIONS
    }
    seconds = timed_in_turn(ways, device, companions.of_first)
    chosen: Precision = "float32" if clearly_faster(seconds["float32"], seconds["bf16"]) else "bf16"
    medians = {name: statistics.median(each) for name, each in seconds.items()}
    return Conditions(threads=threads, precision=chosen, probe=medians, threads_probe=by_threads)


def _with_threads(threads: int, step: Callable[[Precision], object], precision: Precision) -> None:
    with using_threads(threads):
        step(precision)


def _trial(
    spec: RunSpec, parts: Sequence[Part], device: torch.device, companions: Companions
) -> Callable[[Precision], object]:
    """Takes a step on the first batch of the longest phase, each time it is called."""
    part = max(parts, key=lambda part: part.stop - part.start)
    model = spec.build().laid_out().to(device)
    optimizer = optimizer_of(model, spec.training_config)
    set_learning_rate(optimizer, learning_rate(spec.training_config, 0.0))
    model.train()
    model.enter(part.phase)
    model.progress(0.0)
    step = Stepper(
        model=model,
        losses=model.losses,
        backward=torch.autograd.backward,
        optimizer=optimizer,
        clip_norm=spec.training_config.clip_norm,
        seed=spec.seed,
        device=device,
        rank=companions.rank,
    )
    part.batches.expect(0, companions.rank, companions.world)
    batch = part.batches(part.order.share(part.order.batch(0), companions.rank, companions.world))
    return lambda precision: step(batch, 0, precision)
