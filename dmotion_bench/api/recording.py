"""Recording an environment into a data set."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path
from typing import SupportsIndex

from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.settings import LARGEST_SEED, Settings, as_preset, as_texts, whole
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.recording.preset import USUAL_RANGES, recipe_for
from dmotion_bench.recording.session import Progress as Done
from dmotion_bench.recording.session import Recorded, record_dataset, recording_folder
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.shard import shard_count
from dmotion_bench.workspace import AnyPath, Workspace, as_path, in_workspace


@in_workspace
def record(
    environment: str,
    preset: Preset | str = Preset.SMALL,
    *,
    episodes: SupportsIndex | None = None,
    frames: SupportsIndex | None = None,
    tasks: SupportsIndex | None = None,
    seed: SupportsIndex = 0,
    vary: Sequence[str] = (),
    ranges: str = USUAL_RANGES,
    policy: str | None = None,
    settings: Settings = None,
    size: SupportsIndex | None = None,
    frame_skip: SupportsIndex | None = None,
    out: AnyPath | None = None,
    workers: SupportsIndex = 1,
    executor: str = "local",
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Recorded:
    """Record a data set, go on with one that was interrupted, or extend one to more episodes.

    Args:
        environment: Its name, or ``gym:ID`` for any Gymnasium environment.
        preset: How much: ``"tiny"``, ``"small"`` or ``"paper"``.
        episodes, frames, tasks: Instead of the preset's: episodes, frames in each at most (3 or more), control tasks.
        seed: The same seed records the same bytes.
        vary: Names of factors that differ between episodes.
        ranges: What they are drawn from: ``"in-distribution"`` or ``"shifted"``.
        policy: Chooses the actions; the environment's own by default.
        settings: Parameters of the environment, such as ``{"objects": 3}``.
        size: Side of the frames [px], of ``gym:ID``.
        frame_skip: How often an action is taken between two frames, of ``gym:ID``.
        out: The data set's folder; ``data/ENVIRONMENT-PRESET`` of the workspace by default.
        workers: Number of processes; 1 is this one. More need ``if __name__ == "__main__":`` in a script. The bytes
            are the same for any number.
        executor: Where they run: ``"local"``, ``"ray"`` or ``"slurm"``.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how many episodes are done, or True for a bar.

    Returns:
        What was recorded; it can be given to every function that takes a data set.

    Raises:
        UnknownName, UsageError, InvalidSetting: A name or a value that is not allowed.
        RecipeMismatch: The folder holds another data set.
        RecordingFailed: The environment or the policy failed.

    Example:
        >>> recorded = dm.record("grid_world", "tiny", episodes=12, out="data/twelve")
        >>> recorded.episodes, recorded.frames
        (12, 144)
    """
    workers = whole("workers", workers, 1)
    recipe = recipe_for(
        environment,
        as_preset(preset),
        episodes=whole("episodes", episodes, 1),
        frames=whole("frames", frames, 3),
        tasks=whole("tasks", tasks, 0),
        seed=whole("seed", seed, 0, LARGEST_SEED),
        vary=[vary] if isinstance(vary, str) else vary,
        ranges=ranges,
        policy=policy,
        settings=as_texts(settings),
        size=whole("size", size, 16, 1024),
        frame_skip=whole("frame_skip", frame_skip, 1),
    )
    place = Workspace.current()
    folder = default_folder(recipe, as_preset(preset), place) if out is None else as_path("folder", out)
    return record_recipe(recipe, folder, executor_for(recipe, folder, executor, workers), progress)


def record_recipe(recipe: DatasetRecipe, folder: Path, executor: Executor, progress: Progress = None) -> Recorded:
    """Record a recipe into a folder; ``progress`` is told after each shard."""
    what = f"recording {recipe.environment}"
    with telling(progress) as tell:
        tell(JobProgress(what=what, done=0, total=None))

        def say(done: Done) -> None:
            status = f"{done.frames_per_s:.0f} frames/s"
            tell(JobProgress(what=what, done=done.episodes, total=done.total, status=status, unit="episodes"))

        return record_dataset(folder, recipe, executor, say)


def executor_for(recipe: DatasetRecipe, folder: Path, name: str, workers: int | None) -> Executor:
    """The executor of a name for a recording: never more processes than shards.

    Args:
        recipe, folder: What is recorded, and where to.
        name: ``local``, ``ray`` or ``slurm``.
        workers: How many at a time; None: as many as there are processors, or as the cluster decides.
    """
    if workers is None and name == "local":
        workers = available_workers()
    absolute = recording_folder(folder).absolute()
    return make_executor(
        name,
        min(workers, shard_count(recipe)) if workers else None,
        scratch=absolute.parent / f".{absolute.name}-jobs",
    )


def default_folder(recipe: DatasetRecipe, preset: Preset, workspace: Workspace) -> Path:
    """Where a recording goes if nobody names a folder: its name tells recordings under other conditions apart."""
    name = f"{recipe.environment}-{preset.value}{_suffix(recipe)}"
    return workspace.data / re.sub(r"[^\w.-]+", "-", name)


def _suffix(recipe: DatasetRecipe) -> str:
    scene, policy = recipe.parameters.get("scene", ""), environment_class(recipe.environment).default_policy
    parts = [str(scene), recipe.policy if recipe.policy != policy else ""]
    if recipe.vary:
        parts.append(str(recipe.parameters.get("ranges", "varied")))
    return "".join(f"-{part}" for part in parts if part)
