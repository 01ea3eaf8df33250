"""What the rest of dmbench asks of a data set that it reads.

``storage.dataset.Dataset`` is the one on disk. Training, planning, scoring and viewing are written for this protocol,
so that episodes may come from elsewhere, too: some tests keep theirs in memory.
"""

from __future__ import annotations

from pathlib import Path
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int, UInt8

from dmotion_bench.specs import DatasetRecipe, EnvSpec, EpisodeLabels, SplitName
from dmotion_bench.storage.mcap_reader import Room
from dmotion_bench.storage.messages import StateLabels
from dmotion_bench.storage.tables import EpisodeTable
from dmotion_bench.storage.tasks import ControlTask


@runtime_checkable
class Frames(Protocol):
    """All frames of a data set, one episode after the other (``storage.frame_cache.FrameCache``)."""

    @property
    def offsets(self) -> Int[np.ndarray, " e"]: ...

    @property
    def nbytes(self) -> int: ...

    def checked(self, first: Int[np.ndarray, " b"], length: int) -> UInt8[np.ndarray, "n h w 3"]: ...

    @property
    def frames(self) -> UInt8[np.ndarray, "n h w 3"]: ...


@runtime_checkable
class ReadableDataset(Protocol):
    """Episodes, their labels, splits and control tasks; ``Dataset`` says what each of these is."""

    @property
    def path(self) -> Path: ...

    @property
    def name(self) -> str: ...

    @property
    def recipe(self) -> DatasetRecipe: ...

    @property
    def spec(self) -> EnvSpec: ...

    @property
    def fingerprint(self) -> str: ...

    @property
    def rows(self) -> EpisodeTable: ...

    def __len__(self) -> int: ...

    def cache(self) -> Frames: ...

    def split(self, name: SplitName) -> Int[np.ndarray, " n"]: ...

    def tasks(self) -> list[ControlTask]: ...

    def video(self, episode: int, room: Room | None = None) -> UInt8[np.ndarray, "t h w 3"]: ...

    def states(self, episode: int) -> StateLabels: ...

    def labels(self, episode: int) -> EpisodeLabels: ...
