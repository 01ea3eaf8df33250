"""Everything once, small: record, train on video alone, score, and write what the model imagines."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, SupportsIndex

from dmotion_bench.api.progress import Progress
from dmotion_bench.api.recording import executor_for, record_recipe
from dmotion_bench.api.scoring import score_runs
from dmotion_bench.api.settings import LARGEST_SEED, whole
from dmotion_bench.api.training import begin, complete
from dmotion_bench.api.viewing import scene_of
from dmotion_bench.learning.runs.start import TrainingRequest
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.scoring.report import Report
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.scene import write_scene
from dmotion_bench.viewing.target import find_target
from dmotion_bench.workspace import AnyPath, Workspace, as_path

ENVIRONMENT = "grid_world"
MODEL = "dmotion"
EPISODES = 200
EPOCHS = 5
BATCH_SIZE = 16
"""Half the usual one: a smaller error after the same number of triplets (docs/experiments/small-batches.md)."""

VALIDATIONS = 3
"""A third of the usual number; with a rate that falls to zero the last weights are the best ones anyway."""


@dataclass(frozen=True, kw_only=True)
class Demonstrated:
    """What a demonstration left behind.

    Attributes:
        dataset, run, recording: The folders, and the Rerun file.
        seconds: That it took [s].
        report: Of the run.
    """

    dataset: Path
    run: Path
    recording: Path
    seconds: float
    report: Report

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench demo --json`` prints."""
        return {
            "dataset": str(self.dataset),
            "run": str(self.run),
            "recording": str(self.recording),
            "seconds": round(self.seconds, 1),
            "reports": [self.report.summary() | {"run": str(self.run)}],
        }


def demo(
    out: AnyPath = "demo",
    *,
    seed: SupportsIndex = 0,
    workers: SupportsIndex | None = 1,
    say: Callable[[str], None] = lambda _: None,
    note: Callable[[str], None] = lambda _: None,
    progress: Progress = None,
) -> Demonstrated:
    """Record a small data set, train a model on its video, score it, and write a Rerun file.

    Args:
        out: The folder to write everything to; it becomes a workspace.
        seed: Of the recording and the training.
        workers: Processes that record; None for as many as there are processors.
        say: Told in a line what happens.
        note: Told in a sentence what is worth knowing beside.
        progress: A function that is told how far each part is, or True for a bar.

    Raises:
        UsageError: A number is none, or out of its bounds.
    """
    seed, workers = whole("seed", seed, 0, LARGEST_SEED), whole("workers", workers, 1)
    began, workspace = time.monotonic(), Workspace(as_path("folder", out))
    say(f"1/4 recording {EPISODES} episodes of {ENVIRONMENT}")
    recipe = recipe_for(ENVIRONMENT, Preset.SMALL, episodes=EPISODES, tasks=0, seed=seed)
    folder = workspace.data / f"{ENVIRONMENT}-demo"
    recorded = record_recipe(recipe, folder, executor_for(recipe, folder, "local", workers), progress)
    say(f"    {recorded.frames} frames in {folder}")

    dataset = Dataset.open(folder)
    settings = f"epochs={EPOCHS}", f"batch_size={BATCH_SIZE}", f"validations={VALIDATIONS}"
    request = TrainingRequest(model=MODEL, seed=seed, settings=settings)
    run = begin(request, dataset, workspace, workspace.runs / f"{MODEL}-demo")
    say(f"2/4 training {MODEL} on the video, without a single action label")
    result = complete(run, dataset, progress=progress, note=note, warn=note)
    say(f"    {result['triplets']} triplets in {result['seconds']:.0f} s, {result['triplets_per_s']:.0f} triplets/s")
    say(f"    then {result['labels_total']} labels: one demonstration of each action")

    say("3/4 scoring it on episodes that it has not seen")
    reports, _ = score_runs([run.path], ("prediction", "rollout"), ScoreSettings(), progress=progress, note=note)

    say("4/4 writing what it imagines for Rerun")
    recording = workspace.root / "demo.rrd"
    write_scene(scene_of(find_target(run.path, workspace), [], None), recording)
    return Demonstrated(
        dataset=folder,
        run=run.path,
        recording=recording,
        seconds=time.monotonic() - began,
        report=reports[run.path],
    )
