"""Runs ``dmbench`` as a user does, through ``main``, with the commands that a test needs."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pytest

from dmotion_bench.cli import main

_MAIN = "from dmotion_bench.cli import main; main()"


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
    capsys.readouterr()
    with pytest.raises(SystemExit) as left:
        main()
    captured = capsys.readouterr()
    return Outcome(int(left.value.code or 0), captured.out, captured.err)


def start_dmbench(words: Sequence[str], workspace: Path, **options: object) -> subprocess.Popen[str]:
    """In a process of its own, which can be interrupted, killed and limited."""
    return subprocess.Popen(  # type: ignore[call-overload, no-any-return]
        [sys.executable, "-c", _MAIN, *words],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=os.environ | {"DMBENCH_WORKSPACE": str(workspace)},
        **options,
    )


def finish(process: subprocess.Popen[str]) -> Outcome:
    """Wait for its end."""
    out, err = process.communicate(timeout=120)
    return Outcome(process.returncode, out, err)
