"""What tests of sharing ask of workspaces and places."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace


def weights(workspace: Workspace) -> str:
    return str((Run.open(workspace.runs / "known").result or {})["weights"])


def fingerprint(workspace: Workspace) -> str:
    return Dataset.open(workspace.data / "noise").fingerprint


def contents(folder: Path) -> dict[str, bytes]:
    return {one.relative_to(folder).as_posix(): one.read_bytes() for one in folder.rglob("*") if one.is_file()}


def nothing_in(workspace: Workspace) -> bool:
    """Whether no run and no data set has appeared, nor a file that is not what it should be."""
    there = [one.name for folder in (workspace.runs, workspace.data) for one in folder.glob("*")]
    return set(there) <= {".arriving"} and not workspace.all_runs() and not workspace.datasets()


def entry_of(workspace: Workspace, path: Path, **changes: Any) -> Path:
    samples = (workspace.runs / "known" / "report" / "samples.parquet").read_bytes()
    content = {
        "kind": "measured",
        "weights": weights(workspace),
        "samples": {"sha256": hashlib.sha256(samples).hexdigest()},
        "dataset": {"name": "noise", "fingerprint": fingerprint(workspace)},
    }
    path.write_text(json.dumps(content | changes))
    return path


class Faults:
    """Spoils the first few answers to a method, for paths with a part."""

    def __init__(self, kind: str, times: int, method: str, part: str) -> None:
        self.kind, self.left, self.method, self.part = kind, times, method, part

    def __call__(self, method: str, path: str) -> str | None:
        if method != self.method or self.part not in path.partition("?")[0] or not self.left:
            return None
        self.left -= 1
        return self.kind
