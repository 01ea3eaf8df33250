"""Loaded by the server that worker processes are forks of: it leaves Ctrl-C to the command.

A terminal sends Ctrl-C to the server, too, which would print a traceback below the command's last sentence. So would a
fork that begins while its command ends: the semaphores that it was given are gone by then, or nobody tells it what to
do. It can only end. So can the server whose command was interrupted as it asked for a fork. Nothing else imports this
module: to load it changes how a process heeds signals and tells of errors. The forks of the server heed Ctrl-C as ever,
for they may be another library's.
"""

from __future__ import annotations

import os
import pickle
import signal
import sys
from multiprocessing import reduction, spawn, synchronize
from types import FrameType, TracebackType

_told = sys.excepthook
_SERVER = os.getpid()
_TOO_LATE = (
    (FileNotFoundError, synchronize.__file__),
    ((EOFError, pickle.UnpicklingError), spawn.__file__),
    (EOFError, reduction.__file__),
)


def _tell(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """As before, but for what befalls a process that begins, or is asked for, too late."""
    last = traceback
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    where = "" if last is None else last.tb_frame.f_code.co_filename
    if not any(issubclass(kind, kinds) and where == file for kinds, file in _TOO_LATE):
        _told(kind, error, traceback)


def _leave(number: int, frame: FrameType | None) -> None:
    """Do nothing in the server; in its forks raise ``KeyboardInterrupt``."""
    if os.getpid() != _SERVER:
        signal.default_int_handler(number, frame)


sys.excepthook = _tell
signal.signal(signal.SIGINT, _leave)
signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT})  # it was started with Ctrl-C held back
