"""Which recordings go together by the sizes of their pictures: those of one shape, since all become frames alike."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from typing import Final

from dmotion_bench.storage.imports.recording import Survey

LISTED: Final = 5  # sizes that a sentence names
Size = tuple[int, int]
"""Width and height [px]."""


def have_one_shape(one: Size, other: Size) -> bool:
    """Whether one size is the other one scaled, each side rounded to a whole pixel."""
    (wide, high), (width, height) = sorted((one, other), key=lambda size: size[0] * size[1], reverse=True)
    # a factor f with |f * wide - width| <= 1/2 and |f * high - height| <= 1/2
    return (2 * width - 1) * high <= (2 * height + 1) * wide and (2 * height - 1) * wide <= (2 * width + 1) * high


def usual_size(surveys: Sequence[Survey]) -> tuple[Size, int]:
    """The size that most recordings have, the first of several, and how many have it."""
    return Counter((survey.width, survey.height) for survey in surveys).most_common(1)[0]


def told_of_sizes(surveys: Sequence[Survey], side: int) -> list[str]:
    """That the recordings have several sizes, if they do.

    Args:
        surveys: Of the recordings.
        side: Of a frame [px].
    """
    counts = Counter((survey.width, survey.height) for survey in surveys)
    if len(counts) == 1:
        return []
    listed = ", ".join(f"{width}x{height} ({count:,})" for (width, height), count in counts.most_common(LISTED))
    more = " and others" if len(counts) > LISTED else ""
    return [
        f"the recordings have pictures of {len(counts)} sizes, {listed}{more}, and all become frames of "
        f"{side}x{side} pixels: those of the smaller pictures may be less sharp."
    ]
