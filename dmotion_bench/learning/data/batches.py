"""Batches of triplets on the device that trains or predicts.

On the CPU a batch is gathered from the memory-mapped cache. On a GPU the frames lie in device memory as uint8, and a
batch is one indexed read. All batches of a training share one copy of them (``FramesOnDevice``). Frames of more than
2 GB, or of more than half of the memory that is free, are gathered as on the CPU, since several trainings may share the
GPU (docs/experiments/speed.md).
"""

from __future__ import annotations

import copy
from dataclasses import replace
from typing import Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.data.triplets import BatchOrder, TripletSet
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.images import images_of_triplets, to_model
from dmotion_bench.learning.model import TripletBatch
from dmotion_bench.storage.readable import Frames

RESIDENT = 2 << 30  # bytes of frames that may lie on the device: half of what a training beside others has there
_AT_ONCE = 4096  # frames that are brought to the device


@runtime_checkable
class Batches(Protocol):
    """Turns the numbers of triplets into batches on the device."""

    def __len__(self) -> int: ...

    def expect(self, step: int, rank: int, world: int) -> None: ...

    def __call__(self, index: Int[np.ndarray, " b"]) -> TripletBatch: ...

    def close(self) -> None: ...


def uploaded(array: np.ndarray, device: torch.device) -> Tensor:
    """An array on a device; on its way to a GPU it lies where the CPU need not wait for it."""
    tensor = torch.from_numpy(array)
    return tensor.pin_memory().to(device, non_blocking=True) if device.type == "cuda" else tensor.to(device)


def _on_device(frames: UInt8[np.ndarray, "n h w 3"], device: torch.device) -> Tensor:
    """Memory-mapped frames on a device, brought there piece by piece."""
    held = torch.empty(frames.shape, dtype=torch.uint8, device=device)
    for first in range(0, len(frames), _AT_ONCE):
        held[first : first + _AT_ONCE] = torch.from_numpy(np.array(frames[first : first + _AT_ONCE]))
    return held


class FramesOnDevice:
    """The frames of caches on the device that trains or predicts: of each cache one copy, whoever asks for it.

    Args:
        device: Where the batches are to be.
    """

    def __init__(self, device: torch.device) -> None:
        self.device = device
        self._held: dict[int, tuple[Frames, UInt8[Tensor, "n h w 3"] | None]] = {}  # a cache need not be hashable

    def of(self, cache: Frames) -> UInt8[Tensor, "n h w 3"] | None:
        """All frames of a cache; None where batches are gathered from the cache itself."""
        if id(cache) not in self._held:
            self._held[id(cache)] = cache, _on_device(cache.frames, self.device) if self._fits(cache) else None
        return self._held[id(cache)][1]

    def _fits(self, cache: Frames) -> bool:
        if self.device.type != "cuda":
            return False
        free, _ = torch.cuda.mem_get_info(self.device)
        return bool(cache.nbytes <= min(RESIDENT, free // 2))


class TripletBatches:
    """Turns indices into batches.

    Args:
        triplets: What the indices point into.
        actions: Of each triplet, or None where they were not paid for.
        frames: Where the batches are to be, with the frames that lie there.

    Attributes:
        earlier: So many frames before each triplet come along, and the actions taken there where they were paid for.
    """

    def __init__(
        self,
        triplets: TripletSet,
        actions: Int[np.ndarray, " n"] | Float[np.ndarray, "n a"] | None,
        frames: FramesOnDevice,
    ) -> None:
        self.triplets, self.device, self.earlier = triplets, frames.device, 0
        self._episodes = torch.from_numpy(triplets.episode).to(self.device)
        self._actions = None if actions is None else as_tensor(actions, self.device)
        self._resident = frames.of(triplets.cache)
        self._first = torch.from_numpy(triplets.first_frame).to(self.device)
        self._preceding: Int[np.ndarray, " n"] | None = None

    def __len__(self) -> int:
        return len(self.triplets)

    def expect(self, step: int, rank: int, world: int) -> None:
        """Nothing needs to be read beforehand: every frame is at hand."""

    def close(self) -> None:
        """Nothing is held open."""

    def reaching_back(self, earlier: int) -> TripletBatches:
        """The same batches, with so many frames before each triplet; what is on the device is shared."""
        batches = copy.copy(self)
        batches.earlier = earlier
        if self._actions is not None and earlier:
            batches._preceding = self.triplets.preceding()
        return batches

    def __call__(self, index: Int[np.ndarray, " b"]) -> TripletBatch:
        """The triplets of ``index``, images in [-1, 1], channels-last in memory."""
        rows = uploaded(index, self.device)
        if self._resident is None:
            stored = uploaded(self.triplets.gather(index), self.device)
        else:
            first = self._first[rows]
            stored = self._resident[first[:, None] + torch.arange(3, device=self.device)]
        previous, current, following = images_of_triplets(stored)
        batch = TripletBatch(
            previous=previous,
            current=current,
            next=following,
            action=None if self._actions is None else self._actions[rows],
            episode=self._episodes[rows],
        )
        return self._with_earlier(batch, index) if self.earlier else batch

    def _with_earlier(self, batch: TripletBatch, index: Int[np.ndarray, " b"]) -> TripletBatch:
        """A batch with what came before its triplets."""
        history = np.minimum(self.triplets.step[index] - 1, self.earlier)
        action = None
        if self._actions is not None and self._preceding is not None:
            rows, history = _traced_back(self._preceding, index, self.earlier)
            action = self._actions[uploaded(rows, self.device)]
        return replace(
            batch,
            earlier=self._earlier(index),
            earlier_action=action,
            history=uploaded(history, self.device),
        )

    def _earlier(self, index: Int[np.ndarray, " b"]) -> Float[Tensor, "b k c h w"]:
        """The frames before the triplets of ``index``."""
        places = self.triplets.before(index, self.earlier)
        if self._resident is None:
            stored = uploaded(self.triplets.cache.checked(places.ravel(), 1)[places], self.device)
        else:
            stored = self._resident[uploaded(places, self.device)]
        return to_model(stored)


def _traced_back(
    preceding: Int[np.ndarray, " n"], index: Int[np.ndarray, " b"], count: int
) -> tuple[Int[np.ndarray, "b k"], Int[np.ndarray, " b"]]:
    """The triplets before some triplets, the latest last, and how many there are; the earliest one is repeated."""
    rows, history, traced = index, np.zeros(len(index), np.int64), list[np.ndarray]()
    for _ in range(count):
        before = preceding[rows]
        rows = np.where(before >= 0, before, rows)
        history += before >= 0
        traced.append(rows)
    return np.stack(traced[::-1], axis=1), history


class DemonstrationBatches:
    """Turns the numbers of demonstrations into batches of triplets with actions.

    Args:
        shown: What the numbers point into.
    """

    def __init__(self, shown: Demonstrations) -> None:
        self.shown = shown

    def __len__(self) -> int:
        return len(self.shown)

    def expect(self, step: int, rank: int, world: int) -> None:
        """Nothing needs to be read beforehand."""

    def close(self) -> None:
        """Nothing is held open."""

    def __call__(self, index: Int[np.ndarray, " b"]) -> TripletBatch:
        """The triplets of ``index``."""
        part = self.shown.subset(torch.from_numpy(index))
        return TripletBatch(previous=part.previous, current=part.current, next=part.next, action=part.action)


class LabelsBeside:
    """Batches of video, each with a few labelled triplets beside it: which ones, the step alone decides.

    Several processes share the video of a batch, and each has the same labelled triplets.

    Args:
        video: The batches.
        labelled: The labelled triplets.
        order: Of these.
    """

    def __init__(self, video: Batches, labelled: DemonstrationBatches, order: BatchOrder) -> None:
        self._video, self._labelled, self._order = video, labelled, order
        self._step = 0

    def __len__(self) -> int:
        return len(self._video)

    def expect(self, step: int, rank: int, world: int) -> None:
        """Remember which step is next."""
        self._step = step
        self._video.expect(step, rank, world)

    def close(self) -> None:
        """Close the video."""
        self._video.close()

    def __call__(self, index: Int[np.ndarray, " b"]) -> TripletBatch:
        """The video of ``index``, and the step's labelled triplets."""
        shown = self._labelled.shown.subset(torch.from_numpy(self._order.batch(self._step)))
        return replace(self._video(index), labelled=shown)
