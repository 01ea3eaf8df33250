"""How far jobs are: what one writes another reads, and nothing is lost but the progress where it cannot be written."""

from __future__ import annotations

import errno
import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from dmotion_bench.errors import UsageError
from dmotion_bench.execution.job_progress import (
    SECONDS,
    JobProgress,
    ProgressFile,
    jobs_folder,
    read_progress,
    watching,
)
from dmotion_bench.execution.slurm_executor import cancel_left
from dmotion_bench.workspace import Workspace


def test_what_a_job_says_is_read_until_it_ends(tmp_path: Path) -> None:
    now = [0.0]
    told = ProgressFile(tmp_path / "lapo.json", clock=lambda: now[0])
    first, second = (JobProgress(what="lapo 4", done=done, total=10.0, status="quick") for done in (1.0, 2.0))

    told.tell(first)
    told.tell(second)  # too soon
    assert read_progress(tmp_path) == {"lapo": first}
    now[0] += SECONDS
    told.tell(second)
    assert read_progress(tmp_path) == {"lapo": second}
    told.end()
    assert read_progress(tmp_path) == {}


def test_files_that_cannot_be_read_or_written_are_left_out(tmp_path: Path) -> None:
    (tmp_path / "a.json").write_text("{half")
    (tmp_path / "b.json").write_text('{"other": 1}')
    ProgressFile(tmp_path / "gone" / "c.json").tell(JobProgress(what="c", done=0, total=None))
    ProgressFile(None).tell(JobProgress(what="nobody asks", done=0, total=None))

    assert read_progress(tmp_path) == {}


def test_progress_waits_for_no_disk_and_a_full_one_costs_nothing_else(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: object) -> None:
        raise AssertionError("progress was synced")

    monkeypatch.setattr(os, "fsync", refuse)
    progress = JobProgress(what="lapo 4", done=1.0, total=10.0)
    ProgressFile(tmp_path / "lapo.json").tell(progress)
    assert read_progress(tmp_path) == {"lapo": progress}
    assert [path.name for path in tmp_path.iterdir()] == ["lapo.json"]

    def full(self: Path, _: bytes) -> None:
        raise OSError(errno.ENOSPC, "no space left on the device")

    monkeypatch.setattr(Path, "write_bytes", full)
    ProgressFile(tmp_path / "lapo.json").tell(JobProgress(what="lapo 5", done=2.0, total=10.0))
    assert read_progress(tmp_path) == {"lapo": progress}


HELD = """
import sys, time
from dmotion_bench.execution.job_progress import jobs_folder
from dmotion_bench.workspace import Workspace

with jobs_folder(Workspace(sys.argv[1])) as folder:
    (folder / "slurm").mkdir()
    (folder / "slurm" / "task.pkl").touch()
    print(folder, flush=True)
    time.sleep(60)
"""


def test_what_a_killed_command_left_is_deleted_and_nothing_else(tmp_path: Path) -> None:
    (logs := tmp_path / ".jobs-logs" / "slurm").mkdir(parents=True)  # of jobs that failed, of a command that ended
    (far := tmp_path / ".jobs-far").mkdir()
    (far / "user").write_text("another machine")
    with subprocess.Popen([sys.executable, "-c", HELD, str(tmp_path)], stdout=subprocess.PIPE, text=True) as command:
        assert command.stdout is not None
        folder = Path(command.stdout.readline().strip())
        with jobs_folder(Workspace(tmp_path)):
            assert (folder / "slurm" / "task.pkl").is_file()
        command.kill()
    assert (folder / "slurm" / "task.pkl").is_file()
    with jobs_folder(Workspace(tmp_path)) as own:
        assert sorted(tmp_path.iterdir()) == sorted([logs.parent, far, own])
    assert sorted(tmp_path.iterdir()) == sorted([logs.parent, far])


def test_where_no_folder_can_be_made_the_variable_to_set_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir("/proc")  # where not even root can make one
    with (
        pytest.raises(UsageError, match=r"a folder of '/proc', .*; name another workspace with DMBENCH_WORKSPACE"),
        jobs_folder(Workspace(Path())),
    ):
        pass


def test_it_is_shown_while_the_jobs_run(tmp_path: Path) -> None:
    seen, said = threading.Event(), JobProgress(what="lapo 4", done=1, total=10)

    with watching(tmp_path, lambda jobs: seen.set() if jobs == {"lapo": said} else None):
        ProgressFile(tmp_path / "lapo.json").tell(said)
        assert seen.wait(30)


def test_only_numbers_of_jobs_are_cancelled(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The names of files in a workspace may be somebody else's choice, such as an option of ``scancel``."""
    for name in ("17", "--name=shell", "-u", "4"):
        (tmp_path / f"{name}_submission.sh").touch()
    typed = list[list[str]]()
    monkeypatch.setattr("shutil.which", lambda name: name)
    monkeypatch.setattr("subprocess.run", lambda words, **how: typed.append(words))
    cancel_left(tmp_path)
    assert [words[2:] for words in typed] == [["17", "4"]]
