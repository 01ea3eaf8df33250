"""The speeds that matter to a user: recording, loading, training, planning.

Every registered environment and model is measured. A package can add speeds of its own by an entry point of the group
``dmbench.speeds``: its name is the speed's, and it is called with the seconds to measure for and yields results.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np
import torch

from dmotion_bench.benchmarks import machine
from dmotion_bench.benchmarks.device_speeds import device_works
from dmotion_bench.benchmarks.planning_speed import PlanningOneByOne, PlanningTogether, planned_model
from dmotion_bench.benchmarks.result import Failure, Result
from dmotion_bench.benchmarks.rounds import measure_in_rounds
from dmotion_bench.benchmarks.scene import SIZE, scene_dataset, scene_facts, scene_frames
from dmotion_bench.benchmarks.training_step import TrainingStep
from dmotion_bench.errors import DmbenchError, UnknownName
from dmotion_bench.learning.data.streamed import StreamedBatches, StreamedTriplets
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.hardware.precision import has_bf16
from dmotion_bench.positions import PositionFinder
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.recording.speed import RecordedFrames
from dmotion_bench.registry import environment_names, model_class, model_names, speed, speed_names
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.frame_cache import CacheFile, FrameCache
from dmotion_bench.storage.temporary import temporary_folder
from dmotion_bench.wording import sentence

_FRAME_BYTES: Final = SIZE * SIZE * 3
_EPISODES, _FRAMES = 100, 30  # of the cache that is loaded from
_RECORDED: Final = 40  # episodes of an environment that are streamed
_BATCH: Final = 32
_IMAGES: Final = 64


def measure(
    only: str, seconds: float, announce: Callable[[str, int, int], None], device: torch.device | None = None
) -> Iterator[Result | Failure]:
    """Every speed whose name holds ``only``, one after the other, each measured for about so long.

    What somebody's environment or model raises is told, and the next speed is measured.

    Args:
        announce: Told the name of the next speed, how many speeds are done, and how many there are.
        device: A GPU, whose speeds are measured, too; None for the CPU alone.

    Raises:
        UnknownName: No speed's name holds it.
    """
    works: dict[str, Callable[[], Result | Iterator[Result]]] = {}
    for name in environment_names():
        works[f"record[{name}]"] = partial(recording, name, seconds)
    works["load_triplets"] = partial(loading, seconds)
    works["stream_triplets"] = partial(streaming, seconds)
    works |= {f"stream_triplets[{name}]": partial(streaming, seconds, name) for name in environment_names()}
    for name in model_names():
        works |= {f"train[{name}{arch}]": partial(training, name, arch[1:], seconds) for arch in _architectures(name)}
    for name in model_names():
        works[f"plan[{name}]"] = partial(planning, name, seconds, together=True)
        works[f"plan[{name}-one-by-one]"] = partial(planning, name, seconds, together=False)
    works["find_centres"] = partial(finding, seconds)
    for name in speed_names():
        works[name] = partial(_added, name, seconds)
    if device is not None:
        models = {name: tuple(arch[1:] for arch in _architectures(name) if arch) for name in model_names()}
        works |= device_works(models, seconds, device)
    chosen = {name: work for name, work in works.items() if only in name}
    if not chosen:
        raise UnknownName("speed", only, works)
    for done, (name, work) in enumerate(chosen.items()):
        announce(name, done, len(chosen))
        try:
            measured = work()
            yield from [measured] if isinstance(measured, Result) else measured
        except DmbenchError as error:
            yield Failure(name=name, said=str(error))
        except Exception as error:  # somebody else's model or environment; the others are to be measured
            yield Failure(name=name, said=sentence(f"it raised {type(error).__name__}: {error}"))


def _architectures(model: str) -> list[str]:
    """``-compact`` and the like; of a model that cannot be loaded, which is said when it is measured, nothing."""
    try:
        return [f"-{arch}" for arch in model_class(model).architectures]
    except Exception:  # as above
        return [""]


def _added(name: str, seconds: float) -> Iterator[Result]:
    """A speed that another package has added."""
    yield from speed(name)(seconds)


def recording(environment: str, seconds: float) -> Result:
    """Frames a second that one process simulates, draws and writes."""
    with RecordedFrames(environment) as work:
        yardstick = machine.compression(_FRAME_BYTES)
        return measure_in_rounds(f"record[{environment}]", "frames/s", work, seconds, yardstick)


def loading(seconds: float) -> Result:
    """Triplets a second gathered at random from a warm cache, on one core."""
    lengths = np.full(_EPISODES, _FRAMES)
    with temporary_folder() as folder:
        file = CacheFile(folder=folder, fingerprint="0" * 64, count=int(lengths.sum()), height=SIZE, width=SIZE)

        def make() -> None:
            file.build(scene_frames(_FRAMES, episode) for episode in range(_EPISODES))

        triplets = TripletSet.of(FrameCache(file, lengths, make), np.arange(_EPISODES))
        generator = np.random.default_rng(0)
        out = np.empty((_BATCH, 3, SIZE, SIZE, 3), np.uint8)

        def work() -> float:
            triplets.gather(generator.integers(0, len(triplets), _BATCH), out)
            return _BATCH

        return measure_in_rounds("load_triplets", "triplets/s", work, seconds, machine.memory_copy(3 * _FRAME_BYTES))


def streaming(seconds: float, environment: str | None = None) -> Result:
    """Triplets a second of processor time, gathered from compressed shards while they are read, on one core.

    Args:
        seconds: How long is measured.
        environment: Whose recording is read; None for the made-up scene.
    """
    with temporary_folder() as folder:
        if environment is None:
            name, dataset = "stream_triplets", scene_dataset(folder / "scene", _EPISODES, _FRAMES)
        else:
            name, recipe = f"stream_triplets[{environment}]", recipe_for(environment, Preset.SMALL, tasks=0)
            few = replace(recipe, episodes=_RECORDED)
            dataset = Dataset.open(record_dataset(folder / "recorded", few).dataset)
        height, width = dataset.spec.height, dataset.spec.width
        count = int((dataset.lengths - 2).clip(0).sum())
        triplets = StreamedTriplets.of_split(dataset, "train", window=count // 4)
        order = triplets.order(_BATCH, seed=0)
        batches, step = StreamedBatches(triplets, order, None, torch.device("cpu")), 0

        def work() -> float:
            nonlocal step
            batches.expect(step, 0, 1)
            batches.gather(order.batch(step))
            step += 1
            return _BATCH

        try:
            yardstick = machine.memory_copy(3 * height * width * 3)
            return measure_in_rounds(name, "triplets/s", work, seconds, yardstick, clock=time.process_time)
        finally:
            batches.close()


def training(name: str, arch: str, seconds: float) -> Result:
    """Triplets a second of a model's training step, on all cores, as the model is trained by default."""
    arch = arch or model_class(name).architectures[0]
    step = TrainingStep(name, arch)

    def work() -> float:
        step()
        return step.config.batch_size

    operations = step.operations()
    yardstick = machine.matrix_products(step.precision, operations) if operations else None
    return measure_in_rounds(f"train[{name}-{arch}]", "triplets/s", work, seconds, yardstick)


def planning(name: str, seconds: float, *, together: bool) -> Result:
    """Control steps a second of the first column's planner: as the loop takes them, or candidate by candidate."""
    images = scene_frames(_IMAGES)
    model, operations = planned_model(name, images)
    work = (PlanningTogether if together else PlanningOneByOne)(model, scene_facts(), images)
    operations *= work.frames_per_step
    precision = "bf16" if has_bf16(torch.device("cpu")) else "float32"
    yardstick = machine.matrix_products(precision, operations) if operations else None
    label = f"plan[{name}{'' if together else '-one-by-one'}]"
    return measure_in_rounds(label, "control steps/s", work, seconds, yardstick)


def finding(seconds: float) -> Result:
    """Pictures a second in which every object's centre is found."""
    finder, images = PositionFinder(scene_facts()), torch.from_numpy(scene_frames(_IMAGES))

    def work() -> float:
        finder.find(images)
        return len(images)

    return measure_in_rounds("find_centres", "images/s", work, seconds, machine.memory_copy(_FRAME_BYTES))
