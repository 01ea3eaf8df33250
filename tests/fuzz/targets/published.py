"""A published run and its data set in the folder of a case: where their files are, and how a forger makes all fit."""

from __future__ import annotations

import hashlib
import json
import re
from dataclasses import dataclass, field
from pathlib import Path

from dmotion_bench.learning.runs import checkpoint
from tests.fuzz.targets.dataset import fingerprint_of
from tests.fuzz.targets.dataset import forge as forge_dataset

RUN, DATA = "fuzz-small-s0", "noise-tiny"
ENTRIES = "reports/leaderboard/entries"


@dataclass
class SpoiltPlace:
    """A place, and a workspace that holds what was published there.

    Attributes:
        root: The folder of the place, the workspace, and what lies beside them.
        weights, fingerprint: What the run and the data set are found by, once what was spoilt is forged.
        files: The files of the run in the place, by their names in the run's folder.
        changed: The names of the files that were spoilt.
        entry_spoilt: Whether the entry was.
    """

    root: Path
    weights: str
    fingerprint: str
    files: dict[str, Path]
    changed: set[str] = field(default_factory=set)
    entry_spoilt: bool = False

    @property
    def place(self) -> Path:
        """Where it is published."""
        return self.root / "place"

    @property
    def entry(self) -> Path:
        """The entry that names the run and the data set."""
        return next((self.root / "workspace" / ENTRIES).glob(f"{RUN}*.json"))

    @property
    def run(self) -> Path:
        """The run's folder in the place."""
        return self.place / "runs" / self.weights

    @property
    def dataset(self) -> Path:
        """The data set's folder in the place."""
        return self.place / "datasets" / self.fingerprint / DATA

    @property
    def manifest(self) -> Path:
        """What is published of the run."""
        return next(self.run.glob("*.json"))


def forge(spoilt: SpoiltPlace, *, everything: bool) -> None:
    """Give each file of the place the name and the facts that fit its bytes.

    With ``everything`` the run is found by the hash of its spoilt weights, and the data set by its new fingerprint;
    the entry names them.
    """
    forge_dataset(spoilt.dataset)
    if everything:
        _forge_weights(spoilt)
        _forge_fingerprint(spoilt)
    manifest = spoilt.manifest
    content = manifest.read_bytes()
    for name, path in spoilt.files.items():
        data = path.read_bytes()
        digest = hashlib.sha256(data).hexdigest()
        if digest == path.name:
            continue
        facts = re.compile(rb'"size": \d+(,\s*"sha256": )"%s"' % path.name.encode())
        content = facts.sub(rb'"size": %d\1"%s"' % (len(data), digest.encode()), content)
        spoilt.files[name] = path.rename(path.with_name(digest))
    manifest.unlink()
    (manifest.parent / f"{hashlib.sha256(content).hexdigest()}.json").write_bytes(content)


def _forge_weights(spoilt: SpoiltPlace) -> None:
    """The run's and its samples' hashes, wherever they are named."""
    try:
        tensors, _ = checkpoint.load(spoilt.files["best.safetensors"])
        weights = checkpoint.weights_hash(checkpoint.without_prefix("model", tensors))
    except Exception:  # forged as far as it goes
        weights = spoilt.weights
    samples = spoilt.files["report/samples.parquet"]
    hashes = {spoilt.weights: weights, samples.name: hashlib.sha256(samples.read_bytes()).hexdigest()}
    named = [spoilt.files[name] for name in ("run.json", "report/report.json")]
    _replace((*named, spoilt.entry), hashes)
    _replace((spoilt.manifest,), {spoilt.weights: weights})
    moved = spoilt.run.rename(spoilt.run.with_name(weights))
    spoilt.weights, spoilt.files = weights, {name: moved / "files" / path.name for name, path in spoilt.files.items()}


def _forge_fingerprint(spoilt: SpoiltPlace) -> None:
    """The data set's, wherever it is named."""
    try:
        fingerprint = fingerprint_of(json.loads((spoilt.dataset / "dataset.json").read_bytes()))
    except Exception:  # forged as far as it goes
        return
    _replace((spoilt.entry, spoilt.manifest, spoilt.files["run.json"]), {spoilt.fingerprint: fingerprint})
    (spoilt.place / "datasets" / spoilt.fingerprint).rename(spoilt.place / "datasets" / fingerprint)
    spoilt.fingerprint = fingerprint


def _replace(files: tuple[Path, ...], hashes: dict[str, str]) -> None:
    for file in files:
        data = file.read_bytes()
        for before, after in hashes.items():
            data = data.replace(before.encode(), after.encode())
        file.write_bytes(data)
