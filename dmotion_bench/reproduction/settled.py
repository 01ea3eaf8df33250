"""What of a table's scoring is done: reports that are up to date, and entries that stand on a page already.

A run's report holds the control of one planner at a time. So what a run was scored for in an earlier column stands in
the entry on that column's page alone.
"""

from __future__ import annotations

from collections.abc import Container, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import DmbenchError, RunError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.reproduction.plan import Plan, Scoring, Training, is_trained
from dmotion_bench.reproduction.table import Column
from dmotion_bench.scoring.earlier_planning import present_settings
from dmotion_bench.scoring.report import SCORING_VERSION
from dmotion_bench.scoring.score import is_scored, scored_report
from dmotion_bench.scoring.settings import OWN_SETTINGS
from dmotion_bench.specs import Preset
from dmotion_bench.storage.json_file import JsonUnreadable, read_json

ENTRIES: Final = "entries"
"""The folder of a page in which its entries are."""

INDEX: Final = "index.html"
"""The page itself, which is written after its entries."""

Identity = tuple[str, str, str]
"""Of what an entry is of: run, weights, fingerprint of the data set that it was scored on."""


@dataclass(frozen=True, kw_only=True)
class Standing:
    """An entry on a page.

    Attributes:
        path: Its file.
        content: What it holds.
    """

    path: Path
    content: Mapping[str, Any]


class Page:
    """The entries of a column's page, as they stand.

    Args:
        folder: Of the page.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self._standing: dict[Identity, list[Standing]] = {}
        for path in sorted((folder / ENTRIES).glob("*.json")):
            try:
                content = read_json(path)
                where = str(content["run"]), str(content["weights"]), str(content["dataset"]["fingerprint"])
            except (OSError, JsonUnreadable, KeyError, TypeError):
                continue  # a published result, or no entry
            self._standing.setdefault(where, []).append(Standing(path=path, content=content))

    def entry(self, scoring: Scoring, run: Run) -> Path | None:
        """The file of a run's entry, if it has the figures that scoring now would give."""
        dataset = scoring.place.dataset()
        if dataset is None or run.result is None:
            return None
        for one in self._standing.get((run.name, str(run.result["weights"]), dataset.fingerprint), []):
            if _has_figures(one.content, scoring):
                return one.path
        return None

    def is_behind(self) -> bool:
        """Whether there are entries, and no page that was written after them."""
        index = self.folder / INDEX
        written = index.stat().st_mtime_ns if index.is_file() else 0
        entries = (one.path for standing in self._standing.values() for one in standing)
        return any(path.stat().st_mtime_ns > written for path in entries)

    def beside(self, runs: Container[str], preset: Preset) -> list[Path]:
        """The files of entries of other runs, trained at this preset: what other parts of the table have made.

        Args:
            runs: The names of the runs that are meant by none of them.
            preset: Of their trainings, so that a trial stands on no page of the table itself.
        """
        return [
            one.path
            for (run, _, _), entries in self._standing.items()
            for one in entries
            if run not in runs and one.content.get("preset") == preset.value
        ]


def is_of(entry: Path, runs: Iterable[Path]) -> bool:
    """Whether an entry's file is of one of these runs, so that it is written anew."""
    return read_json(entry).get("run") in {run.name for run in runs}


def _has_figures(content: Mapping[str, Any], scoring: Scoring) -> bool:
    metrics, settings, beside = scoring.metrics(), content.get("settings"), content.get("reference")
    if not isinstance(settings, dict) or not isinstance(settings.get("metrics"), list):
        return False  # somebody has changed it
    stored = present_settings(settings)
    wanted = scoring.settings.to_json(metrics)
    mine = {name for name in wanted if name.startswith(tuple(f"{one}_" for one in OWN_SETTINGS))}
    shared = {"split", "precision"} | ({"horizon"} if "rollout" in metrics else set())
    version = content.get("scoring_version") == SCORING_VERSION or not {*metrics} - {*OWN_SETTINGS}
    return (
        version
        and all(metric in stored["metrics"] for metric in metrics)
        and all(stored.get(name) == wanted[name] for name in mine | shared)
        and all(isinstance(beside, dict) and name in beside for name in scoring.references)
    )


@dataclass(frozen=True, kw_only=True)
class State:
    """How far the scoring of a column is.

    Attributes:
        to_train: How many runs are not trained yet, by scoring and training.
        to_score: Runs that lack figures, likewise.
        to_enter: Runs whose report has all figures, and that the page lacks.
        standing: Files of entries on the page.
    """

    to_train: Sequence[tuple[Scoring, Training, int]]
    to_score: Sequence[tuple[Scoring, Training, Path]]
    to_enter: Sequence[Path]
    standing: Sequence[Path]

    def left(self) -> Iterator[tuple[Scoring, Training]]:
        """Each run that is still to be scored."""
        for scoring, training, _ in self.to_score:
            yield scoring, training
        for scoring, training, count in self.to_train:
            yield from [(scoring, training)] * count


def state_of(plan: Plan, column: Column) -> State:
    """How far a column is."""
    page = Page(plan.page(column))
    to_train = [
        (scoring, training, count)
        for scoring in plan.of_column(column)
        for training in scoring.trainings
        if (count := training.left(plan.workspace)[0])
    ]
    to_score: list[tuple[Scoring, Training, Path]] = []
    to_enter: list[Path] = []
    standing: list[Path] = []
    for scoring in plan.of_column(column):
        for training, path in scoring.runs(plan.workspace):
            run = _trained(path)
            if run is None:
                continue
            if (entry := page.entry(scoring, run)) is not None:
                standing.append(entry)
            elif _is_scored(path, scoring):
                to_enter.append(path)
            elif is_trained(path):  # else its training is left
                to_score.append((scoring, training, path))
    return State(to_train=to_train, to_score=to_score, to_enter=to_enter, standing=standing)


def _trained(path: Path) -> Run | None:
    try:
        run = Run.open(path)
    except RunError:
        return None
    return None if run.result is None else run


def _is_scored(path: Path, scoring: Scoring) -> bool:
    return has_figures(path, scoring) and not _lacks_references(path, scoring)


def has_figures(path: Path, scoring: Scoring) -> bool:
    """Whether the report of a run has all figures of a column, whatever references stand beside them."""
    try:
        return is_scored(path, scoring.metrics(), scoring.settings, scoring.data)
    except DmbenchError:
        return False


def _lacks_references(path: Path, scoring: Scoring) -> bool:
    if not scoring.references:
        return False
    column = scoring.settings.control.column
    return not {*scoring.references} <= {*scored_report(path, scoring.settings.split, scoring.data, column).reference}
