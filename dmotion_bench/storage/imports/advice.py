"""Advice for imports that give no episode, or a data set that is unlikely to be useful."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Sequence
from typing import Final

import numpy as np

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Survey
from dmotion_bench.storage.imports.timeline import (
    MOST_TICKS,
    Piece,
    gaps_ns,
    interval_ns,
    length_for,
    meant_hz,
    steady_hz,
)
from dmotion_bench.storage.split import FEWEST_EPISODES
from dmotion_bench.wording import duration, durations

SLOWEST_HZ = 0.01  # that '--hz' takes
UNEVEN_STEPS: Final = 4 / 3  # a step of so many times the source frames of another is told of
RARE: Final = 0.02  # fewer steps than this share may differ: no rate is exact


def no_episode(surveys: Sequence[Survey], options: ImportOptions, told: Sequence[str] = ()) -> RecordingImportError:
    """The error for recordings out of which no episode comes, with what helps in their case.

    Args:
        surveys: Of the recordings.
        options: How they were to be imported.
        told: Sentences about what was not imported.
    """
    pictures = sum(survey.pictures for survey in surveys)
    told = [*told, *_told_of(surveys)]
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
    sentences = [*told, *_told_of(surveys), *dict.fromkeys(hint for survey in surveys for hint in survey.hints)]
    sentences += [
        *_delay(surveys, options),
        *_same_times(surveys),
        *_assumed_rate(surveys, options),
        *_uneven_steps(surveys, options),
        *_gaps(surveys, options),
    ]
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


def _told_of(surveys: Sequence[Survey]) -> list[str]:
    """What is told of the recordings, each sentence once."""
    return list(dict.fromkeys(sentence for survey in surveys for sentence in survey.told))


def _delay(surveys: Sequence[Survey], options: ImportOptions) -> list[str]:
    """That pictures were recorded so late that an action goes with those of another step."""
    late = [one for one in surveys if any(segment.commands is not None for segment in one.segments)]
    late = [one for one in late if 2 * one.delay_ns * options.hz > 1e9]
    if not late:
        return []
    delays = [survey.delay_ns / 1e9 for survey in late]
    return [
        f"{late[0].camera!r} was recorded {durations(min(delays), max(delays))} after its own time stamps, more than "
        "half a step, and the actions go with the pictures by the times of recording: if the camera's clock is right, "
        "use '--clock header'."
    ]


def _same_times(surveys: Sequence[Survey]) -> list[str]:
    """That pictures have the time of the one before, as of a topic that was recorded twice."""
    pictures = sum(survey.pictures for survey in surveys)
    same = sum(int((np.diff(one.times_ns) == 0).sum()) for survey in surveys for one in survey.segments)
    if same <= RARE * pictures:
        return []
    return [
        f"{same:,} of {pictures:,} pictures have the time of the one before, and of several with one time the last "
        "counts. If a topic was recorded twice, leave one out."
    ]


def _assumed_rate(surveys: Sequence[Survey], options: ImportOptions) -> list[str]:
    """That nobody knows when the pictures were taken."""
    if not any(survey.is_rate_assumed for survey in surveys):
        return []
    return [
        f"the files do not say how many pictures a second they have; {options.hz:g} was assumed. Say it with "
        "'--source-hz'."
    ]


def _uneven_steps(surveys: Sequence[Survey], options: ImportOptions) -> list[str]:
    """That some steps are much longer than others, because the camera's rate is no multiple of the new one."""
    rates = Counter[float]()
    for times_ns in (segment.times_ns for survey in surveys for segment in survey.segments):
        rate = meant_hz(steady_hz(times_ns))
        shown = rate / options.hz  # source frames a step
        fewest = math.floor(shown)
        if fewest and RARE < shown - fewest < 1 - RARE and fewest + 1 > UNEVEN_STEPS * fewest:
            rates[rate] += len(times_ns)
    if not rates:
        return []
    rate = rates.most_common(1)[0][0]
    fewest = math.floor(rate / options.hz)
    better = " or ".join(f"'--hz {rate / frames:.4g}'" for frames in (fewest + 1, fewest))
    return [
        f"{rate:g} Hz read at {options.hz:g} Hz makes some steps {fewest + 1} pictures long and others {fewest}; "
        f"{better} does not."
    ]


def _gaps(surveys: Sequence[Survey], options: ImportOptions) -> list[str]:
    """That recordings are divided where no picture came for long."""
    if options.max_gap_s is not None:
        return []
    segments = [segment for survey in surveys for segment in survey.segments]
    gaps = np.concatenate([gaps_ns(one.times_ns, hz=options.hz, jumps=one.jumps) for one in segments]) / 1e9
    if not len(gaps):
        return []
    return [
        f"pictures are missing in {len(gaps):,} {'place' if len(gaps) == 1 else 'places'}, for "
        f"{durations(gaps.min(), gaps.max())}, and an episode ends at each; '--max-gap SECONDS' bridges those up to so "
        "long by repeating the picture before."
    ]


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
    given = [(one.commands.times_ns, one.times_ns) for survey in surveys for one in survey.segments if one.commands]
    late = [float(commanded[0] - taken[-1]) / 1e9 for commanded, taken in given if len(commanded) and len(taken)]
    if late and min(late) >= 0:
        return f"no action comes before the last picture, the first one {duration(min(late))} after it."
    seconds = max(float(np.ptp(times)) for times in segments) / 1e9
    if not seconds:
        return (
            "all pictures of a recording have one time. Save those of an MCAP file in a folder, import that, and say "
            "how many there are a second with '--source-hz'."
        )
    shorter = ", or allow shorter episodes with '--min-frames 3'" if options.min_frames > 3 else ""
    longest_one = f"the longest recording takes {duration(seconds)}."
    return f"{longest_one} Raise '--hz', or bridge longer gaps with '--max-gap'{shorter}."
