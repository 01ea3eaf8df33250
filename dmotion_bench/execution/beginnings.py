"""Loaded by the server that worker processes are forks of: it leaves Ctrl-C to the command, and so do its forks.

A terminal sends Ctrl-C to all of them. Each would print a traceback below the command's last sentence, and so would one
that begins while its command ends: the semaphores that it was given are gone by then, or nobody tells it what to do.
It can only end. Nothing else imports this module: to load it changes how a process heeds signals and tells of errors.
"""

from __future__ import annotations

import pickle
import signal
import sys
from multiprocessing import spawn, synchronize
from types import TracebackType

_told = sys.excepthook
_TOO_LATE = ((FileNotFoundError, synchronize.__file__), ((EOFError, pickle.UnpicklingError), spawn.__file__))


def _tell(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """As before, but for what befalls a process that begins too late."""
    last = traceback
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    where = "" if last is None else last.tb_frame.f_code.co_filename
    if not any(issubclass(kind, kinds) and where == file for kinds, file in _TOO_LATE):
        _told(kind, error, traceback)


sys.excepthook = _tell
signal.signal(signal.SIGINT, signal.SIG_IGN)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # it was started with Ctrl-C held back
