"""Files without content, as an interrupted copy leaves them."""

from __future__ import annotations

from pathlib import Path

import pytest
from storage.foreign import foxglove_file, steady, video
from storage.hand_made import refused

from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions

SMALL = ImportOptions(size=16)
SALVAGE = ImportOptions(size=16, salvage=True)
REASON = "is empty: nothing was recorded, or its content was not copied. Copy it again, or"


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A recording with a file beside it that is empty."""
    made = tmp_path / "in"
    made.mkdir()
    foxglove_file(made / "0.mcap", video(6, 16, 16), steady(6))
    (made / "1.mcap").touch()
    return made


@pytest.mark.parametrize("named", [False, True], ids=["folder", "files"])
def test_an_empty_file_does_not_stop_the_others(folder: Path, tmp_path: Path, named: bool) -> None:
    paths, empty = sorted(folder.iterdir()) if named else [folder], folder / "1.mcap"
    assert refused(paths, tmp_path, "1.mcap' is empty", SMALL) == (
        f"{str(empty)!r} {REASON} leave it out with '--skip-damaged'."
    )

    salvaged = import_recordings(paths, tmp_path / "salvaged", SALVAGE)
    assert (salvaged.episodes, salvaged.skipped) == (1, ())
    assert salvaged.advice[0] == f"1 file is empty and left out: {str(empty)!r}."

    skipped = import_fleet(paths, tmp_path / "skipped", SMALL, SerialExecutor(), skip_damaged=True)
    assert skipped.episodes == 1
    assert [path for path, _ in skipped.skipped] == [str(empty)]
    assert skipped.skipped[0][1].endswith("Copy it again.")
    several = import_fleet(paths, tmp_path / "several", SALVAGE, SerialExecutor())
    assert several.advice == salvaged.advice


@pytest.mark.parametrize("name", ["a.mcap", "a.mp4", "a.hdf5", "a.mcap.zst", "a"])
def test_a_file_that_is_empty_and_alone_is_said_to_be(tmp_path: Path, name: str) -> None:
    file = tmp_path / "in" / name
    file.parent.mkdir()
    file.touch()
    for options in (SMALL, SALVAGE):
        assert refused(file, tmp_path, "is empty", options) == f"{str(file)!r} {REASON} name another recording."
    if file.suffix:
        refused(file.parent, tmp_path, f"{name}' is empty", SALVAGE)
