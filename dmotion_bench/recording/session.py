"""A complete recording: an executor makes the missing shards, one by one."""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from dmotion_bench.addresses import remote_address
from dmotion_bench.entry_points import ENVIRONMENTS, is_built_in, owners
from dmotion_bench.environment import Packaged, Unproven, Varied
from dmotion_bench.errors import (
    DatasetMissing,
    InvalidSetting,
    PackageNotInstalled,
    RecordingFailed,
    UnknownName,
    UsageError,
)
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.recording.failures import guarded
from dmotion_bench.recording.policies import find_policy
from dmotion_bench.recording.replay import replay_sample
from dmotion_bench.recording.rollout import make_environment, record_episodes
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, EnvSpec
from dmotion_bench.storage.lock import held
from dmotion_bench.storage.manifest import Manifest, Replay
from dmotion_bench.storage.remote_copy import RemoteCopy, copy_folder, upload
from dmotion_bench.storage.shard import ShardReceipt, shard_range, write_shard
from dmotion_bench.storage.writer import DatasetWriter, check_recipe, deleted
from dmotion_bench.versions import require_same
from dmotion_bench.workspace import DATASET_MANIFEST, AnyPath

SHARD_EPISODES = 20  # small enough that a killed recording of a slow environment loses seconds


@dataclass(frozen=True, kw_only=True)
class ShardJob:
    """One shard to be made; plain values, so that it can be sent anywhere.

    Attributes:
        dataset: The folder.
        recipe, spec: Of the data set.
        index: The shard's number.
        versions: Of packages, which the data set states; None: any will do.
    """

    dataset: Path
    recipe: DatasetRecipe
    spec: EnvSpec
    index: int
    versions: Mapping[str, str] | None = None


@dataclass(frozen=True, kw_only=True)
class Progress:
    """The progress of a recording.

    Attributes:
        episodes: Done of ``total``, with those of earlier runs.
        total: The target.
        frames: Made by this run.
        seconds: Since this run started to make them.
    """

    episodes: int
    total: int
    frames: int
    seconds: float

    @property
    def frames_per_s(self) -> float:
        """Of this run."""
        return self.frames / self.seconds if self.seconds else 0.0


@dataclass(frozen=True, kw_only=True)
class Recorded:
    """The result of a recording.

    Attributes:
        dataset: The folder, or the address.
        episodes, frames: Of the whole data set.
        bytes: Of all its shards.
        made: What this run did of it.
        replay: Whether the recording repeats; None where the environment is known to be exact.
    """

    dataset: Path | str
    episodes: int
    frames: int
    bytes: int
    made: Progress
    replay: Replay | None = None

    def __fspath__(self) -> str:
        """The data set's folder: what was recorded may stand wherever a path may."""
        return str(self.dataset)

    @property
    def bytes_per_frame(self) -> float:
        """Video and labels together."""
        return self.bytes / self.frames


def record_shard(job: ShardJob) -> ShardReceipt:
    """Make one shard in the present process.

    Raises:
        DatasetError: This machine has other versions of packages than the data set states. Or the data set's folder is
            not there any more; it is not made again, as what it held is lost.
    """
    require_same(job.versions or {})
    kind = environment_class(job.recipe.environment)
    episodes = record_episodes(kind, job.recipe, shard_range(job.recipe, job.index))
    with contextlib.closing(episodes):
        try:
            if job.dataset.is_dir():
                return write_shard(job.dataset, job.recipe, job.spec, job.index, episodes)
        except FileNotFoundError:
            if job.dataset.is_dir():
                raise
    raise deleted(job.dataset)


def environment_facts(recipe: DatasetRecipe) -> EnvSpec:
    """What is true of the recipe's environment; its parameters and policy are checked on the way.

    Raises:
        UnknownName: There is no such environment or policy.
        InvalidSetting: The environment does not take these parameters.
    """
    kind = environment_class(recipe.environment)
    find_policy(kind, recipe)
    env = make_environment(kind, recipe)
    try:
        if recipe.vary:
            _require_factors(kind, recipe)
            with guarded(repr(recipe.environment), "'reset'", lambda: "with the seed 0 and the factors that vary"):
                env.reset(seed=0, options={"vary": list(recipe.vary)})
        return env.facts
    finally:
        env.close()


def _require_factors(kind: object, recipe: DatasetRecipe) -> None:
    """See that what is to vary can: an environment that knows no factors would take no notice."""
    if not isinstance(kind, Varied):
        raise InvalidSetting(f"dmbench varies nothing in {recipe.environment!r}; leave out '--vary', or use '--set'.")
    for name in recipe.vary:
        if name not in kind.factors:
            raise UnknownName("factor of variation", name, kind.factors)


def record_dataset(
    path: AnyPath,
    recipe: DatasetRecipe,
    executor: Executor | None = None,
    on_progress: Callable[[Progress], None] = lambda _: None,
) -> Recorded:
    """Record a data set, complete one that was interrupted, or extend one to more episodes.

    At an address of object storage a data set appears as a whole: it is recorded into a folder of this machine
    (``recording_folder``) and put there, its ``dataset.json`` last.

    Args:
        path: The data set's folder, or its address.
        recipe: What to record.
        executor: Who makes the shards; this process by default.
        on_progress: Called at the start and after each shard.

    Raises:
        RecordingFailed: The environment or the policy failed; says what is kept.
        PackageNotInstalled: One that the environment needs is not there.
        UsageError: The environment cannot be recorded so, or the folder holds something else.
        RecipeMismatch: The folder holds a data set of another recipe.
        DatasetError: A machine that makes shards has other versions of packages than this one.
        FolderInUse: Another process records into the folder.
    """
    if (address := remote_address(path)) is not None:
        return _record_elsewhere(address, recipe, executor, on_progress)
    path, spec, executor = Path(path), environment_facts(recipe), executor or SerialExecutor()
    kind: object = environment_class(recipe.environment)
    packages = (
        *(kind.packages if isinstance(kind, Packaged) else ()),
        *sorted(owners(ENVIRONMENTS, recipe.environment)),
    )
    with DatasetWriter.create_or_resume(path, recipe, spec, packages) as writer:
        try:
            progress = _record_missing(writer, executor, on_progress)
            replay = None if writer.complete is None else writer.complete.replay
            if writer.complete is None and _is_unproven(recipe.environment):
                replay = replay_sample(writer, executor)
        except (RecordingFailed, PackageNotInstalled, UsageError) as error:
            error.add(writer.withdraw())
            raise
        writer.finish(replay=replay)
        return Recorded(
            dataset=path,
            episodes=recipe.episodes,
            frames=writer.frames,
            bytes=writer.bytes,
            made=progress,
            replay=replay,
        )


def recording_folder(path: AnyPath) -> Path:
    """Where a data set is recorded: its own folder, or where it waits to be put at an address."""
    address = remote_address(path)
    return Path(path) if address is None else copy_folder(address, "-recording")


def _is_unproven(environment: str) -> bool:
    """Whether a sample of an environment's episodes is recorded again."""
    kind: object = environment_class(environment)
    return kind.unproven if isinstance(kind, Unproven) else not is_built_in(ENVIRONMENTS, environment)


def _record_elsewhere(
    address: str, recipe: DatasetRecipe, executor: Executor | None, on_progress: Callable[[Progress], None]
) -> Recorded:
    """Record a data set and put it at an address, or extend the one that is there.

    One process of this machine at a time: another one would begin in the folder that this one puts there and deletes.
    """
    turn = copy_folder(address, "-recorder")
    turn.mkdir(parents=True, exist_ok=True)
    with held(turn):
        return _put_there(address, recipe, executor, on_progress)


def _put_there(
    address: str, recipe: DatasetRecipe, executor: Executor | None, on_progress: Callable[[Progress], None]
) -> Recorded:
    folder, spec, remote = recording_folder(address), environment_facts(recipe), RemoteCopy(address)
    standing = None
    with contextlib.suppress(DatasetMissing):
        standing = remote.refresh()
    if standing is not None:
        check_recipe(standing, recipe, spec, address)
        if standing.recipe == recipe:
            remote.require_whole(standing)
            return _standing(address, standing)
        if not (folder / DATASET_MANIFEST).is_file():
            folder.mkdir(parents=True, exist_ok=True)
            remote.fetch_all(standing, folder)
    recorded = record_dataset(folder, recipe, executor, on_progress)
    upload(folder, address)
    shutil.rmtree(folder)
    return replace(recorded, dataset=address)


def _standing(address: str, manifest: Manifest) -> Recorded:
    """What is told of a data set that is complete already."""
    files = [file for shard in manifest.shards for file in (shard.video, shard.labels) if file is not None]
    episodes = manifest.recipe.episodes
    return Recorded(
        dataset=address,
        episodes=episodes,
        frames=sum(shard.frames for shard in manifest.shards),
        bytes=sum(file.size for file in files),
        made=Progress(episodes=episodes, total=episodes, frames=0, seconds=0.0),
        replay=manifest.replay,
    )


def _record_missing(writer: DatasetWriter, executor: Executor, on_progress: Callable[[Progress], None]) -> Progress:
    """Make the shards that are not there."""
    recipe, start, frames = writer.recipe, time.perf_counter(), 0
    episodes = recipe.episodes - sum(len(writer.episodes_of(index)) for index in writer.missing)
    progress = Progress(episodes=episodes, total=recipe.episodes, frames=0, seconds=0.0)
    on_progress(progress)
    jobs = [
        ShardJob(dataset=writer.path.absolute(), recipe=recipe, spec=writer.spec, index=index, versions=writer.versions)
        for index in writer.missing
    ]
    for receipt in executor.map_unordered(record_shard, jobs):
        writer.add(receipt)
        frames += receipt.frames
        episodes += len(receipt.rows)
        progress = Progress(
            episodes=episodes, total=recipe.episodes, frames=frames, seconds=time.perf_counter() - start
        )
        on_progress(progress)
    return progress
