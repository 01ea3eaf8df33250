"""Speeds of training, loading and planning on a GPU, beside that GPU's own limit.

A GPU works on while the processor goes on, so every measured piece of work ends by waiting for it. Names end with the
device, ``train[dmotion-compact]@cuda``. The same functions run on the CPU, where the tests try them.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from typing import Final

import numpy as np
import torch

from dmotion_bench.benchmarks.planning_speed import PlanningTogether, planned_model
from dmotion_bench.benchmarks.result import Result
from dmotion_bench.benchmarks.rounds import Yardstick, measure_in_rounds
from dmotion_bench.benchmarks.scene import SIZE, scene_facts, scene_frames
from dmotion_bench.benchmarks.training_step import TrainingStep
from dmotion_bench.learning.data.batches import FramesOnDevice, TripletBatches
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.storage.frame_cache import CacheFile, FrameCache
from dmotion_bench.storage.temporary import temporary_folder

_EPISODES, _FRAMES = 100, 30  # of the cache that is loaded from
_BATCH: Final = 32
_IMAGES: Final = 64
_TASKS: Final = 4  # side by side, as control plans
_SIDE: Final = {"cpu": 512, "cuda": 8192}
"""Of the matrices of the yardstick: large enough that nothing but multiplying takes time."""


def device_works(
    models: Mapping[str, tuple[str, ...]], seconds: float, device: torch.device
) -> dict[str, Callable[[], Result]]:
    """What is measured on a device, by the speeds' names.

    Args:
        models: Their architectures, by their names.
        seconds: How long each is measured.
        device: Where.
    """
    at = f"@{device.type}"
    works: dict[str, Callable[[], Result]] = {f"load_triplets{at}": partial(loading_onto, seconds, device)}
    for name, archs in models.items():
        works |= {f"train[{name}-{arch}]{at}": partial(training_on, name, arch, seconds, device) for arch in archs}
    works |= {f"plan[{name}]{at}": partial(planning_on, name, seconds, device) for name in models}
    return works


def loading_onto(seconds: float, device: torch.device) -> Result:
    """Triplets a second that are gathered on the device, from memory that a training would have, and made floats."""
    with _cached_scene() as triplets:
        batches, generator = TripletBatches(triplets, None, FramesOnDevice(device)), np.random.default_rng(0)

        def work() -> float:
            batches(generator.integers(0, len(triplets), _BATCH))
            wait_for(device)
            return _BATCH

        return measure_in_rounds(f"load_triplets@{device.type}", "triplets/s", work, seconds, _copied(device))


def training_on(name: str, arch: str, seconds: float, device: torch.device) -> Result:
    """Triplets a second of a model's training step, as the model is trained by default."""
    step = TrainingStep(name, arch, device=device)

    def work() -> float:
        step()
        wait_for(device)
        return step.config.batch_size

    yardstick = matrix_products_on(device, step.precision, step.operations())
    return measure_in_rounds(f"train[{name}-{arch}]@{device.type}", "triplets/s", work, seconds, yardstick)


def planning_on(name: str, seconds: float, device: torch.device) -> Result:
    """Control steps a second of the paper's planner, tasks side by side."""
    images = scene_frames(_IMAGES)
    model, operations = planned_model(name, images)
    planning = PlanningTogether(model, scene_facts(), images, tasks=_TASKS, device=device)

    def work() -> float:
        done = planning()
        wait_for(device)
        return done

    precision = "bf16" if has_bf16(device) else "float32"
    yardstick = matrix_products_on(device, precision, operations * planning.frames_per_step)
    return measure_in_rounds(f"plan[{name}]@{device.type}", "control steps/s", work, seconds, yardstick)


def matrix_products_on(device: torch.device, precision: str, operations: float) -> Yardstick | None:
    """How often a second so many floating-point operations are done in a large matrix product of the device."""
    if not operations:
        return None
    side, bf16 = _SIDE[device.type], precision == "bf16" and has_bf16(device)
    left = torch.randn(side, side, dtype=torch.bfloat16 if bf16 else torch.float32, device=device)

    def work() -> None:
        torch.mm(left, left)
        wait_for(device)

    return Yardstick(name=f"matrix products alone, {device.type}", amount=2.0 * side**3 / operations, work=work)


def _copied(device: torch.device) -> Yardstick:
    """Triplets a second that are copied within the device's memory, where the frames lie that fit there."""
    batch = torch.zeros(_BATCH, 3, SIZE, SIZE, 3, dtype=torch.uint8, device=device)

    def work() -> None:
        batch.clone()
        wait_for(device)

    return Yardstick(name=f"copies in memory of {device.type}", amount=_BATCH, work=work)


def wait_for(device: torch.device) -> None:
    """Wait until the device has done what it was given; the processor itself never runs ahead."""
    if device.type == "cuda":
        torch.cuda.synchronize(device)


@contextmanager
def _cached_scene() -> Iterator[TripletSet]:
    lengths = np.full(_EPISODES, _FRAMES)
    with temporary_folder() as folder:
        file = CacheFile(folder=folder, fingerprint="0" * 64, count=int(lengths.sum()), height=SIZE, width=SIZE)

        def make() -> None:
            file.build(scene_frames(_FRAMES, episode) for episode in range(_EPISODES))

        yield TripletSet.of(FrameCache(file, lengths, make), np.arange(_EPISODES))
