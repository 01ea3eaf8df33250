"""The speeds that matter to a user: recording, loading, training, planning."""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch.utils.flop_counter import FlopCounterMode

from dmotion_bench.benchmarks import machine, original
from dmotion_bench.benchmarks.planning_speed import measure_one_by_one, measure_planning
from dmotion_bench.benchmarks.result import Failure, Result
from dmotion_bench.benchmarks.training_step import SIZE, TrainingStep, untrained
from dmotion_bench.environment import EpisodeGenerator
from dmotion_bench.errors import DmbenchError, UnknownName
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.optimization import has_bf16
from dmotion_bench.learning.triplets import TripletSet
from dmotion_bench.positions import PositionFinder
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.recording.speed import measure_recording
from dmotion_bench.registry import environment_class, environment_names, model_class, model_names
from dmotion_bench.specs import EnvSpec, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import sentence


def measure(only: str, seconds: float, announce: Callable[[str], None]) -> Iterator[Result | Failure]:
    """Every speed whose name holds ``only``, one after the other, each measured for about so long.

    What somebody's environment or model raises is told, and the next speed is measured.

    Args:
        announce: Told the name of what is measured next.

    Raises:
        UnknownName: No speed's name holds it.
    """
    works: dict[str, Callable[[], Result | Iterator[Result]]] = {}
    for name in environment_names():
        works[f"record[{name}]"] = partial(recording, name, seconds)
    works["load_triplets"] = partial(loading, seconds)
    for name in model_names():
        works |= {f"train[{name}{arch}]": partial(training, name, arch[1:], seconds) for arch in _architectures(name)}
    for name in (with_original := original.models_with_original()):
        works[f"train[{name}-paper-reference]"] = partial(training_as_original, name, seconds)
    for name in model_names():
        works[f"plan[{name}]"] = partial(planning, name, seconds, together=True)
    for name in with_original:
        works[f"plan[{name}-one-by-one]"] = partial(planning, name, seconds, together=False)
    works["find_centres"] = partial(finding, seconds)
    for name in with_original:
        works[f"compact_over_original[{name}]"] = partial(original.compare, name, seconds)
    chosen = {name: work for name, work in works.items() if only in name}
    if not chosen:
        raise UnknownName("speed", only, works)
    for name, work in chosen.items():
        announce(name)
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


def recording(environment: str, seconds: float) -> Result:
    """Frames a second that one process simulates, draws and writes."""
    return Result(
        name=f"record[{environment}]",
        value=measure_recording(environment, seconds).frames_per_s,
        unit="frames/s",
        limit=machine.compression(SIZE * SIZE * 3),
        limit_name="zstd alone, one core",
    )


def loading(seconds: float) -> Result:
    """Triplets a second gathered at random from a warm cache, on one core."""
    with tempfile.TemporaryDirectory(prefix="dmbench-") as folder:
        recipe = replace(recipe_for(_quickest(), Preset.SMALL, tasks=0), episodes=100)
        record_dataset(Path(folder) / "data", recipe)
        dataset = Dataset.open(Path(folder) / "data")
        triplets = TripletSet.of(dataset.cache(), np.arange(len(dataset)))
        generator = np.random.default_rng(0)
        out = np.empty((32, 3, SIZE, SIZE, 3), np.uint8)
        value = machine.rate(lambda: triplets.gather(generator.integers(0, len(triplets), 32), out), 32, seconds)
    return Result(
        name="load_triplets",
        value=value,
        unit="triplets/s",
        limit=machine.memory_copy() / out[0].nbytes,
        limit_name="memory copy, one core",
    )


def training(name: str, arch: str, seconds: float) -> Result:
    """Triplets a second of a model's training step, on all cores, as the model is trained by default."""
    arch = arch or model_class(name).architectures[0]
    return _trained(f"train[{name}-{arch}]", {"": TrainingStep(name, arch)}, seconds)


def training_as_original(name: str, seconds: float) -> Result:
    """The same of the paper's networks as the original trains them, in the better of two sizes of batches."""
    return _trained(f"train[{name}-paper-reference]", original.original_steps(name), seconds)


def _trained(name: str, steps: Mapping[str, TrainingStep], seconds: float) -> Result:
    rates = original.rates_in_turn(steps, seconds)
    best = max(rates, key=rates.__getitem__)
    operations = steps[best].operations()
    return Result(
        name=name,
        value=rates[best],
        unit="triplets/s",
        limit=machine.matrix_products(steps[best].precision) / operations if operations else None,
        limit_name="matrix products alone, all cores",
        setting=best,
    )


def planning(name: str, seconds: float, *, together: bool) -> Result:
    """Control steps a second of the paper's planner: as the control loop takes them, or candidate by candidate."""
    kind, images = model_class(name), _frames()
    arch = kind.architectures[0]
    channels_last = kind.training_defaults(Preset.SMALL, arch).channels_last
    model = untrained(name, arch).laid_out(channels_last=channels_last).eval()
    with FlopCounterMode(display=False) as counter, torch.inference_mode():
        image = to_model(torch.from_numpy(images[:1]))
        model.advance(model.begin(image, image), torch.zeros(1, dtype=torch.long))
    speed = (measure_planning if together else measure_one_by_one)(model, _environment_facts(), images, seconds)
    flops = counter.get_total_flops() * speed.frames / speed.steps
    precision = "bf16" if has_bf16(torch.device("cpu")) else "float32"
    return Result(
        name=f"plan[{name}{'' if together else '-one-by-one'}]",
        value=speed.steps_per_s,
        unit="control steps/s",
        limit=machine.matrix_products(precision) / flops if flops else None,
        limit_name="matrix products alone, all cores",
    )


def finding(seconds: float) -> Result:
    """Pictures a second in which every object's centre is found."""
    finder, images = PositionFinder(_environment_facts()), torch.from_numpy(_frames())
    return Result(
        name="find_centres",
        value=machine.rate(lambda: finder.find(images), len(images), seconds),
        unit="images/s",
        limit=machine.memory_copy() / images[0].numpy().nbytes,
        limit_name="memory copy, one core",
    )


def _environment_facts() -> EnvSpec:
    return environment_class(_quickest())().facts


def _quickest() -> str:
    """An installed environment that makes many episodes at once, or any.

    Raises:
        DmbenchError: None is installed.
    """
    installed = environment_names()
    if not installed:
        raise DmbenchError("no environment is installed, so there are no frames to measure with.")
    return next((name for name in installed if _makes_many(name)), installed[0])


def _makes_many(environment: str) -> bool:
    kind: object = environment_class(environment)
    return isinstance(kind, EpisodeGenerator)


def _frames() -> UInt8[np.ndarray, "n h w 3"]:
    """Some pictures of the environment that makes them most quickly."""
    with tempfile.TemporaryDirectory(prefix="dmbench-") as folder:
        record_dataset(
            Path(folder) / "data", replace(recipe_for(_quickest(), Preset.TINY, tasks=0), episodes=2, frames=32)
        )
        dataset = Dataset.open(Path(folder) / "data")
        return np.concatenate([dataset.video(episode) for episode in range(2)])
