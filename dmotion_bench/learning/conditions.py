"""The conditions of a training that begins: as many threads as torch has now, and the precision that is asked for.

Where no precision is asked for, a model and an optimiser that are thrown away afterwards take some real steps in each.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch

from dmotion_bench.learning.curriculum import Part
from dmotion_bench.learning.optimization import learning_rate, make_optimizer, set_learning_rate
from dmotion_bench.learning.precision import Precision, settled, timed
from dmotion_bench.learning.run_manifest import Conditions, RunSpec
from dmotion_bench.learning.step import Stepper


def choose_conditions(spec: RunSpec, parts: Sequence[Part], device: torch.device, processes: int) -> Conditions:
    """What a training is to compute with from its first step to its last.

    Args:
        spec: What is asked for.
        parts: Of the training.
        device: Where it runs.
        processes: How many share a batch.
    """
    threads = torch.get_num_threads()
    precision = settled(spec.training_config.precision, parts[-1].stop, device)
    if precision is not None:
        return Conditions(threads=threads, precision=precision)
    rounds = timed(_trial(spec, parts, device, processes), device)
    return Conditions(threads=threads, precision=rounds.faster, probe=rounds.medians)


def _trial(spec: RunSpec, parts: Sequence[Part], device: torch.device, processes: int) -> Callable[[Precision], object]:
    """Takes a step on the first batch of the longest phase, each time it is called."""
    part = max(parts, key=lambda part: part.stop - part.start)
    model = spec.build().laid_out().to(device)
    optimizer = make_optimizer(model, spec.training_config)
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
    )
    batch = part.batches(part.order.batch(0)[::processes])
    return lambda precision: step(batch, 0, precision)
