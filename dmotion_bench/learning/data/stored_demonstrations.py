"""Labelled transitions for a model: as images in memory if they are few, else made from the stored frames on use."""

from __future__ import annotations

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor

from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.data.labels import DemonstrationFrames
from dmotion_bench.learning.demonstrations import READ_AT_ONCE, Demonstrations
from dmotion_bench.learning.images import to_model


class StoredDemonstrations(Demonstrations):
    """Demonstrations whose images are made when they are asked for.

    Args:
        given: Where their frames are.
        device: Where the images are to be.
        is_contiguous: Whether they are to be contiguous in memory; channels-last otherwise.
    """

    def __init__(self, given: DemonstrationFrames, device: torch.device, is_contiguous: bool = False) -> None:
        fields = {"_given": given, "_contiguous": is_contiguous, "action": as_tensor(given.actions, device)}
        for name, value in fields.items():
            object.__setattr__(self, name, value)  # as the dataclass does: it is frozen

    _given: DemonstrationFrames
    _contiguous: bool

    @property
    def previous(self) -> Float[Tensor, "n c h w"]:
        """All of these images at once, like the other two."""
        return self._all().previous

    @property
    def current(self) -> Float[Tensor, "n c h w"]:
        """See ``previous``."""
        return self._all().current

    @property
    def next(self) -> Float[Tensor, "n c h w"]:
        """See ``previous``."""
        return self._all().next

    def subset(self, index: Int[Tensor, " m"]) -> Demonstrations:
        """These of them, in memory."""
        made = in_memory(self._some(index), self.action.device)
        return made.contiguous() if self._contiguous else made

    def part(self, index: Int[Tensor, " m"]) -> Demonstrations:
        """These of them, as triplets."""
        return StoredDemonstrations(self._some(index), self.action.device, is_contiguous=self._contiguous)

    def _some(self, index: Int[Tensor, " m"]) -> DemonstrationFrames:
        chosen, given = index.cpu().numpy(), self._given
        return DemonstrationFrames(triplets=given.triplets, rows=given.rows[chosen], actions=given.actions[chosen])

    def contiguous(self) -> Demonstrations:
        """The same transitions, their images contiguous in memory."""
        return StoredDemonstrations(self._given, self.action.device, is_contiguous=True)

    def _all(self) -> Demonstrations:
        return self.subset(torch.arange(len(self)))


def in_memory(given: DemonstrationFrames, device: torch.device) -> Demonstrations:
    """Labelled transitions as images on a device."""
    images = to_model(torch.from_numpy(np.ascontiguousarray(given.frames))).to(device)
    return Demonstrations(
        previous=images[:, 0], current=images[:, 1], next=images[:, 2], action=as_tensor(given.actions, device)
    )


def shown_to_models(given: DemonstrationFrames, device: torch.device) -> Demonstrations:
    """Labelled transitions as a model sees them: in memory if there are few."""
    return (in_memory if len(given.actions) <= READ_AT_ONCE else StoredDemonstrations)(given, device)
