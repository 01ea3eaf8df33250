"""Encoders run like the rest of their process, and never before all other work of the machine."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path

_THREADS = Path("/proc/self/task")


@contextlib.contextmanager
def as_scheduled_before() -> Iterator[None]:
    """Afterwards the calling thread, and the threads that were started meanwhile, are scheduled as it was before.

    When it is opened by root, SVT-AV1 gives itself and whoever opens it the highest real-time priority. The process
    would keep it, and with it the processes that it starts: nothing else could run on its processors.
    """
    if sys.platform != "linux":
        yield
        return
    policy, parameters = os.sched_getscheduler(0), os.sched_getparam(0)
    known = {thread.name for thread in _THREADS.iterdir()}
    try:
        yield
    finally:
        os.sched_setscheduler(0, policy, parameters)
        for thread in _THREADS.iterdir():
            if thread.name not in known:
                with contextlib.suppress(ProcessLookupError):  # it has ended
                    os.sched_setscheduler(int(thread.name), policy, parameters)
