"""No encoder leaves the process with a priority that it did not have."""

from __future__ import annotations

import contextlib
import os
import sys
import threading
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from dmotion_bench.storage.video.codecs import CODECS, Codec
from dmotion_bench.storage.video.scheduling import as_scheduled_before
from dmotion_bench.storage.video.writer import VideoWriter

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="other systems schedule otherwise")


def _threads() -> set[int]:
    return {int(thread.name) for thread in Path("/proc/self/task").iterdir()}


def _policies(threads: set[int]) -> set[int]:
    found = set()
    for one in threads:
        with contextlib.suppress(ProcessLookupError):  # it has ended since
            found.add(os.sched_getscheduler(one))
    return found


def test_the_caller_and_new_threads_are_scheduled_as_before_and_others_stay() -> None:
    ready, end = threading.Barrier(2), threading.Event()

    def wait_as_batch() -> None:
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        ready.wait()
        end.wait()

    threads = [threading.Thread(target=wait_as_batch) for _ in range(2)]
    try:
        threads[0].start()
        ready.wait()
        before = os.sched_getscheduler(0)
        with as_scheduled_before():
            threads[1].start()
            ready.wait()
            os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        known, new = (thread.native_id or 0 for thread in threads)
        assert (before, os.sched_getscheduler(0)) == (os.SCHED_OTHER, os.SCHED_OTHER)
        assert (os.sched_getscheduler(known), os.sched_getscheduler(new)) == (os.SCHED_BATCH, os.SCHED_OTHER)
    finally:
        end.set()
        for thread in threads:
            thread.join()


@pytest.mark.parametrize("codec", CODECS.values(), ids=lambda codec: codec.name)
def test_an_encoder_runs_as_its_process_does(codec: Codec, tmp_path: Path) -> None:
    """Only root may run before others, so only there can this fail.

    Threads of earlier tests may not have ended yet: a thread is joined a little before the system has done with it.
    """
    others = _threads() - {threading.get_native_id()}
    writer = VideoWriter(tmp_path / "a.mp4", codec, fps=Fraction(10), height=64, width=64)
    writer.write(np.zeros((3, 64, 64, 3), np.uint8))
    assert _policies(_threads() - others) == {os.SCHED_OTHER}
    writer.close()
    assert _policies(_threads() - others) == {os.SCHED_OTHER}
