"""What a command leaves behind, in a form in which two outcomes can be compared: bytes, weights, figures."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import safetensors.torch

from dmotion_bench.learning.runs import checkpoint

TIMES = ("seconds", "triplets_per_s", "planning_seconds")
"""What differs from run to run: how long it took."""

Content = dict[str, Any]


def listing(workspace: Path) -> list[str]:
    """Every file and folder, by its name: what a kill leaves behind shows here."""
    return sorted(str(path.relative_to(workspace)) for path in workspace.rglob("*"))


def files(workspace: Path, *folders: str) -> Content:
    """The hash of every file of some folders."""
    found = (path for folder in folders for path in sorted((workspace / folder).rglob("*")) if path.is_file())
    return {str(path.relative_to(workspace)): hashlib.sha256(path.read_bytes()).hexdigest() for path in found}


def training(workspace: Path, run: str) -> Content:
    """Of a run: what was asked, the result, the curves, and every tensor of its checkpoints; no times."""
    folder = workspace / "runs" / run
    manifest = json.loads((folder / "run.json").read_text())
    rows = [json.loads(line) for line in (folder / "metrics.jsonl").read_text().splitlines()]
    tensors = {
        path.name: checkpoint.weights_hash(safetensors.torch.load_file(path)) for path in folder.glob("*.safetensors")
    }
    return {"spec": manifest["spec"], "result": timeless(manifest["result"]), "rows": timeless(rows)} | tensors


def report(workspace: Path, run: str) -> Content:
    """Of a scored run: its figures and the bytes of its samples."""
    folder = workspace / "runs" / run / "report"
    return {
        "report": timeless(json.loads((folder / "report.json").read_text())),
        "samples": hashlib.sha256((folder / "samples.parquet").read_bytes()).hexdigest(),
    }


def timeless(value: Any) -> Any:
    """JSON without what says how long something took."""
    if isinstance(value, dict):
        return {key: timeless(one) for key, one in value.items() if key not in TIMES}
    return [timeless(one) for one in value] if isinstance(value, list) else value
