"""An import or export that is killed, interrupted or doubled, for real: processes and signals."""

from __future__ import annotations

import signal
import subprocess
import time
from pathlib import Path

import numpy as np
import pytest
from dmbench_command import finish, start_dmbench
from storage.foreign import foxglove_file, steady

from dmotion_bench.errors import FolderInUse, UsageError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.staging import CONTENT, MARKER, staged, sweep

pytestmark = pytest.mark.slow

FRAMES = 400


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough to be caught in the middle."""
    picture = np.zeros((240, 320, 3), np.uint8)
    return foxglove_file(tmp_path_factory.mktemp("long") / "a.mcap", [picture] * FRAMES, steady(FRAMES))


def words(command: str, recording: Path, workspace: Path) -> list[str]:
    """An import, or the export of what was imported."""
    if command == "import":
        return ["data", "import", str(recording), "--size", "64", "--out", str(workspace / "made")]
    return ["data", "export", str(workspace / "source"), "--out", str(workspace / "made")]


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    return tmp_path


def caught_writing(command: str, recording: Path, workspace: Path) -> subprocess.Popen[str]:
    """The command's process, in the middle of its work."""
    if command == "export":
        done = finish(start_dmbench(["data", "import", str(recording), "--out", str(workspace / "source")], workspace))
        assert done.code == 0, done.err
    process = start_dmbench(words(command, recording, workspace), workspace)
    content = workspace / f"made.{command}ing" / CONTENT
    while not any(content.rglob("*.*")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.001)
    return process


def names(workspace: Path) -> list[str]:
    return sorted(path.name for path in workspace.iterdir() if path.name != "source")


@pytest.mark.parametrize("command", ["import", "export"])
def test_what_a_killed_one_leaves_is_cleaned_by_the_next(command: str, recording: Path, workspace: Path) -> None:
    process = caught_writing(command, recording, workspace)
    process.send_signal(signal.SIGKILL)
    finish(process)
    assert names(workspace) == [f".made.{command}ing.lock", f"made.{command}ing"]
    nowhere = finish(start_dmbench(["data", "info", str(workspace / "made")], workspace))
    assert "no data set named" in nowhere.sentence()

    again = finish(start_dmbench(words(command, recording, workspace), workspace))
    assert again.code == 0, again.err
    assert names(workspace) == ["made"]
    if command == "import":
        assert int(Dataset.open(workspace / "made").lengths.sum()) == FRAMES


@pytest.mark.parametrize("command", ["import", "export"])
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_nothing_and_says_so(
    command: str, sign: signal.Signals, recording: Path, workspace: Path
) -> None:
    process = caught_writing(command, recording, workspace)
    process.send_signal(sign)
    ended = finish(process)
    assert ended.code == 128 + sign
    assert ended.sentence() == (
        f"dmbench: interrupted; the unfinished {command} was removed. Run the same command again to start over.\n"
    )
    assert names(workspace) == []


def test_what_another_process_is_writing_is_left_alone(recording: Path, workspace: Path) -> None:
    with staged(workspace / "made", ".importing") as content:
        (content / "half").write_text("written")
        refused = finish(start_dmbench(words("import", recording, workspace), workspace))
        assert refused.code == 1
        assert "another dmbench is writing into" in refused.sentence()
        assert (content / "half").read_text() == "written"
    assert (workspace / "made" / "half").read_text() == "written"


@pytest.mark.parametrize("command", ["import", "export"])
def test_a_full_disk_is_a_sentence_and_leaves_nothing(command: str, recording: Path, workspace: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (12, 64, 64, 3), dtype=np.uint8)
    small = foxglove_file(workspace / "source.mcap", noise, steady(12))
    if command == "export":
        done = finish(start_dmbench(["data", "import", str(small), "--out", str(workspace / "source")], workspace))
        assert done.code == 0, done.err

    full = finish(start_dmbench(words(command, small, workspace), workspace, file_bytes=50_000))
    assert full.code == 1
    assert "no space left on the device for" in full.sentence()
    assert "nothing is left of it" in full.sentence()
    assert names(workspace) == ["source.mcap"]  # and nothing of what was begun


def test_a_place_that_cannot_be_is_said(workspace: Path) -> None:
    (workspace / "file").write_text("keep")
    with (
        pytest.raises(UsageError, match=r"file' is no folder; name another one with '--out DIR'"),
        staged(workspace / "file" / "a" / "b", ".importing"),
    ):
        raise AssertionError("it began")


def test_nothing_that_it_did_not_make_is_deleted(tmp_path: Path) -> None:
    out, outer = tmp_path / "made", tmp_path / "made.importing"

    def refused() -> None:
        before = sorted(tmp_path.rglob("*"))
        with pytest.raises(UsageError, match=r"made\.importing' is in the way"), staged(out, ".importing"):
            raise AssertionError("it began")
        assert sorted(tmp_path.rglob("*")) == before

    outer.mkdir()
    (outer / CONTENT).mkdir()  # without the marker it may be anyone's
    (outer / CONTENT / "mine").write_text("keep")
    sweep(out, ".importing")
    refused()
    (outer / MARKER).touch()
    (outer / "notes").write_text("keep")
    refused()
    (outer / "notes").unlink()
    outer.rename(tmp_path / "elsewhere")
    outer.symlink_to("elsewhere")
    sweep(out, ".importing")
    refused()
    outer.unlink()
    outer.write_text("a file")
    refused()
    assert (tmp_path / "elsewhere" / CONTENT / "mine").read_text() == "keep"


def test_a_crash_at_any_moment_leaves_what_the_next_takes_away(tmp_path: Path) -> None:
    out, outer = tmp_path / "made", tmp_path / "made.importing"
    for stage in range(4):
        outer.mkdir()
        if stage > 0:
            (outer / MARKER).touch()
        if stage > 1:
            (outer / CONTENT).mkdir()
        if stage > 2:
            (outer / CONTENT / "half").touch()
        with staged(out, ".importing") as content:
            assert list(content.iterdir()) == []
            (content / "whole").touch()
        assert sorted(path.name for path in tmp_path.rglob("*")) == ["made", "whole"]
        (out / "whole").unlink()  # an empty folder may be there
    (outer / CONTENT).mkdir(parents=True)
    (outer / MARKER).touch()
    sweep(out, ".importing")
    assert [path.name for path in tmp_path.iterdir()] == ["made"]


def test_two_at_once_never_share_a_folder(tmp_path: Path) -> None:
    with (
        staged(tmp_path / "made", ".importing"),
        pytest.raises(FolderInUse, match="another dmbench"),
        staged(tmp_path / "made", ".importing"),
    ):
        raise AssertionError("it began")


def test_the_root_of_all_folders_cannot_be_made_anew(recording: Path, workspace: Path) -> None:
    said = finish(start_dmbench([*words("import", recording, workspace)[:-1], "/"], workspace))
    assert said.code == 2
    assert "name another folder with '--out DIR'" in said.sentence()
