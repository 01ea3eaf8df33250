"""What most trainings behind a board have alike: what is measured otherwise is neither averaged nor compared with it.

Entries come from anybody. So nothing is taken from the entry that comes first, or that says the most: a training has
one vote, by the hash of its weights, however many entries name it. What this dmbench's version made goes before what
another one did.
"""

from __future__ import annotations

import json
import math
import statistics
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.scoring.decisive import GAINED
from dmotion_bench.scoring.gain import GAIN_VERSION
from leaderboard.comparison import GAIN_CAPTURED
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.entry import USUAL_PRECISION, Entry, Frames, Planner

RANKED_BY: Final = "mse"
OTHER_FRAMES: Final = "scored on other frames"
"""Marks a row whose errors are not of the frames that most were scored on."""
ROUNDING: Final = 1e-3
"""Relative; between the figures of two scorings of the same reference."""
_T = TypeVar("_T")
_ValueT = TypeVar("_ValueT", bound=Hashable)


def most_common(
    votes: Iterable[tuple[Entry, _ValueT]], *, preferred: Callable[[_ValueT], bool] = lambda _: False
) -> _ValueT | None:
    """The value that most trainings have; of equally common ones the first. None where there is no vote.

    Args:
        votes: Entries with their values.
        preferred: Which values go before all others.
    """
    having: dict[_ValueT, set[str]] = defaultdict(set)
    for entry, value in votes:
        having[value].add(str(entry.content["weights"]))
    return max(having, key=lambda value: (preferred(value), len(having[value])), default=None)


@dataclass(frozen=True, kw_only=True)
class Usual:
    """What most trainings of a board have alike.

    Attributes:
        planner: The planner whose control is compared; None without control.
        settings: Of each figure the settings that it was measured with, where other settings than a board's decide it.
        precision: That models predicted in; float32 where anybody did.
        frames: That errors are of; None where no entry says so.
    """

    planner: Planner | None
    settings: Mapping[str, str]
    precision: str
    frames: Frames | None

    @classmethod
    def of(cls, entries: Iterable[Entry]) -> Usual:
        """That of some entries."""
        entries = list(entries)
        votes: dict[str, list[tuple[Entry, tuple[bool, str]]]] = defaultdict(list)
        for entry in entries:
            for figure in entry.figures:
                votes[figure].append((entry, (_is_present(entry, figure), entry.decisive(figure))))
        chosen = {figure: most_common(sorted(own, key=_text), preferred=_first) for figure, own in votes.items()}
        return cls(
            planner=planner_of(entries),
            settings={figure: text for figure, one in chosen.items() if one is not None for _, text in [one]},
            precision=most_common(
                [(entry, entry.precision) for entry in entries], preferred=lambda one: one == USUAL_PRECISION
            )
            or USUAL_PRECISION,
            frames=most_common((entry, one) for entry in entries if (one := entry.frames.get(RANKED_BY)) is not None),
        )

    @property
    def sequences(self) -> int | None:
        """How many action sequences the gain captured compares; None where no entry says so."""
        told = self.settings.get(GAIN_CAPTURED)
        found = json.loads(told).get(f"{GAINED}sequences") if told else None
        return found if isinstance(found, int) else None

    def leaves_out(self, entry: Entry) -> bool:
        """Whether an entry's errors are not of the frames that most are of."""
        return self.frames is not None and RANKED_BY in entry.figures and entry.frames.get(RANKED_BY) != self.frames

    def compared(self, figures: Mapping[str, _T], entry: Entry, planner: Planner | None) -> dict[str, _T]:
        """The figures of an entry, without those of another planner, and those measured with unusual settings."""
        return {
            name: figure
            for name, figure in figures.items()
            if (entry.planner == planner or not name.startswith(CONTROLLED))
            and self.settings.get(name, "") in ("", entry.decisive(name))
        }


def planner_of(entries: Iterable[Entry]) -> Planner | None:
    """The planner whose control is compared, of those that some entries have; None without control."""
    votes = sorted(
        ((entry, entry.planner) for entry in entries if entry.planner is not None), key=lambda one: str(one[1])
    )
    return most_common(votes, preferred=lambda planner: planner.version == CONTROL_VERSION)


def shared_figures(votes: Iterable[tuple[Entry, str, Mapping[str, Any]]]) -> dict[str, dict[str, Any]]:
    """The figures of predictors that are the same beside every model: of each the median, with its interval.

    Of those that are the same but for rounding, the first is taken.

    Args:
        votes: Entries, the name of a predictor, and its figures in the entry.
    """
    said: dict[str, dict[str, dict[str, Any]]] = defaultdict(lambda: defaultdict(dict))
    for entry, name, figures in votes:
        for figure, value in figures.items():
            said[name][figure].setdefault(str(entry.content["weights"]), value)
    return {
        name: {figure: _middle([*own.values()]) for figure, own in figures.items()} for name, figures in said.items()
    }


def to_tell_apart(names: Sequence[Hashable], trainings: Sequence[int]) -> list[bool]:
    """Which rows need another name, since others have theirs: all but the one with most trainings, if there is one.

    So a single entry renames no row of several trainings, whose name tables, curves and pages find it by.

    Args:
        names: What each row is called so far.
        trainings: How many are behind each.
    """
    having: dict[Hashable, list[int]] = defaultdict(list)
    for name, count in zip(names, trainings, strict=True):
        having[name].append(count)
    told = []
    for name, count in zip(names, trainings, strict=True):
        counts = having[name]
        keeps = count == max(counts) and counts.count(count) == 1
        told.append(not keeps)
    return told


def _middle(said: Sequence[Mapping[str, Any]]) -> Mapping[str, Any]:
    """The first of some figures that is the median but for rounding."""
    known = [one for one in said if one["mean"] is not None]
    if not known:
        return said[0]
    middle = statistics.median_low(float(one["mean"]) for one in known)
    return next(one for one in known if math.isclose(one["mean"], middle, rel_tol=ROUNDING))


def _is_present(entry: Entry, figure: str) -> bool:
    """Whether this version measured a figure, of those that have a version among their settings."""
    return figure != GAIN_CAPTURED or entry.content["settings"].get("gain_version") == GAIN_VERSION


def _first(value: tuple[bool, str]) -> bool:
    return value[0]


def _text(vote: tuple[Entry, tuple[bool, str]]) -> str:
    return vote[1][1]
