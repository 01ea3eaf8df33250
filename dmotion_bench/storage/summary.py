"""The facts of a complete or unfinished data set for ``dmbench data info``."""

from __future__ import annotations

import dataclasses
import shlex
from pathlib import Path
from typing import Any

from dmotion_bench.actions import actions_to_json
from dmotion_bench.storage.check import labels_state
from dmotion_bench.storage.frame_cache import cache_name
from dmotion_bench.storage.manifest import FORMAT, Manifest, record_words
from dmotion_bench.storage.shard import LABELS, VIDEO
from dmotion_bench.storage.split import split_episodes
from dmotion_bench.workspace import cache_folder


def summarize(path: Path) -> dict[str, Any]:
    """The figures of a data set, as plain values.

    Raises:
        DatasetMissing, DatasetVersionUnknown, DatasetCorrupt: ``dataset.json`` cannot be read.
    """
    manifest = Manifest.read(path)
    recipe, spec = manifest.recipe, manifest.spec
    summary: dict[str, Any] = {
        "dataset": str(path),
        "format": FORMAT,
        "complete": manifest.complete,
        "salvaged": manifest.salvaged,
        "environment": recipe.environment,
        "recipe": dataclasses.asdict(recipe),
        "frame": {"height": spec.height, "width": spec.width, "step_ns": spec.step_ns},
        "actions": actions_to_json(spec.actions),
        "objects": [one.name for one in spec.objects],
        "episodes": recipe.episodes,
        "video_bytes": _size(path / VIDEO),
        "labels_bytes": _size(path / LABELS),
        "cache_bytes": _size(cache_folder(path), cache_name(manifest.fingerprint)),
        "versions": dict(manifest.versions),
    }
    if not manifest.complete:
        summary["shards_done"] = len(list((path / VIDEO).glob("*.mcap")))
        summary["go_on_with"] = shlex.join(record_words(recipe, path))
        return summary
    split = split_episodes(recipe.seed, recipe.episodes)
    return summary | {
        "frames": sum(shard.frames for shard in manifest.shards),
        "shards": len(manifest.shards),
        "labels": labels_state(path, manifest),
        "split": {name: len(members) for name, members in split.items()},
        "fingerprint": manifest.fingerprint,
    }


def _size(folder: Path, pattern: str = "*") -> int:
    return sum(file.stat().st_size for file in folder.glob(pattern) if file.is_file())
