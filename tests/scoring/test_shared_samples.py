"""The references' samples are computed once for all runs of a data set, and are used only as they were written."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from dmotion_bench.learning.run import Run
from dmotion_bench.scoring.prediction import Execution
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
def test_damaged_ones_are_computed_again(make_run: Callable[..., Run], cache: Path, tmp_path: Path, name: str) -> None:
    path = make_run(tmp_path / "run").path
    wanted, _ = scored(path)
    files = sorted(cache.glob(f"references-{name}"))
    assert len(files) == 2
    sound = [file.read_bytes() for file in files]
    for file, content in zip(files, sound, strict=True):
        middle = len(content) // 2
        file.write_bytes(content[:middle] + bytes([content[middle] ^ 1]) + content[middle + 1 :])
    found, computed = scored(path)
    assert found == wanted
    assert computed == REFERENCES
    assert [file.read_bytes() for file in files] == sound


def test_those_of_other_settings_are_not_taken(make_run: Callable[..., Run], cache: Path, tmp_path: Path) -> None:
    path = make_run(tmp_path / "run").path
    scored(path)
    done = set[str]()
    other = ScoreSettings(horizon=4, resamples=100)
    score_run(path, settings=other, how=Execution(progress=lambda what, *_: done.add(what)))
    assert done & REFERENCES == {"rollouts of copy_last"}
