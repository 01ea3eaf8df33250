"""The option that says where decoded frames are kept, for commands that read them at random."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Annotated

import typer

from dmotion_bench.workspace import CACHE_VARIABLE

CacheFolder = Annotated[
    Path | None,
    typer.Option(
        "--cache",
        metavar="DIR",
        help=f"Keep decoded frames there, not in the data set's folder; else as the variable {CACHE_VARIABLE} says.",
    ),
]


def use_cache(folder: Path | None) -> None:
    """Keep what is derived from data sets in this folder, in this process and in those that it starts."""
    if folder is not None:
        os.environ[CACHE_VARIABLE] = str(folder.absolute())
