"""Loaded by the server that worker processes are forks of: one that begins while its command ends says nothing.

By then the semaphores that it was given are gone, and it can only end. Python would print a traceback of it below the
command's last sentence. Nothing else imports this module: to load it changes how a process tells of its errors.
"""

from __future__ import annotations

import sys
from multiprocessing import synchronize
from types import TracebackType

_told = sys.excepthook


def _tell(kind: type[BaseException], error: BaseException, traceback: TracebackType | None) -> None:
    """As before, but for a semaphore that is not there any more."""
    last = traceback
    while last is not None and last.tb_next is not None:
        last = last.tb_next
    where = "" if last is None else last.tb_frame.f_code.co_filename
    if not (issubclass(kind, FileNotFoundError) and where == synchronize.__file__):
        _told(kind, error, traceback)


sys.excepthook = _tell
