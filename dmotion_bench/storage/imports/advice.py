"""Advice for imports that give no episode, or a data set that is unlikely to be useful."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Survey
from dmotion_bench.storage.imports.timeline import MOST_TICKS, Piece, interval_ns, length_for
from dmotion_bench.storage.split import FEWEST_EPISODES

SLOWEST_HZ = 0.01  # that '--hz' takes


def no_episode(surveys: Sequence[Survey], options: ImportOptions, told: Sequence[str] = ()) -> RecordingImportError:
    """The error for recordings out of which no episode comes, with what helps in their case.

    Args:
        surveys: Of the recordings.
        options: How they were to be imported.
        told: Sentences about what was not imported.
    """
    pictures = sum(survey.pictures for survey in surveys)
    return RecordingImportError(
        f"no episode of at least {options.min_frames} frames comes out of {pictures:,} pictures at {options.hz:g} Hz: "
        f"{' '.join([_reason(surveys, options), *told])}"
    )


def advice(
    surveys: Sequence[Survey],
    pieces: list[Piece],
    episodes: int,
    sources: int,
    options: ImportOptions,
    told: Sequence[str] = (),
) -> tuple[str, ...]:
    """Sentences about what would make a better data set of the same recordings.

    Args:
        surveys: Of the recordings.
        pieces: Their stretches without a gap.
        episodes: How many there are in the data set.
        sources: From how many recordings and demonstrations they come.
        options: How it was imported.
        told: Sentences about what was not imported.
    """
    sentences = [*told, *dict.fromkeys(hint for survey in surveys for hint in survey.hints)]
    if episodes < FEWEST_EPISODES:
        length = length_for(
            pieces, episodes=FEWEST_EPISODES, shortest=options.min_frames, most=options.frames_per_episode
        )
        way_out = (
            "import more recordings"
            if length is None
            else f"cut them shorter with '--frames-per-episode {length} --out DIR', or import more recordings"
        )
        sentences.append(
            f"training, validation and test are split by episode and need at least {FEWEST_EPISODES} episodes, here "
            f"are {episodes}: {way_out}."
        )
    if sources < min(episodes, FEWEST_EPISODES):
        few = f"the episodes are parts of {sources} recordings, and {FEWEST_EPISODES} are needed to keep parts together"
        sentences.append(
            f"{'all episodes are parts of one recording' if sources == 1 else few}, so test episodes are parts of what "
            "is trained on. Import more recordings for an honest test."
        )
    return tuple(sentences)


def _reason(surveys: Sequence[Survey], options: ImportOptions) -> str:
    hints = list(dict.fromkeys(hint for survey in surveys for hint in survey.hints))
    if hints:
        return " ".join(hints)
    segments = [segment.times_ns for survey in surveys for segment in survey.segments]
    longest = max(segments, key=len)
    usual_s = interval_ns(longest) / 1e9
    if len(longest) < 3:
        return f"the longest recording has {len(longest)} of them."
    if options.max_gap_s is None and usual_s * options.hz > MOST_TICKS:
        apart = f"they are {usual_s:,.0f} s apart, and a picture is repeated {MOST_TICKS:.0f} times at most."
        if usual_s <= 1 / SLOWEST_HZ:
            return f"{apart} Lower '--hz' to {1 / usual_s:.2g}."
        return f"{apart} If they are to follow one another at each step, save them as files and import their folder."
    given = [one for survey in surveys for one in survey.segments if one.commands is not None and len(one.times_ns)]
    late = [float(one.commands.times_ns[0] - one.times_ns[-1]) / 1e9 for one in given if one.commands is not None]
    if late and min(late) >= 0:
        return f"no action comes before the last picture, the first one {min(late):.3g} s after it."
    seconds = max(float(np.ptp(times)) for times in segments) / 1e9
    shorter = ", or allow shorter episodes with '--min-frames 3'" if options.min_frames > 3 else ""
    return (
        f"the longest recording takes {seconds:.3g} s. Raise '--hz', or bridge longer gaps with '--max-gap'{shorter}."
    )
