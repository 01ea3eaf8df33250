"""The facts of a complete or unfinished data set for ``dmbench data info``."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Int

from dmotion_bench.actions import actions_to_json
from dmotion_bench.addresses import remote_address
from dmotion_bench.storage.check import labels_state
from dmotion_bench.storage.dataset import corrupt
from dmotion_bench.storage.frame_cache import cache_name
from dmotion_bench.storage.manifest import FORMAT, Manifest, record_words
from dmotion_bench.storage.mcap_reader import DamagedFile
from dmotion_bench.storage.remote_copy import RemoteCopy
from dmotion_bench.storage.shard import LABELS, VIDEO
from dmotion_bench.storage.split import split_episodes
from dmotion_bench.storage.tables import EPISODES, read_episodes
from dmotion_bench.workspace import cache_folder


def summarize(path: Path) -> dict[str, Any]:
    """The figures of a data set in a folder or at an address, as plain values.

    Raises:
        DatasetMissing, DatasetVersionUnknown, DatasetCorrupt: ``dataset.json`` cannot be read, or a table that is
            needed.
        PlaceUnreachable: The storage does not answer.
    """
    remote = None if (address := remote_address(path)) is None else RemoteCopy(address)
    manifest = Manifest.read(path) if remote is None else remote.refresh()
    folder = path if remote is None else remote.folder
    recipe, spec = manifest.recipe, manifest.spec
    summary: dict[str, Any] = {
        "dataset": address or str(path),
        "format": FORMAT,
        "complete": manifest.complete,
        "salvaged": manifest.salvaged,
        "environment": recipe.environment,
        "recipe": dataclasses.asdict(recipe),
        "frame": {"height": spec.height, "width": spec.width, "step_ns": spec.step_ns},
        "actions": actions_to_json(spec.actions),
        "objects": [one.name for one in spec.objects],
        "episodes": recipe.episodes,
        "video_bytes": _size(path / VIDEO) if remote is None else sum(remote.sizes(VIDEO).values()),
        "labels_bytes": _size(path / LABELS) if remote is None else sum(remote.sizes(LABELS).values()),
        "cache_bytes": _size(cache_folder(folder), cache_name(manifest.fingerprint)),
        "versions": dict(manifest.versions),
    }
    if not manifest.complete:
        summary["shards_done"] = len(list((path / VIDEO).glob("*.mcap")))
        summary["go_on_with"] = shlex.join(record_words(recipe, path))
        return summary
    split = split_episodes(recipe.seed, recipe.episodes, _sources(path, manifest, remote))
    return summary | {
        "frames": sum(shard.frames for shard in manifest.shards),
        "shards": len(manifest.shards),
        "labels": labels_state(path, manifest, remote),
        "split": {name: len(members) for name, members in split.items()},
        "fingerprint": manifest.fingerprint,
    }


def _sources(path: Path, manifest: Manifest, remote: RemoteCopy | None) -> Int[np.ndarray, " e"] | None:
    """The recordings that the episodes are parts of, where the split is by them."""
    if not manifest.recipe.splits_by_source:
        return None
    if remote is not None:
        remote.fetch_tables(manifest)
    folder = path if remote is None else remote.folder
    try:
        return read_episodes(folder, manifest).sources
    except DamagedFile as damage:
        raise corrupt(path, folder / EPISODES, damage) if remote is None else remote.damaged(EPISODES, damage) from None


def _size(folder: Path, pattern: str = "*") -> int:
    return sum(file.stat().st_size for file in folder.glob(pattern) if file.is_file())
