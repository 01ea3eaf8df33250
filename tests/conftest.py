"""Shape annotations are checked while the tests run, and only then."""

from __future__ import annotations

import torch
from jaxtyping import install_import_hook

torch.set_num_threads(1)

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
