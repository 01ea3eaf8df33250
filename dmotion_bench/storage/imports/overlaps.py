"""Recordings of one time: copies, or several cameras of one robot, of which one may be a test of what the other trains.

Files that are equal to the byte are refused (``import_plan``). A copy that was compressed anew, repaired or filtered
has other bytes and the same times, and so has the file of another camera.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from dmotion_bench.storage.imports.recording import Named, Survey

_DATES: Final = (
    946_684_800_000_000_000  # [ns] the year 2000: earlier times are of a clock that began with the recording
)
_SHOWN: Final = 2  # pairs in a sentence


def told_of_overlaps(recordings: Sequence[Named], surveys: Sequence[Survey], bags: Mapping[Path, Path]) -> list[str]:
    """What is told of recordings that were made at the same time, for more than half of the shorter one.

    Args:
        recordings: That are imported.
        surveys: Of them.
        bags: See ``search.Found``; parts of one bag are not told of.
    """
    spans = [
        (int(survey.segments[0].times_ns[0]), int(survey.segments[-1].times_ns[-1]), recording.path)
        for recording, survey in zip(recordings, surveys, strict=True)
    ]
    pairs, longest = list[tuple[Path, Path]](), None
    for span in sorted(span for span in spans if span[0] > _DATES):
        if longest is not None:
            shorter = min(span[1] - span[0], longest[1] - longest[0])
            is_one_bag = span[2] in bags and bags[span[2]] == bags.get(longest[2])
            if 2 * (min(span[1], longest[1]) - span[0]) > shorter and not is_one_bag:
                pairs.append((longest[2], span[2]))
        if longest is None or span[1] > longest[1]:
            longest = span
    if not pairs:
        return []
    shown = "; ".join(f"{str(one)!r} and {str(other)!r}" for one, other in pairs[:_SHOWN])
    more = f" ({len(pairs):,} such pairs in all)" if len(pairs) > _SHOWN else ""
    return [
        f"some recordings were made at the same time: {shown}{more}. If they are copies, or several cameras of one "
        "robot, leave out all but one, or test episodes show what is trained on."
    ]
