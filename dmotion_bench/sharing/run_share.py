"""What is published of a run, and the manifest of it.

::

    {"format": "dmbench-share/1", "run": "dmotion-grid_world-small-s0", "weights": "<sha256>", "model": "dmotion",
     "dataset": {"name": "grid_world-small", "fingerprint": "<sha256>"},
     "files": {"run.json": {"size": 1893, "sha256": "..."}, "best.safetensors": ..., "report/report.json": ...}}

The manifest may come from anybody. Which files a run can have is fixed here, so no path in it leads anywhere else.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import RunMissing
from dmotion_bench.learning.runs.checkpoint import LARGEST_WEIGHTS
from dmotion_bench.learning.runs.manifest import LARGEST_RUN
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.scoring.report import REPORT_FILE, REPORT_FOLDER, SAMPLES_FILE, TRANSFERS, settled
from dmotion_bench.scoring.transfer import transfer_folders
from dmotion_bench.sharing.place import HASH, plain_name
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.json_file import LARGEST, parse_json
from dmotion_bench.storage.shard import FileFacts, file_facts
from dmotion_bench.wording import shown
from dmotion_bench.workspace import RUN_MANIFEST

FORMAT: Final = "dmbench-share/1"
LARGEST_MANIFEST: Final = 2**20
"""Bytes of a manifest that are read."""
MOST_FILES: Final = 200
WEIGHTS: Final = "best.safetensors"
METRICS: Final = "metrics.jsonl"
_GIB: Final = 2**30
_LARGEST: Final[Mapping[str, int]] = {
    RUN_MANIFEST: LARGEST_RUN,
    WEIGHTS: LARGEST_WEIGHTS,
    METRICS: _GIB,
    REPORT_FILE: LARGEST,
    SAMPLES_FILE: 16 * _GIB,
}
"""Bytes that a file of this name can have."""
_COLUMNS: Final = "|".join(map(re.escape, COLUMNS))
_REPORT: Final = re.compile(
    rf"{REPORT_FOLDER}/(?:{TRANSFERS}/([^/]+)/(?:(?:{_COLUMNS})/)?)?(?:{REPORT_FILE}|{SAMPLES_FILE})"
)


@dataclass(frozen=True, kw_only=True)
class RunShare:
    """A run as it is published.

    Attributes:
        name: The run's.
        weights: Hash of its weights.
        model: Registry name.
        dataset, fingerprint: Of the training.
        files: Size and SHA-256 of each, by their paths in the run's folder.
    """

    name: str
    weights: str
    model: str
    dataset: str
    fingerprint: str
    files: Mapping[str, FileFacts]

    @property
    def samples(self) -> frozenset[str]:
        """SHA-256 of the samples of its reports; an entry names one of them."""
        return frozenset(facts.sha256 for name, facts in self.files.items() if name.endswith(f"/{SAMPLES_FILE}"))

    @property
    def size(self) -> int:
        """Of all files [bytes]."""
        return sum(facts.size for facts in self.files.values())

    def content(self) -> bytes:
        """The manifest as a file: the same run, the same bytes."""
        stored = {
            "format": FORMAT,
            "run": self.name,
            "weights": self.weights,
            "model": self.model,
            "dataset": {"name": self.dataset, "fingerprint": self.fingerprint},
            "files": {name: self.files[name]._asdict() for name in sorted(self.files)},
        }
        return (json.dumps(stored, indent=1, ensure_ascii=False) + "\n").encode()

    @property
    def digest(self) -> str:
        """SHA-256 of the manifest: its name."""
        return hashlib.sha256(self.content()).hexdigest()

    @classmethod
    def parse(cls, content: bytes) -> RunShare:
        """The manifest that stands in a file.

        Raises:
            ValueError: It is none; says why.
        """
        fields = Fields(parse_json(content, largest=LARGEST_MANIFEST), "it")
        if (found := fields.text("format")) != FORMAT:
            raise ValueError(f"its format is {shown(found)}, and this dmbench reads {FORMAT!r}")
        dataset, stored = fields.inner("dataset"), fields.inner("files")
        names = list(fields.pairs("files"))
        if len(names) > MOST_FILES:
            raise ValueError(f"it lists {len(names):,} files, and a run has at most {MOST_FILES}")
        share = cls(
            name=fields.text("run"),
            weights=fields.text("weights"),
            model=fields.text("model"),
            dataset=dataset.text("name"),
            fingerprint=dataset.text("fingerprint"),
            files={name: _checked(name, stored.inner(name)) for name in names},
        )
        for name in (share.name, share.dataset, share.model):
            if not plain_name(name):
                raise ValueError(f"it names something {shown(name)}, which can be no folder's name")
        for digest in (share.weights, share.fingerprint):
            if not HASH.fullmatch(digest):
                raise ValueError(f"{shown(digest)} is no SHA-256")
        for name in (RUN_MANIFEST, WEIGHTS):
            if name not in share.files:
                raise ValueError(f"it lists no {name}")
        return share


def _checked(path: str, fields: Fields) -> FileFacts:
    """A file's facts, if a run can have such a file."""
    found = _REPORT.fullmatch(path)
    if path not in (RUN_MANIFEST, WEIGHTS, METRICS) and (found is None or (found[1] and not plain_name(found[1]))):
        raise ValueError(f"it lists the file {shown(path)}, which no run has")
    facts = FileFacts(fields.whole("size"), fields.text("sha256"))
    largest = _LARGEST[path.rpartition("/")[2]]
    if not 0 <= facts.size <= largest:
        raise ValueError(f"it says that {shown(path)} has {facts.size:,} bytes; at most {largest:,} can be")
    if not HASH.fullmatch(facts.sha256):
        raise ValueError(f"it says that {shown(facts.sha256)} is the SHA-256 of {shown(path)}")
    return facts


def share_of(run: Run) -> RunShare:
    """What is to be published of a run: its weights are read and held against their hash.

    Raises:
        RunMissing: It is not trained to its end.
        RunCorrupt: Its weights are damaged.
    """
    result: Mapping[str, Any] | None = run.result
    if result is None:
        raise RunMissing(
            f"the run {str(run.path)!r} is not trained to its end, so there is nothing to publish; go on with the "
            "'dmbench train' command that began it."
        )
    run.weights()
    files = {path.relative_to(run.path): path for path in _files(run)}
    return RunShare(
        name=run.path.resolve().name,
        weights=result["weights"],
        model=run.spec.model,
        dataset=run.spec.dataset,
        fingerprint=run.spec.fingerprint,
        files={name.as_posix(): file_facts(path) for name, path in files.items()},
    )


def _files(run: Run) -> Iterator[Path]:
    yield run.path / RUN_MANIFEST
    yield run.best
    if run.metrics.is_file():
        yield run.metrics
    for folder in map(settled, (run.path / REPORT_FOLDER, *transfer_folders(run.path))):
        files = [folder / REPORT_FILE, folder / SAMPLES_FILE]
        if all(one.is_file() and _REPORT.fullmatch(one.relative_to(run.path).as_posix()) for one in files):
            yield from files
