"""Runs ``dmbench`` as a user does, through ``main``, with the commands that a test needs."""

from __future__ import annotations

import contextlib
import functools
import os
import resource
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import psutil
import pytest
import typer.main

from dmotion_bench.cli import main
from dmotion_bench.interrupts import INTERRUPTED

_MAIN = "from dmotion_bench.cli import main; main()"
_parser = functools.cache(typer.main.get_command)
"""Typer makes the parser of all commands anew for each call, which takes most of a short command's time."""


@dataclass(frozen=True)
class Outcome:
    """What a command said, and its exit code."""

    code: int
    out: str
    err: str

    def sentence(self) -> str:
        """The one line of an error; there is nothing else on stderr, and no traceback."""
        assert self.err.startswith("dmbench: "), self.err
        assert self.err.count("\n") == 1, self.err
        return self.err


def dmbench(words: Sequence[str], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Outcome:
    """In this process: quick."""
    monkeypatch.setattr(sys, "argv", ["dmbench", *words])
    monkeypatch.setattr(typer.main, "get_command", _parser)
    capsys.readouterr()
    with pytest.raises(SystemExit) as left:
        main()
    captured = capsys.readouterr()
    return Outcome(int(left.value.code or 0), captured.out, captured.err)


def start_dmbench(
    words: Sequence[str], workspace: Path, *, file_bytes: int | None = None, **options: object
) -> subprocess.Popen[str]:
    """In a process of its own, which can be interrupted, killed and limited.

    With ``file_bytes`` no file can grow beyond, as on a full disk. It then writes no bytecode either: Python would
    leave half a ``.pyc`` behind (github.com/python/cpython/issues/126606), with which every later import of it fails.
    """
    environment = os.environ | {"DMBENCH_WORKSPACE": str(workspace)}
    if file_bytes is not None:
        environment["PYTHONDONTWRITEBYTECODE"] = "1"
        options["preexec_fn"] = partial(resource.setrlimit, resource.RLIMIT_FSIZE, (file_bytes, file_bytes))
    return subprocess.Popen(  # type: ignore[call-overload, no-any-return]
        [sys.executable, "-X", "faulthandler", "-c", _MAIN, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        **options,
    )


def finish(process: subprocess.Popen[str], seconds: float = 120) -> Outcome:
    """Wait for its end.

    A command that lasts longer fails its test alone: it says what its threads do, and all that it started is killed.
    """
    try:
        out, err = process.communicate(timeout=seconds)
    except subprocess.TimeoutExpired:
        started = psutil.Process(process.pid).children(recursive=True)
        process.send_signal(signal.SIGABRT)  # "-X faulthandler" answers with a traceback of each thread
        for one in started:
            with contextlib.suppress(psutil.NoSuchProcess):
                one.kill()
        with contextlib.suppress(subprocess.TimeoutExpired):
            process.wait(timeout=5)
        process.kill()
        out, err = process.communicate()
        pytest.fail(f"not at its end after {seconds:.0f} s: {process.args}\n{out}\n{err}")
    return Outcome(process.returncode, out, err)


def interrupted_once(
    process: subprocess.Popen[str], at_work: Callable[[], bool], number: signal.Signals
) -> list[psutil.Process]:
    """Send a signal to a command alone, as soon as it is at work; returns the processes that it had started."""
    deadline = time.monotonic() + 120
    while not at_work():
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(number)
    return children


def never_ending(processes: Sequence[psutil.Process]) -> list[psutil.Process]:
    """Those that do not end within a minute: a process that is killed ends only when the disk has answered it."""
    return list(psutil.wait_procs(processes, timeout=60)[1])


def ended_by_ctrl_c(process: subprocess.Popen[str], workers: Sequence[psutil.Process], workspace: Path) -> None:
    """Check that a command with workers says how to go on, and leaves neither processes nor notes of jobs."""
    outcome = finish(process)
    assert outcome.code == 130
    assert outcome.err.splitlines()[-1] == f"dmbench: {INTERRUPTED}"
    assert len(workers) >= 2
    assert not never_ending(workers)
    assert not list(workspace.glob(".jobs-*"))
