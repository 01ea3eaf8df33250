"""How fast this machine records, trains and plans: what the cost of a table is computed from.

Speeds are of one core, in CPU seconds, which other work on the machine does not lengthen much; or of a GPU, in seconds.
They are measured in a moment each, or taken from a file that ``dmbench bench --json`` wrote.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import torch

from dmotion_bench.benchmarks.comparison import read_stored
from dmotion_bench.benchmarks.planning_speed import PlanningTogether
from dmotion_bench.benchmarks.scene import scene_facts, scene_frames
from dmotion_bench.benchmarks.training_step import TrainingStep, untrained
from dmotion_bench.errors import DmbenchError
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.recording.speed import RecordedFrames
from dmotion_bench.registry import model_class
from dmotion_bench.reproduction.recording import Recording
from dmotion_bench.scoring.control import ControlScoring, score_control
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.temporary import temporary_folder

_IMAGES: Final = 8
_FEW_EPISODES, _FEW_STEPS = 10, 2  # of the data set that the oracle is timed on
Announce = Callable[[str], None]


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """How fast a world is recorded, and how long its episodes are."""

    frames_per_s: float
    frames: float


@dataclass
class Speeds:
    """Speeds by the names of worlds, models and references; each is measured when it is first asked for.

    Args:
        device: Where trainings and predictions run.
        announce: Told what is measured.
        stored: A file of ``dmbench bench --json`` that knows the speeds of models.

    Raises:
        UsageError: The file is something else.
    """

    device: torch.device
    announce: Announce = lambda _: None
    stored: Path | None = None
    _known: dict[tuple[str, ...], float] = field(default_factory=dict)
    _episodes: dict[str, Episodes] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.stored is None:
            return
        bench = read_stored(self.stored)
        for name, result in bench.results.items():
            cores = 1 if name.startswith("record[") else bench.threads  # one process records
            self._known[("stored", name)] = result.value / cores
        self.told = f"from {str(self.stored)!r} ({bench.processor}, {bench.threads} threads) where it has them"

    told: str = "measured here in a moment each, in CPU seconds of one core"

    def episodes(self, recording: Recording) -> Episodes:
        """Of a world: frames a second, and frames in an episode."""
        label = recording.world.label
        if label not in self._episodes:
            self.announce(f"recording {label}")
            with RecordedFrames(recording.world.environment, recording.recipe) as work:
                frames, seconds = _timed(work, time.process_time)
            shard = min(recording.recipe.shard_episodes, recording.recipe.episodes)
            stored = self._known.get(("stored", f"record[{recording.world.environment}]"))
            self._episodes[label] = Episodes(frames_per_s=stored or frames / seconds, frames=frames / shard)
        return self._episodes[label]

    def triplets_per_s(self, model: str, arch: str | None) -> float:
        """Of a training."""
        arch = arch or model_class(model).architectures[0]
        return self._of(f"train[{model}-{arch}]", lambda: self._training(model, arch))

    def control_steps_per_s(self, model: str) -> float:
        """Of a model's planning, one task at a time (``planning_speed.py`` says by which planner)."""
        return self._of(f"plan[{model}]", lambda: self._planning(model))

    def oracle_steps_per_s(self, recording: Recording, scoring: ControlScoring) -> float:
        """Control steps of the true simulator in a model's place; the first ones of a task, which take longest."""
        how = scoring.column or " ".join((scoring.planner, *scoring.planner_set))
        name = f"oracle[{recording.world.label}, {how}]"
        return self._of(name, lambda: self._oracle(recording, scoring))

    def _of(self, name: str, measured: Callable[[], float]) -> float:
        stored = None if self.device.type == "cuda" else self._known.get(("stored", name))
        if stored is not None:
            return stored
        if (name,) not in self._known:
            self.announce(name)
            with _one_thread():
                self._known[(name,)] = measured()
        return self._known[(name,)]

    def _training(self, model: str, arch: str) -> float:
        step = TrainingStep(model, arch, device=self.device)
        step()  # sets up what later ones use again
        _, seconds = _timed(lambda: _finished(step, self.device), _clock(self.device))
        return step.config.batch_size / seconds

    def _planning(self, model: str) -> float:
        network = untrained(model, model_class(model).architectures[0]).laid_out().eval()
        work = PlanningTogether(network, scene_facts(), scene_frames(_IMAGES), tasks=1, device=self.device)
        steps, seconds = _timed(work, _clock(self.device))
        return steps / seconds

    def _oracle(self, recording: Recording, scoring: ControlScoring) -> float:
        few = recording.few(_FEW_EPISODES)
        scoring = replace(scoring, tasks=1, steps=_FEW_STEPS)
        with temporary_folder() as folder:
            recorded = record_dataset(folder / "few", few)
            dataset = Dataset.open(recorded.dataset)
            if not dataset.tasks():
                raise DmbenchError(f"{_FEW_EPISODES} episodes of {recording.world.label} hold no control task.")
            began = time.process_time()
            score_control("oracle", dataset, scoring)  # not kept: this data set is gone in a moment
            return _FEW_STEPS / (time.process_time() - began)


def _finished(step: Callable[[], None], device: torch.device) -> float:
    step()
    if device.type == "cuda":
        torch.cuda.synchronize(device)
    return 1.0


def _clock(device: torch.device) -> Callable[[], float]:
    return time.perf_counter if device.type == "cuda" else time.process_time


def _timed(work: Callable[[], float], clock: Callable[[], float]) -> tuple[float, float]:
    began = clock()
    amount = work()
    return amount, max(clock() - began, 1e-9)


@contextmanager
def _one_thread() -> Iterator[None]:
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    try:
        yield
    finally:
        torch.set_num_threads(before)
