"""Whether a recording repeats: a sample of its episodes is recorded again, in fresh environments, and compared.

Everything that dmbench keeps of a state is a seed and actions, so an environment that does not repeat can have no
control tasks, and its data set cannot be recorded again. An executor with processes makes each episode in one that has
not recorded before.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from dmotion_bench.execution.executor import Executor
from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, EnvSpec
from dmotion_bench.storage.manifest import Replay
from dmotion_bench.storage.shard import LABELS, VIDEO, EpisodeRow, read_states, read_video, shard_path
from dmotion_bench.storage.writer import DatasetWriter

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


def replay_episode(job: ReplayJob) -> tuple[int, str]:
    """The number of an episode, and how it differs when it is recorded again; empty if it does not."""
    row, recipe = job.row, job.recipe
    frames = read_video(shard_path(job.dataset, VIDEO, row.shard), row.video, job.spec, row.frames)
    actions = read_states(shard_path(job.dataset, LABELS, row.shard), row.states, job.spec, row.frames).actions
    (again,) = record_episodes(environment_class(recipe.environment), recipe, [row.episode])
    together = min(len(frames), len(again.frames))
    same_frames = (frames[:together] == again.frames[:together]).reshape(together, -1).all(axis=1)
    for step in range(together):
        if not same_frames[step]:
            return row.episode, f"frame {step} of episode {row.episode}"
        if step < together - 1 and not np.array_equal(actions[step], again.labels.actions[step]):
            return row.episode, f"action {step} of episode {row.episode}, which the policy chose,"
    longer = len(frames) != len(again.frames)
    return row.episode, f"the length of episode {row.episode}" if longer else ""
