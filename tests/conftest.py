"""Shape annotations are checked while the tests run, and only then; Ctrl-C reaches the commands that tests start.

Commands write no lines of progress, whose number depends on how busy the machine is. Nothing waits for the disk.
Recordings are read by processes that are forked (``warm_reader.py``).
"""

from __future__ import annotations

import gc
import multiprocessing.forkserver
import os
import signal
import sys
from collections import Counter
from collections.abc import Iterator
from unittest import mock

import jaxtyping
import pytest
import shape_check

from dmotion_bench.cli import bound_waiting

SHARED_BY_WORKERS = ("lightning_fabric", "dmotion_bench.api.reproducing", "dmotion_bench.scoring.score")
"""What the server that worker processes are forked off loads for them once, whichever test has it started first."""

bound_waiting()  # before torch loads: a thread that waits leaves its core to the tests beside

import torch  # noqa: E402

torch.set_num_threads(1)
os.environ["DMBENCH_QUIET"] = "1"
os.environ.pop("COLUMNS", None)  # xdist sets it for its workers: tables would be cut for a terminal of 80
os.environ.setdefault("OMP_NUM_THREADS", "1")  # of the commands that tests start: the other cores have other tests
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background job; children would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)
if hasattr(signal, "SIGHUP") and signal.getsignal(signal.SIGHUP) is signal.SIG_IGN:  # as under nohup
    signal.signal(signal.SIGHUP, signal.SIG_DFL)

os.fsync = lambda handle: None  # no test pulls the plug: what it writes need not reach the disk

_preload = multiprocessing.forkserver.set_forkserver_preload
multiprocessing.forkserver.set_forkserver_preload = lambda names: _preload([*names, *SHARED_BY_WORKERS])

jaxtyping.jaxtyped = shape_check.sparingly  # what the hook decorates with
_hook = jaxtyping.install_import_hook(
    [
        "dmotion_bench.learning",
        "dmotion_bench.positions",
        "dmotion_bench.scoring",
        "dmotion_bench.planning",
        *(f"dmotion_bench.storage.{name}" for name in ("frame_cache", "messages", "shard", "split", "tables", "tasks")),
        "dmotion_bench.viewing",
        "baselines",
    ],
    "shape_check.beartype",
)

import warm_reader  # noqa: E402

warm_reader.Confinement._start = warm_reader.start


def pytest_xdist_auto_num_workers() -> int:
    """Of ``-n auto``: half more than there are cores, because many tests wait for processes that they start."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(2, cores + cores // 2)


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """The many objects that importing makes stay for good: they are not looked through, now or later."""
    gc.disable()
    yield
    gc.freeze()
    gc.enable()


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Modules with many slow tests first, so that no process is left alone with one at the end.

    The tests of a module stay together: they share what its fixtures make.
    """
    slow = Counter(item.path for item in items if item.get_closest_marker("slow"))
    items.sort(key=lambda item: -slow[item.path])


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup() -> None:
    """Shapes are checked at the first calls that a test makes, those of its fixtures included."""
    shape_check.begin_test()


@pytest.fixture(autouse=True)
def _as_it_was() -> Iterator[None]:
    """What a test changes in its process is undone: Ray, wandb and simulators set variables, Ray adds folders."""
    with mock.patch.dict(os.environ), mock.patch.object(sys, "path", [*sys.path]):
        yield
