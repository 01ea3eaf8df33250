"""Processes of this machine: what they raise, what they begin with, and that none is left."""

from __future__ import annotations

import errno
import multiprocessing
import os
import signal
import subprocess
import sys
import threading
import time
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path

import pytest
from mortal_workers import (
    InterruptedOnce,
    LeavesTraces,
    parent_when_begun,
    raises_at_one,
    raises_what_cannot_be_sent,
)

from dmotion_bench import interrupts
from dmotion_bench.errors import DmbenchError, UnknownName
from dmotion_bench.execution import local_executor
from dmotion_bench.execution.local_executor import LocalExecutor

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("workers_find_the_tests_modules")]


def assert_no_pool_is_left() -> None:
    """Else the interpreter's end may meet a pool that closes its pipe, and print a traceback."""
    assert not [thread for thread in threading.enumerate() if type(thread).__module__ == "concurrent.futures.process"]
    assert not multiprocessing.active_children()


@pytest.mark.parametrize("survived", [False, True])
def test_a_worker_that_is_asked_to_end_costs_its_attempt_at_one_job(
    survived: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(interrupts._Received, "number", 0)  # as it is again afterwards
    if survived:  # by the program, which was asked to end before
        with pytest.raises(KeyboardInterrupt), interrupts.ended_like_ctrl_c():
            signal.raise_signal(signal.SIGTERM)
    done = LocalExecutor(2).map_unordered(InterruptedOnce(tmp_path / "asked"), [0, 1, 2])
    assert sorted(done) == [0, 1, 2]
    assert (tmp_path / "asked").exists()
    assert_no_pool_is_left()


def test_what_a_worker_raises_arrives_as_it_was() -> None:
    with pytest.raises(UnknownName, match="no shape named 'teapot'") as caught:
        list(LocalExecutor(2).map_unordered(raises_at_one, range(3)))
    assert caught.value.known == ["cube"]


def test_what_cannot_be_sent_arrives_as_its_text() -> None:
    with pytest.raises(RuntimeError, match=r"OfTwo: the arm is stuck \(motor 3\)"):
        list(LocalExecutor(2).map_unordered(raises_what_cannot_be_sent, [1]))
    assert_no_pool_is_left()


def test_closing_ends_what_runs(tmp_path: Path) -> None:
    results = LocalExecutor(2).map_unordered(LeavesTraces(tmp_path, seconds=30), range(2))
    assert next(results) == 0
    results.close()
    assert not (tmp_path / "ended-1").exists()
    assert_no_pool_is_left()


def test_processes_begin_with_the_variables_of_now(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("DMBENCH_ONE", "DMBENCH_TWO"):
        with monkeypatch.context() as patch:
            patch.setenv(name, name)
            got = set(LocalExecutor(2).map_unordered(os.getenv, ["DMBENCH_ONE", "DMBENCH_TWO"]))
        assert got == {name, None}


@pytest.mark.skipif(sys.platform != "linux", reason="there is no server of processes")
def test_processes_are_forks_of_one_server_and_load_nothing_again() -> None:
    servers = {parent for _ in range(2) for parent in LocalExecutor(2).map_unordered(parent_when_begun, range(2))}
    assert len(servers) == 1
    assert os.getpid() not in servers


def test_the_last_result_leaves_no_pool_that_still_ends() -> None:
    assert sorted(LocalExecutor(2).map_unordered(abs, [-1, -2])) == [1, 2]
    assert_no_pool_is_left()


def test_an_interruption_while_a_process_starts_leaves_no_pool(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*arguments: object) -> None:
        submit(*arguments)
        raise KeyboardInterrupt

    submit = ProcessPoolExecutor.submit
    monkeypatch.setattr(ProcessPoolExecutor, "submit", interrupted)
    with pytest.raises(KeyboardInterrupt):
        list(LocalExecutor(2).map_unordered(time.sleep, [30]))
    assert_no_pool_is_left()


LATE = """
import os
import sys
from multiprocessing.synchronize import SemLock
from dmotion_bench.execution.local_executor import _context

if __name__ == "__main__":
    context = _context(print)
    given = "no number"
    if sys.argv[1] == "late":
        given = context.Lock()
        SemLock._cleanup(given._semlock.name)  # as at the end of a command
    process = context.Process(target=int, args=(given,))
    process.start()
    process.join()
    print(process.exitcode, flush=True)
    os._exit(0)
"""


@pytest.mark.skipif(sys.platform != "linux", reason="there is no server of processes")
@pytest.mark.parametrize(("what", "said"), [("late", ""), ("wrong", "ValueError: invalid literal")])
def test_a_process_that_begins_too_late_says_nothing_and_others_what_is_wrong(
    tmp_path: Path, what: str, said: str
) -> None:
    script = tmp_path / "late.py"
    script.write_text(LATE)
    done = subprocess.run([sys.executable, str(script), what], capture_output=True, text=True, timeout=120, check=False)
    assert done.stdout == "1\n"
    assert said in done.stderr
    assert ("Traceback" in done.stderr) == bool(said)


@pytest.mark.parametrize(
    "error",
    [
        OSError(errno.ENOMEM, os.strerror(errno.ENOMEM)),
        BlockingIOError(errno.EAGAIN, os.strerror(errno.EAGAIN)),
        EOFError("unexpected EOF"),  # the server of processes could fork none, and ended
    ],
)
def test_a_machine_that_starts_no_more_processes_is_said(monkeypatch: pytest.MonkeyPatch, error: Exception) -> None:
    """A fork that is refused is pretended: a limit on processes holds for no superuser."""

    def refuse(*_: object) -> None:
        raise error

    monkeypatch.setattr(local_executor, "_context", lambda _: get_context("spawn"))
    monkeypatch.setattr(ProcessPoolExecutor, "submit", refuse)
    with pytest.raises(
        DmbenchError, match=r"no more worker processes can be started on this machine.*fewer '--workers'"
    ):
        list(LocalExecutor(2).map_unordered(abs, [1, 2]))


def test_any_other_error_of_the_system_stays_what_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(_: object) -> None:
        raise FileNotFoundError(errno.ENOENT, os.strerror(errno.ENOENT), "python")

    monkeypatch.setattr(local_executor, "_context", missing)
    with pytest.raises(FileNotFoundError):
        list(LocalExecutor(2).map_unordered(abs, [1, 2]))
