"""Where things vanish for good: learned from video, without labels.

A thing that is no longer seen is hidden, or it is lost. Which of the two is likely depends on the place: what vanishes
behind an arm comes back, what vanishes at a ledge does not. Video shows it. Of each thing that vanished from one frame
to the next it also shows whether it was seen again before the end of its episode. The chance that it is not, as a
function of the place, is a regression with a Gaussian kernel (Nadaraya 1964, Watson 1964), whose width is the one
under which each episode is likeliest by the others. Nothing is known of tables, falls or arms.

Nadaraya: On Estimating Regression, 1964. Watson: Smooth Regression Analysis, 1964.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Final

import torch
from jaxtyping import Bool, Float, Int, UInt8
from torch import Tensor

from dmotion_bench.planning.objectives.tracking import Tracker

WIDTHS_PX: Final = (1.0, 1.5, 2.0, 3.0, 4.0, 6.0, 8.0, 12.0, 16.0)
"""Of the kernel; the likeliest of them is taken."""

AT_MOST: Final = 2000
"""Things that vanished; if the video shows more, as many of them, evenly spread, are kept."""

_PRIOR: Final = 0.1  # what the mean over all places counts, in things that vanished at the place itself


@dataclass(frozen=True, kw_only=True)
class Vanishings:
    """The things that vanished in some video.

    Attributes:
        place: Where each was seen last (x, y) [px].
        gone: Whether it was not seen again in its episode.
        width: Of the kernel [px].
    """

    place: Float[Tensor, "v 2"]
    gone: Bool[Tensor, " v"]
    width: float

    @classmethod
    def seen_in(cls, video: Iterable[UInt8[Tensor, "t h w 3"]], tracker: Tracker, below: float) -> Vanishings:
        """Watch some episodes.

        Args:
            video: Of each episode.
            tracker: Finds the things.
            below: A thing has vanished if less than this share of what was seen of it is left in the next frame.
        """
        places, ends, episodes = [], [], []
        for number, frames in enumerate(video):
            shown = tracker.look(frames)
            later = shown.seen.flip(0).int().cummax(0).values.flip(0).bool()[1:]
            left = shown.pixels[1:] / shown.pixels[:-1].clamp(min=1)
            vanished = shown.seen[:-1] & (left < below)
            places.append(shown.centre[:-1][vanished])
            ends.append(~later[vanished])
            episodes.append(torch.full((int(vanished.sum()),), number))
        if not places or not sum(map(len, places)):
            return cls(place=torch.zeros(0, 2), gone=torch.zeros(0, dtype=torch.bool), width=WIDTHS_PX[0])
        place, gone, episode = torch.cat(places).float(), torch.cat(ends), torch.cat(episodes)
        kept = torch.linspace(0, len(place) - 1, min(len(place), AT_MOST)).round().long()
        place, gone, episode = place[kept], gone[kept], episode[kept]
        return cls(place=place, gone=gone, width=_likeliest(place, gone, episode))

    def chance(self, place: Float[Tensor, "n k 2"]) -> Float[Tensor, "n k"]:
        """The chance that a thing that vanishes at each place is gone for good; 0 where nothing ever vanished."""
        if not len(self.gone):
            return torch.zeros_like(place[..., 0])
        near = _kernel(place.nan_to_num().reshape(-1, 2), self.place.to(place.device), self.width)
        return _regressed(near, self.gone.to(near)).reshape(place.shape[:-1])


def _kernel(place: Float[Tensor, "n 2"], known: Float[Tensor, "v 2"], width: float) -> Float[Tensor, "n v"]:
    return torch.exp(-torch.cdist(place, known).square() / (2 * width**2))


def _regressed(near: Float[Tensor, "n v"], gone: Float[Tensor, " v"]) -> Float[Tensor, " n"]:
    return (near @ gone + _PRIOR * gone.mean()) / (near.sum(1) + _PRIOR)


def _likeliest(place: Float[Tensor, "v 2"], gone: Bool[Tensor, " v"], episode: Int[Tensor, " v"]) -> float:
    """The width under which what became of each episode's things is likeliest by all other episodes."""
    others, ends = episode[:, None] != episode, gone.float()

    def loss(width: float) -> float:
        chance = _regressed(_kernel(place, place, width) * others, ends).clamp(1e-6, 1 - 1e-6)
        return float(torch.nn.functional.binary_cross_entropy(chance, ends))

    return min(WIDTHS_PX, key=loss)
