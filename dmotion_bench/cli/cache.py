"""The option that chooses a folder for decoded frames, for commands that read frames in random order."""

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
        help=f"Folder for decoded frames. Default: the variable {CACHE_VARIABLE}, or else the data set's folder.",
    ),
]


def use_cache(folder: Path | None) -> None:
    """Keep what is derived from data sets in this folder, in this process and in those that it starts."""
    if folder is not None:
        os.environ[CACHE_VARIABLE] = str(folder.absolute())
