"""Recordings that Python imports and exports, and the leaderboard that it builds and checks."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from storage.foreign import foxglove_file, steady, video
from storage.foreign_video import moving, video_file

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


def test_an_import_to_another_place_needs_no_place_here(
    files: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    recordings = [Path(one).absolute() for one in files]
    monkeypatch.chdir("/proc")  # nothing can be written there
    for place, how in enumerate(({"skip_damaged": True}, {"workers": 2})):
        made = dm.import_recordings(recordings, size=16, out=tmp_path / "far" / str(place), **how)
        assert made.episodes == len(recordings)
    assert sorted(path.name for path in (tmp_path / "far").iterdir()) == ["0", "1"]


@pytest.mark.parametrize(
    ("given", "error", "says"),
    [
        ({"fit": "cropp"}, UnknownName, "no fit named 'cropp'; did you mean 'crop'?"),
        ({"executor": "kubernetes"}, UnknownName, "no executor named 'kubernetes'"),
        ({"workers": 0}, UsageError, "workers is 0; it must be a whole number of 1 or more."),
        ({"size": True}, UsageError, "size is True; it must be a whole number"),
        ({"hz": float("nan")}, InvalidSetting, "'--hz' is nan"),
        ({"hz": "10"}, UsageError, "hz is '10'; it must be a number."),
        ({"hz": 10**400}, UsageError, "hz is 1000.*; it must be a number."),
        ({"hz": None}, InvalidSetting, "'--hz' is None; allowed is"),
        ({"source_hz": True}, UsageError, "source_hz is True; it must be a number."),
        ({"max_gap_s": "1"}, UsageError, "max_gap_s is '1'; it must be a number."),
        ({"max_gap_s": float("inf")}, InvalidSetting, "'--max-gap' is inf; a gap is longer than 0 s, and no recording"),
        ({"frames_per_episode": 10**9}, InvalidSetting, "'--frames-per-episode' is 1000000000; allowed is 3 "),
        ({"min_frames": 200}, InvalidSetting, "'--min-frames' is 200, and .* than '--frames-per-episode' 100 are cut"),
        ({"camera": 1.5}, UsageError, "camera is 1.5; it must be a text."),
        ({"actions": 3}, UsageError, "actions is 3; it must be a text."),
        ({"actions": "/a", "action_fields": [0]}, UsageError, r"action_fields is \[0\]; it must be a list of texts"),
        ({"actions": "/a", "action_fields": 0}, UsageError, "action_fields is 0; it must be a list of texts"),
        ({"recordings": []}, UsageError, "no recording was named"),
    ],
)
def test_what_is_wrong_is_said_and_nothing_is_written(
    files: list[Path], given: dict[str, Any], error: type[Exception], says: str
) -> None:
    with pytest.raises(error, match=says.replace("?", r"\?")):
        dm.import_recordings(**({"recordings": files} | given))
    assert not Path("data").exists()


def test_a_whole_number_is_written_as_one_with_a_fraction(tmp_path: Path, files: list[Path]) -> None:
    """The command line knows fractions alone: the same numbers make the same bytes, NumPy's as well."""
    given: list[dict[str, Any]] = [
        {"hz": 5.0, "max_gap_s": 1.0},
        {"hz": 5, "max_gap_s": 1},
        {"hz": np.int64(5), "max_gap_s": np.float32(1)},
        {"hz": Fraction(10, 2), "max_gap_s": Fraction(1)},
    ]
    made = [dm.import_recordings("a.mcap", size=16, out=f"data/{place}", **one) for place, one in enumerate(given)]
    assert len({(one.path / "dataset.json").read_bytes() for one in made}) == 1


def test_the_stream_of_a_video_may_be_a_whole_number(tmp_path: Path, files: list[Path]) -> None:
    video_file(tmp_path / "a.mkv", moving(6, 32, 32))
    assert dm.import_recordings("a.mkv", camera=0, size=16) == dm.import_recordings("a.mkv", camera="0", size=16)


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
