"""Samples that several runs have in common, so that they are computed once.

Those of the references depend on the data alone: they are kept in the data set's cache, for all of its runs. Such a
file is used only if it says that it is of the same data, settings and version, and if its bytes are those that were
written; anything else is computed again.

Those of latent actions (``latent_samples.py``) depend on what a model learned from video: they are kept in memory, for
the other label budgets of that training. On disk nothing would say whether the code of a model is still the same.
"""

from __future__ import annotations

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import torch

from dmotion_bench.errors import RunCorrupt
from dmotion_bench.scoring.report import SCORING_VERSION
from dmotion_bench.scoring.samples import read_samples, write_samples
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.json_file import JsonUnreadable, read_json
from dmotion_bench.storage.shard import file_facts

FORMAT: Final = 1
_LATEST: Final = 4  # trainings whose latent actions are remembered, of some 20 MB at the paper's scale


class SharedSamples:
    """Samples by what decides them.

    Args:
        on_disk: Whether the cache is read and written.
    """

    def __init__(self, *, on_disk: bool = True) -> None:
        self._on_disk = on_disk
        self._known: dict[str, pa.Table] = {}
        self._latest: OrderedDict[str, pa.Table] = OrderedDict()

    def get(self, key: Mapping[str, Any], score: Callable[[], pa.Table], folder: Path | None = None) -> pa.Table:
        """The samples of references that a key decides; computed by ``score`` if nobody has done so yet.

        Args:
            key: What decides them, as JSON's types.
            score: Computes them.
            folder: Where they are kept; None: only in memory.
        """
        full = dict(key) | {"version": SCORING_VERSION, "torch": torch.__version__}
        name = _name(full)
        if name not in self._known:
            place = folder if self._on_disk else None
            found = None if place is None else _kept(place, name, full)
            self._known[name] = score() if found is None else found
            if found is None and place is not None:
                _keep(place, name, full, self._known[name])
        return self._known[name]

    def latest(self, key: Mapping[str, Any], score: Callable[[], pa.Table]) -> pa.Table:
        """The samples of latent actions that a key decides; those of a few trainings are remembered.

        Args:
            key, score: As ``get`` takes them.
        """
        name = _name(key)
        if name not in self._latest:
            self._latest[name] = score()
        self._latest.move_to_end(name)
        while len(self._latest) > _LATEST:
            self._latest.popitem(last=False)
        return self._latest[name]


def _name(key: Mapping[str, Any]) -> str:
    return hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:12]


def _files(folder: Path, name: str) -> tuple[Path, Path]:
    return folder / f"references-{name}.json", folder / f"references-{name}.parquet"


def _keep(folder: Path, name: str, key: Mapping[str, Any], samples: pa.Table) -> None:
    about, table = _files(folder, name)
    folder.mkdir(parents=True, exist_ok=True)
    write_samples(table, samples)
    content = {"format": FORMAT, "key": key, "rows": len(samples), "sha256": file_facts(table).sha256}
    write_atomically(about, json.dumps(content).encode())


def _kept(folder: Path, name: str, key: Mapping[str, Any]) -> pa.Table | None:
    """What the cache knows; None where that is nothing, damaged, or of something else."""
    about, table = _files(folder, name)
    try:
        content = read_json(about)
        same = content["format"] == FORMAT and content["key"] == json.loads(json.dumps(key))
        if not same or not table.is_file() or content["sha256"] != file_facts(table).sha256:  # a pipe is no file
            return None
        return read_samples(table, content["rows"])
    except (OSError, JsonUnreadable, RunCorrupt, KeyError, TypeError, ValueError):
        return None
