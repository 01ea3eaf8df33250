"""The speeds that matter to a user: recording, loading, training, planning."""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np
import torch
from jaxtyping import UInt8
from torch.utils.flop_counter import FlopCounterMode

from dmotion_bench.benchmarks import machine
from dmotion_bench.errors import UnknownName
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ModelInputs, TrainingConfig, TripletBatch
from dmotion_bench.learning.optimization import has_bf16, make_optimizer
from dmotion_bench.learning.precision import FEWEST_STEPS, settled, timed
from dmotion_bench.learning.step import Stepper
from dmotion_bench.learning.triplets import TripletSet
from dmotion_bench.planning.speed import measure_one_by_one, measure_planning
from dmotion_bench.positions import PositionFinder
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.recording.speed import measure_recording
from dmotion_bench.registry import environment_class, environment_names, model_class, model_names
from dmotion_bench.specs import EnvSpec, Preset, Supervision
from dmotion_bench.storage.dataset import Dataset

SIZE = 128
ORIGINAL = TrainingConfig(
    epochs=1, optimizer="adam", schedule="constant", precision="float32", channels_last=False, clip_norm=0.0
)
"""How the original of the paper trains: float32, contiguous, eager."""


@dataclass(frozen=True, kw_only=True)
class Result:
    """One speed.

    Attributes:
        name: Fixed, for scripts: ``record[grid_world]``.
        value, unit: What was measured.
        limit: What would be reached if only ``limit_name`` took time; None where nothing physical bounds it.
    """

    name: str
    value: float
    unit: str
    limit: float | None
    limit_name: str


def measure(only: str, seconds: float, announce: Callable[[str], None]) -> Iterator[Result]:
    """Every speed whose name holds ``only``, one after the other, each measured for about so long.

    Args:
        announce: Told the name of what is measured next.

    Raises:
        UnknownName: No speed's name holds it.
    """
    works: dict[str, Callable[[], Result]] = {}
    for name in environment_names():
        works[f"record[{name}]"] = partial(recording, name, seconds)
    works["load_triplets"] = partial(loading, seconds)
    for name in model_names():
        for arch in model_class(name).architectures:
            works[f"train[{name}-{arch}]"] = partial(training, name, arch, None, seconds)
    if "dmotion" in model_names():
        works["train[dmotion-paper-reference]"] = partial(training, "dmotion", "paper", ORIGINAL, seconds)
    for name in model_names():
        works[f"plan[{name}]"] = partial(planning, name, seconds, together=True)
    if "dmotion" in model_names():
        works["plan[dmotion-one-by-one]"] = partial(planning, "dmotion", seconds, together=False)
    works["find_centres"] = partial(finding, seconds)
    chosen = {name: work for name, work in works.items() if only in name}
    if not chosen:
        raise UnknownName("speed", only, works)
    for name, work in chosen.items():
        announce(name)
        yield work()


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
        recipe = replace(recipe_for("grid_world", Preset.SMALL, tasks=0), episodes=100)
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


def training(name: str, arch: str, config: TrainingConfig | None, seconds: float) -> Result:
    """Triplets a second of a model's training step, on all cores; with its own training config unless one is given.

    In the precision that a training would choose.
    """
    kind = model_class(name)
    label = f"train[{name}-{arch}{'' if config is None else '-reference'}]"
    config = config or kind.training_defaults(Preset.SMALL, arch)
    device = torch.device("cpu")
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = kind(kind.configure(arch), ModelInputs(height=SIZE, width=SIZE, actions=4))
    if config.channels_last:
        model = model.to(memory_format=torch.channels_last)  # type: ignore[call-overload]
    optimizer = make_optimizer(model, config)
    phase = max(model.phases(), key=lambda phase: phase.fraction)
    model.enter(phase)
    model.train()
    batch = _noise(config.batch_size, kind.supervision is Supervision.ACTIONS)
    if not config.channels_last:
        batch = replace(batch, **{name: getattr(batch, name).contiguous() for name in ("previous", "current", "next")})

    step = Stepper(
        model=model,
        losses=model.losses,
        backward=torch.autograd.backward,
        optimizer=optimizer,
        clip_norm=config.clip_norm,
        seed=0,
        device=device,
    )
    precision = settled(config.precision, FEWEST_STEPS, device)
    precision = precision or timed(lambda precision: step(batch, 0, precision), device).faster
    with FlopCounterMode(display=False) as counter:
        step(batch, 0, precision)
    flops = counter.get_total_flops() / config.batch_size
    began, steps = time.perf_counter(), 0
    while steps == 0 or time.perf_counter() - began < seconds:
        step(batch, steps, precision)
        steps += 1
    value = steps * config.batch_size / (time.perf_counter() - began)
    return Result(
        name=label,
        value=value,
        unit="triplets/s",
        limit=machine.matrix_products(precision) / flops if flops else None,
        limit_name="matrix products alone, all cores",
    )


def planning(name: str, seconds: float, *, together: bool) -> Result:
    """Control steps a second of the paper's planner: as the control loop takes them, or candidate by candidate."""
    kind, images = model_class(name), _frames()
    with torch.random.fork_rng():
        torch.manual_seed(0)
        model = kind(kind.configure(kind.architectures[0]), ModelInputs(height=SIZE, width=SIZE, actions=4))
    model = model.to(memory_format=torch.channels_last).eval()  # type: ignore[call-overload]
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
    return environment_class("grid_world")().facts


def _frames() -> UInt8[np.ndarray, "n h w 3"]:
    """Some pictures of Grid World."""
    with tempfile.TemporaryDirectory(prefix="dmbench-") as folder:
        record_dataset(
            Path(folder) / "data", replace(recipe_for("grid_world", Preset.TINY, tasks=0), episodes=2, frames=32)
        )
        dataset = Dataset.open(Path(folder) / "data")
        return np.concatenate([dataset.video(episode) for episode in range(2)])


def _noise(size: int, labelled: bool) -> TripletBatch:
    frames = np.random.default_rng(0).integers(0, 256, (size, 3, SIZE, SIZE, 3), dtype=np.uint8)
    images = to_model(torch.from_numpy(frames))
    previous, current, following = (images[:, step].contiguous(memory_format=torch.channels_last) for step in range(3))
    action = torch.arange(size) % 4 if labelled else None
    episode = torch.arange(size) // 4
    return TripletBatch(previous=previous, current=current, next=following, action=action, episode=episode)
