"""What takes long and is the same for every case is done once, before the first is forked."""

from __future__ import annotations

import contextlib
import importlib
import signal
import sys
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from dmotion_bench.entry_points import LISTED, registered

LOADED = (
    *("torch", "pyarrow.parquet", "av", "rerun", "rerun.blueprint", "lightning_fabric", "PIL.Image", "scipy.stats"),
    *("dmotion_bench.scoring.score", "dmotion_bench.viewing.run", "dmotion_bench.viewing.dataset"),
    *(
        "dmotion_bench.storage.imports.importing",
        "dmotion_bench.storage.exports.lerobot",
        "dmotion_bench.storage.check",
    ),
    "dmotion_bench.recording.restore",
    "dmotion_bench.learning.runs.start",
    "dmotion_bench.learning.training.shared_pretraining",
    *(
        "dmotion_bench.api.sharing",
        "dmotion_bench.cli.app",
        "dmotion_bench.cli.report_table",
        "leaderboard.build",
        "leaderboard.check",
    ),
    *(
        "recorders.grid_world",
        "mcap_ros2.decoder",
        "mcap_protobuf.decoder",
        "PIL.JpegImagePlugin",
        "PIL.PngImagePlugin",
    ),
)
"""What children share, so that none has to load it."""


MODELS = "[dmbench.models]\nfuzz-small = tests.fuzz.small_model:Small\nfuzz-world = tests.fuzz.small_model:SmallWorld\n"


def load_all(site: Path) -> None:
    """Load every module, register the fuzzer's models, and have the command line's parser made.

    Args:
        site: A new folder, for what says that the models are installed.
    """
    register_models(site)
    for name in LOADED:
        importlib.import_module(name)
    import torch
    import typer.main

    from dmotion_bench.cli.app import app, register_commands

    torch.set_num_threads(1)
    signal.signal(signal.SIGINT, signal.default_int_handler)
    register_commands()
    made = typer.main.get_command(app)  # making it takes most of a command's time
    typer.main.get_command = lambda _: made  # type: ignore[assignment]
    _make_converters(made)
    for group in LISTED:
        registered(group)  # is kept


def _make_converters(command: Any) -> None:
    """Have typer make what converts the values of each option; it keeps them."""
    for option in command.params:
        if hasattr(option, "get_runtime_param"):
            option.get_runtime_param()
    for below in getattr(command, "commands", {}).values():
        _make_converters(below)


def load_too(names: Iterable[str]) -> None:
    """Load further modules, as far as they can be found here."""
    for name in names:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def register_models(site: Path) -> None:
    """Put the fuzzer's small models where installed packages are found."""
    facts = site / "dmbench_fuzz-1.dist-info"
    facts.mkdir(parents=True)
    (facts / "METADATA").write_text("Metadata-Version: 2.1\nName: dmbench-fuzz\nVersion: 1\n")
    (facts / "entry_points.txt").write_text(MODELS)
    sys.path.append(str(site))
