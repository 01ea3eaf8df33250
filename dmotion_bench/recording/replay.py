"""Whether a recording repeats: a sample of its episodes is recorded again, in fresh environments, and compared.

Everything that dmbench keeps of a state is a seed and actions, so an environment that does not repeat can have no
control tasks, and its data set cannot be recorded again. An executor with processes makes each episode in one that has
not recorded before.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Final, TypeVar

import numpy as np
from jaxtyping import Bool

from dmotion_bench.execution.executor import Executor
from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, EnvSpec, ObjectStates
from dmotion_bench.storage.dataset import corrupt
from dmotion_bench.storage.manifest import Replay
from dmotion_bench.storage.mcap_reader import DamagedFile, read_messages
from dmotion_bench.storage.messages import chunk_limit, decode_masks
from dmotion_bench.storage.shard import LABELS, VIDEO, EpisodeRow, read_states, read_video, shard_path
from dmotion_bench.storage.writer import DatasetWriter

_T = TypeVar("_T")

SAMPLE: Final = 3
"""Episodes that are recorded again: the first, the middle one, the last."""


@dataclass(frozen=True, kw_only=True)
class ReplayJob:
    """One episode to be recorded again; plain values, so that it can be sent anywhere."""

    dataset: Path
    recipe: DatasetRecipe
    spec: EnvSpec
    row: EpisodeRow


def replay_sample(writer: DatasetWriter, executor: Executor) -> Replay:
    """Record a sample of a data set's episodes again; every shard must be there."""
    episodes = np.unique(np.linspace(0, writer.recipe.episodes - 1, SAMPLE).round().astype(int)).tolist()
    jobs = [
        ReplayJob(dataset=writer.path.absolute(), recipe=writer.recipe, spec=writer.spec, row=writer.row(episode))
        for episode in episodes
    ]
    differences = dict(executor.map_unordered(replay_episode, jobs))
    differs = next((differences[episode] for episode in episodes if differences[episode]), "")
    return Replay(episodes=tuple(episodes), differs=differs)


def _read(job: ReplayJob, kind: str, read: Callable[[Path], _T]) -> _T:
    file = shard_path(job.dataset, kind, job.row.shard)
    try:
        return read(file)
    except DamagedFile as damage:
        raise corrupt(job.dataset, file, damage) from None


def replay_episode(job: ReplayJob) -> tuple[int, str]:
    """The number of an episode, and how it differs when it is recorded again; empty if it does not.

    Raises:
        DatasetCorrupt: What was recorded cannot be read any more.
    """
    row, recipe = job.row, job.recipe
    frames = _read(job, VIDEO, lambda file: read_video(file, row.video, job.spec, row.frames))
    states = _read(job, LABELS, lambda file: read_states(file, row.states, job.spec, row.frames))
    masks, limit = np.empty(frames.shape[:3], np.uint8), chunk_limit(job.spec)
    _read(job, LABELS, lambda file: decode_masks(read_messages(file, row.masks, chunk_limit=limit), masks))
    (again,) = record_episodes(environment_class(recipe.environment), recipe, [row.episode])
    whose, together = f"episode {row.episode}", min(len(frames), len(again.frames))
    same_frames, same_masks = (
        (one[:together] == other[:together]).reshape(together, -1).all(axis=1)
        for one, other in ((frames, again.frames), (masks, again.labels.masks))
    )
    same_states = _alike(states.agent, again.labels.agent, together)
    same_states &= _alike(states.objects, again.labels.objects, together)
    for step in range(together):
        if not same_frames[step]:
            return row.episode, f"frame {step} of {whose}"
        if not same_states[step]:
            return row.episode, f"what the environment tells of its state at frame {step} of {whose}"
        if not same_masks[step]:
            return row.episode, f"the mask of frame {step} of {whose}"
        if step < together - 1 and not np.array_equal(states.actions[step], again.labels.actions[step]):
            return row.episode, f"action {step} of {whose}, which the policy chose,"
    if len(frames) != len(again.frames):
        return row.episode, f"the length of {whose}"
    return row.episode, "" if states.factors == again.labels.factors else f"a factor of {whose}"


def _alike(stored: ObjectStates, again: ObjectStates, count: int) -> Bool[np.ndarray, " t"]:
    """At which of the first moments all things are told to be the same, bit by bit but for NaN."""
    same = np.ones(count, np.bool_)
    for one in fields(ObjectStates):
        before, now = (np.asarray(getattr(states, one.name), np.float64)[:count] for states in (stored, again))
        same &= ((before == now) | (np.isnan(before) & np.isnan(now))).reshape(count, -1).all(axis=1)
    return same
