"""Processes that cannot be started on this machine are said in a sentence."""

from __future__ import annotations

import errno
import os
from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import pytest

from dmotion_bench.errors import DmbenchError
from dmotion_bench.execution import local_executor
from dmotion_bench.execution.local_executor import LocalExecutor


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
