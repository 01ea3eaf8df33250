"""Recordings that Python imports and exports, and the leaderboard that it builds and checks."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from storage.foreign import foxglove_file, steady, video

import dmotion_bench as dm
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UnknownName, UsageError


@pytest.fixture
def files(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[Path]:
    """Two recordings of 12 pictures; the working folder is where they are."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DMBENCH_WORKSPACE", raising=False)
    return [
        foxglove_file(tmp_path / f"{name}.mcap", video(12, seed=seed), steady(12)) for seed, name in enumerate("ab")
    ]


def test_what_was_imported_stands_wherever_a_data_set_may(files: list[Path]) -> None:
    told: list[Any] = []
    one = dm.import_recordings("a.mcap", size=np.int64(16), progress=told.append)
    both = dm.import_recordings(files, size=16, out="data/both", skip_damaged=True)
    assert one.path == Path("data/imported-a")
    assert (len(dm.open_dataset(one)), len(dm.open_dataset(both)), both.skipped) == (1, 2, ())
    assert (told[-1].what, told[-1].done, told[-1].total) == ("importing", 1, 1)
    assert dm.import_recordings("a.mcap", size=16) == one


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ({"fit": "cropp"}, UnknownName, "no fit named 'cropp'; did you mean 'crop'?"),
        ({"executor": "kubernetes"}, UnknownName, "no executor named 'kubernetes'"),
        ({"workers": 0}, UsageError, "workers is 0; it must be a whole number of 1 or more."),
        ({"size": True}, UsageError, "size is True; it must be a whole number"),
        ({"hz": float("nan")}, InvalidSetting, "hz is nan"),
        ({"recordings": []}, UsageError, "no recording was named"),
    ],
)
def test_what_is_wrong_is_said_and_nothing_is_written(
    files: list[Path], given: dict[str, Any], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says.replace("?", r"\?")):
        dm.import_recordings(**({"recordings": files} | given))
    assert not Path("data").exists()


@pytest.mark.slow
def test_labels_that_are_not_there_are_exported_only_if_nobody_asks_for_them(files: list[Path]) -> None:
    imported = dm.import_recordings(files, size=16)
    exported = dm.export_dataset(imported)
    assert (exported.labels, exported.path) == (False, Path("exports/imported-a-lerobot"))
    assert dm.import_recordings(exported, size=16, out="data/again").frames == imported.frames
    with pytest.raises(LabelsNotAvailable):
        dm.export_dataset(imported, labels=True, out="exports/more")


def test_a_check_of_nothing_and_shares_that_are_none_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(UsageError, match="nothing to check"):
        dm.leaderboard_check()
    with pytest.raises(UsageError, match="differing is 2; it must be a share from 0 to 1"):
        dm.leaderboard_check("e.json", differing=2)
    with pytest.raises(UnknownName, match="no split named 'train'"):
        dm.leaderboard_compare("a", "b", split="train")
