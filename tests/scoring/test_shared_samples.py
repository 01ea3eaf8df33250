"""The references' samples are computed once for all runs of a data set, and are used only as they were written."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pytest

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.prediction import MODEL, Execution
from dmotion_bench.scoring.samples import GAIN, SampleRows
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.workspace import CACHE_VARIABLE

QUICK = ScoreSettings(horizon=3, resamples=100)
REFERENCES = {"references", "rollouts of copy_last"}


@pytest.fixture
def cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A cache of the test's own."""
    monkeypatch.setenv(CACHE_VARIABLE, str(tmp_path / "cache"))
    return tmp_path / "cache"


def scored(path: Path, *, on_disk: bool = True) -> tuple[bytes, set[str]]:
    """The samples of a run scored by a process that remembers nothing, and what was computed for them."""
    done = set[str]()
    how = Execution(progress=lambda what, *_: done.add(what))
    score_run(path, settings=QUICK, how=how, shared=SharedSamples(on_disk=on_disk))
    return (path / "report/samples.parquet").read_bytes(), done & REFERENCES


@pytest.mark.slow
def test_another_process_takes_them_from_the_cache(make_run: Callable[..., Run], cache: Path, tmp_path: Path) -> None:
    path = make_run(tmp_path / "run").path
    alone, computed = scored(path, on_disk=False)
    assert computed == REFERENCES
    assert not list(cache.glob("references-*"))
    first, computed = scored(path)
    assert computed == REFERENCES
    again, computed = scored(path)
    assert computed == set()
    assert alone == first == again


@pytest.mark.parametrize("name", ["*.parquet", "*.json"])
def test_damaged_ones_are_computed_again(tmp_path: Path, name: str) -> None:
    computed: list[pa.Table] = []

    def score() -> pa.Table:
        rows = SampleRows(GAIN, MODEL)
        three = np.arange(3)
        rows.add({"gain": three / 2, "best_gain": np.ones(3), "episode": three, "step": three, "ahead": three + 1})
        computed.append(rows.table())
        return computed[-1]

    def got() -> pa.Table:
        """What a process that remembers nothing gets."""
        return SharedSamples().get({"dataset": "d"}, score, tmp_path)

    wanted = got()
    assert got() == wanted
    assert len(computed) == 1
    (file,) = tmp_path.glob(f"references-{name}")
    sound = file.read_bytes()
    middle = len(sound) // 2
    file.write_bytes(sound[:middle] + bytes([sound[middle] ^ 1]) + sound[middle + 1 :])
    assert got() == wanted
    assert len(computed) == 2
    assert file.read_bytes() == sound
    file.unlink()
    os.mkfifo(file)  # nobody writes into it
    assert got() == wanted
    assert len(computed) == 3
    assert file.read_bytes() == sound


@pytest.mark.slow
def test_those_of_other_settings_are_not_taken(make_run: Callable[..., Run], cache: Path, tmp_path: Path) -> None:
    path = make_run(tmp_path / "run").path
    scored(path)
    done = set[str]()
    other = ScoreSettings(horizon=4, resamples=100)
    score_run(path, settings=other, how=Execution(progress=lambda what, *_: done.add(what)))
    assert done & REFERENCES == {"rollouts of copy_last"}
