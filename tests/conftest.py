"""Shape annotations are checked while the tests run, and only then; Ctrl-C reaches the commands that tests start.

Commands write no lines of progress, whose number depends on how busy the machine is.
"""

from __future__ import annotations

import os
import signal

import pytest
import torch
from jaxtyping import install_import_hook

torch.set_num_threads(1)
os.environ["DMBENCH_QUIET"] = "1"
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:  # as in a shell's background job; children would inherit it
    signal.signal(signal.SIGINT, signal.default_int_handler)

_hook = install_import_hook(
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


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Slow tests first, so that no process is left alone with one at the end."""
    items.sort(key=lambda item: item.get_closest_marker("slow") is None)
