"""An import or export that is killed, interrupted or doubled, for real: processes and signals."""

from __future__ import annotations

import signal
import subprocess
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from dmbench_command import Outcome, dmbench, finish, start_dmbench
from storage.foreign import foxglove_file, steady

from dmotion_bench.errors import FolderInUse, UsageError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.staging import CONTENT, MARKER, staged, sweep

pytestmark = pytest.mark.slow

Command = Callable[..., Outcome]
FRAMES = 400


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Long enough to be caught in the middle."""
    picture = np.zeros((240, 320, 3), np.uint8)
    return foxglove_file(tmp_path_factory.mktemp("long") / "a.mcap", [picture] * FRAMES, steady(FRAMES))


@pytest.fixture(scope="module")
def sources(recording: Path) -> dict[str, Path]:
    """What each command is given: the recording, and what was imported of it; read only."""
    imported = recording.parent / "imported"
    import_recordings([recording], imported, ImportOptions())
    return {"import": recording, "export": imported}


def words(command: str, source: Path, workspace: Path) -> list[str]:
    """An import, or the export of what was imported."""
    size = ["--size", "64"] if command == "import" else []
    return ["data", command, str(source), *size, "--out", str(workspace / "made")]


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    return tmp_path


@pytest.fixture
def run(workspace: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Command:
    """Run a command in this process."""
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(workspace))
    return lambda words: dmbench(words, capsys, monkeypatch)


def caught_writing(command: str, source: Path, workspace: Path) -> subprocess.Popen[str]:
    """The command's process, in the middle of its work."""
    process = start_dmbench(words(command, source, workspace), workspace)
    content = workspace / f"made.{command}ing" / CONTENT
    while not any(content.rglob("*.*")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.001)
    return process


def names(workspace: Path) -> list[str]:
    return sorted(path.name for path in workspace.iterdir())


@pytest.mark.parametrize("command", ["import", "export"])
def test_what_a_killed_one_leaves_is_cleaned_by_the_next(
    run: Command, command: str, sources: dict[str, Path], workspace: Path
) -> None:
    process = caught_writing(command, sources[command], workspace)
    process.send_signal(signal.SIGKILL)
    finish(process)
    assert names(workspace) == [f".made.{command}ing.lock", f"made.{command}ing"]
    assert "no data set named" in run(["data", "info", str(workspace / "made")]).sentence()

    again = run(words(command, sources[command], workspace))
    assert again.code == 0, again.err
    assert names(workspace) == ["made"]
    if command == "import":
        assert int(Dataset.open(workspace / "made").lengths.sum()) == FRAMES


@pytest.mark.parametrize("command", ["import", "export"])
@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_an_interruption_leaves_nothing_and_says_so(
    command: str, sign: signal.Signals, sources: dict[str, Path], workspace: Path
) -> None:
    process = caught_writing(command, sources[command], workspace)
    process.send_signal(sign)
    ended = finish(process)
    assert ended.code == 128 + sign
    assert ended.sentence() == (
        f"dmbench: interrupted; the unfinished {command} was removed. Run the same command again to start over.\n"
    )
    assert names(workspace) == []


def test_what_another_one_is_writing_is_left_alone(run: Command, recording: Path, workspace: Path) -> None:
    with staged(workspace / "made", ".importing") as content:
        (content / "half").write_text("written")
        refused = run(words("import", recording, workspace))
        assert refused.code == 1
        assert "another dmbench is writing into" in refused.sentence()
        assert (content / "half").read_text() == "written"
    assert (workspace / "made" / "half").read_text() == "written"


@pytest.mark.parametrize("command", ["import", "export"])
def test_a_full_disk_is_a_sentence_and_leaves_nothing(command: str, workspace: Path) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (12, 64, 64, 3), dtype=np.uint8)
    source = foxglove_file(workspace / "source.mcap", noise, steady(12))
    if command == "export":
        import_recordings([source], workspace / "source", ImportOptions())
        source = workspace / "source"
    before = names(workspace)

    full = finish(start_dmbench(words(command, source, workspace), workspace, file_bytes=50_000))
    assert full.code == 1
    assert "no space left on the device for" in full.sentence()
    assert "nothing is left of it" in full.sentence()
    assert names(workspace) == before  # and nothing of what was begun


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


def test_the_root_of_all_folders_cannot_be_made_anew(run: Command, recording: Path, workspace: Path) -> None:
    said = run([*words("import", recording, workspace)[:-1], "/"])
    assert said.code == 2
    assert "name another folder with '--out DIR'" in said.sentence()
