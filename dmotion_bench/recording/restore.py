"""Repair of a data set in the way that loses least.

A shard is a function of the recipe, so a damaged one is recorded anew and put in its place if it has the very
bytes that ``dataset.json`` says it had. Where that cannot be done (an imported recording, an environment that is
not installed or draws differently now), the episodes that can still be read are salvaged.
"""

from __future__ import annotations

import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dmotion_bench.addresses import remote_address
from dmotion_bench.errors import PackageNotInstalled, RecordingFailed, UsageError
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.recording.policies import OWN
from dmotion_bench.recording.session import ShardJob, environment_facts, record_shard
from dmotion_bench.registry import is_environment
from dmotion_bench.storage.atomic import remove_leftovers, sync_folder
from dmotion_bench.storage.check import CheckReport, cache_damages, check_dataset
from dmotion_bench.storage.dataset import Dataset, corrupt
from dmotion_bench.storage.lock import held
from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.repair import Salvaged, rebuild_tables, salvage
from dmotion_bench.storage.shard import LABELS, VIDEO, shard_path
from dmotion_bench.wording import shown

_STAGING = "repairing"


@dataclass(frozen=True, kw_only=True)
class Repaired:
    """What a repair did.

    Attributes:
        how: ``"sound"``: there was nothing to do; ``"restored"``: all is as it was recorded, byte for byte;
            ``"salvaged"``: episodes were lost; ``"cache"``: nothing but the cache was damaged, which was deleted.
        shards: Those that were recorded anew.
        salvaged: What was kept and lost, if anything was lost.
    """

    how: Literal["sound", "restored", "salvaged", "cache"]
    shards: tuple[int, ...] = ()
    salvaged: Salvaged | None = None


def repair_dataset(
    path: Path,
    executor: Executor | None = None,
    on_progress: Callable[[int, int], None] = lambda _done, _total: None,
) -> Repaired:
    """Check a data set and mend what is damaged.

    Args:
        path: Its folder.
        executor: Who records shards anew; this process by default.
        on_progress: Called with the number of shards that are checked, and of all.

    Raises:
        UsageError: It is on object storage.
    """
    if (address := remote_address(path)) is not None:
        raise UsageError(
            f"{shown(address)} is on object storage, where nothing is mended; copy a sound data set there, or repair "
            "it in a folder and copy that."
        )
    report = check_dataset(path, on_progress)
    _remove_leftovers(path)
    lost = report.shards if report.labels != "missing" else tuple(range(len(report.manifest.shards)))
    if report.cache:
        _delete_cache(path)
    if not report.damages and not lost:
        return Repaired(how="sound")
    if lost and not _record_anew(report, lost, executor or SerialExecutor()):
        if report.cache or not report.damages:
            return Repaired(how="cache" if report.cache else "sound")
        return Repaired(how="salvaged", salvaged=salvage(path))
    if report.tables:
        try:
            rebuild_tables(path, report.manifest)
        except DamagedFile as damage:  # since it was checked
            raise corrupt(path, path, damage) from None
        deeper = repair_dataset(path, executor, on_progress)  # only now shards can be compared with what they hold
        if deeper.how == "salvaged":
            return deeper
        return Repaired(how="restored", shards=tuple(sorted({*lost, *deeper.shards})))
    if not report.cache and any(cache_damages(Dataset.open(path))):  # which shows only where all else is sound
        _delete_cache(path)
    return Repaired(how="cache" if report.cache and not lost else "restored", shards=lost)


def _remove_leftovers(path: Path) -> None:
    """Delete what a repair that was killed left in the data set, which may be sound by then."""
    with held(path):
        shutil.rmtree(path / _STAGING, ignore_errors=True)
        for folder in (path, path / VIDEO, path / LABELS):
            remove_leftovers(folder)


def _delete_cache(path: Path) -> None:
    """Delete the frame cache; the next use makes a new one."""
    cache = Dataset.open(path).cache_file.path
    if cache.is_dir() and not cache.is_symlink():
        shutil.rmtree(cache, ignore_errors=True)
    else:
        cache.unlink(missing_ok=True)


def _record_anew(report: CheckReport, shards: Sequence[int], executor: Executor) -> bool:
    """Replace shards by ones that the recipe makes, if those have the same bytes; all of them or none."""
    manifest, path = report.manifest, report.dataset
    if manifest.salvaged or not is_environment(manifest.recipe.environment) or OWN in manifest.recipe.policy:
        return False  # and nothing is imported because a file names it
    staging = path / _STAGING
    with held(path):
        shutil.rmtree(staging, ignore_errors=True)
        staging.mkdir()
        try:
            if environment_facts(manifest.recipe) != manifest.spec:
                return False
            jobs = [ShardJob(dataset=staging, recipe=manifest.recipe, spec=manifest.spec, index=one) for one in shards]
            for receipt in executor.map_unordered(record_shard, jobs):
                entry = manifest.shards[receipt.index]
                if (receipt.video, receipt.labels) != (entry.video, entry.labels):
                    return False
            for kind in (VIDEO, LABELS):
                (path / kind).mkdir(exist_ok=True)
                for index in shards:
                    shard_path(staging, kind, index).replace(shard_path(path, kind, index))
                sync_folder(path / kind)
        except (PackageNotInstalled, RecordingFailed, UsageError):  # the environment cannot be made here, or fails
            return False
        finally:
            shutil.rmtree(staging, ignore_errors=True)
    return True
