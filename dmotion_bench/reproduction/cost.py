"""What is left of a table, as jobs, and what they cost in hours of a core or of a GPU.

The number of jobs is exact: ``dmotion_bench.api.table_work`` runs these. Hours are computed from amounts and speeds;
``ASSUMPTIONS`` says how.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, Final

from dmotion_bench.errors import DmbenchError
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.columns import HEADLINE
from dmotion_bench.planning.solvers.base import Solver
from dmotion_bench.reproduction.plan import Plan, Scoring, Training, epochs_of
from dmotion_bench.reproduction.recording import Recording
from dmotion_bench.reproduction.settled import Page, State, state_of
from dmotion_bench.reproduction.speeds import Speeds
from dmotion_bench.reproduction.table import Column
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.transitions import STARTS_PER_EPISODE
from dmotion_bench.storage.split import TEST_SHARE, VALIDATION_SHARE

PREDICTIONS: Final = 3.0
"""Frames that a model predicts in the time in which it trains on a triplet: the gradient takes twice as long again."""

PLANNED: Final = 50 * 5 * 4
"""Actions in all sequences that the timed planner tries for a control step (``planning_speed.py``)."""

ENTRY_S: Final = 2.0
"""CPU seconds for a run's entry on a page, with its pictures [s]."""

ASSUMPTIONS: Final = (
    "Trainings see all training triplets of a data set (81% of its episodes) in each epoch, whatever the label budget.",
    "A predicted frame takes a third of the time of a trained triplet.",
    f"A model's control step is timed with the planner of the column {HEADLINE.name!r} on a made-up scene. Another "
    "planner takes longer by as much as it tries more actions; differences between objectives are not counted.",
    "The oracle's control step is timed on the first 2 steps of a task; later ones take less.",
    "An entry on a page takes 2 s. Validation, checkpoints and starting processes are not counted.",
    "A training or a scoring that was begun counts as a whole.",
)

_ON_GPU: Final = "; trainings and predictions on the GPU, counted one after the other, though they share it."


@dataclass(frozen=True, kw_only=True)
class Line:
    """Jobs of one kind.

    Attributes:
        kind: ``record``, ``train``, ``oracle``, ``score`` or ``page``.
        what: Of which data set, model or column.
        jobs: How many are left.
        amount: How much work they are, for people.
        core_hours, gpu_hours: That they take; None where no speed could be measured.
    """

    kind: str
    what: str
    jobs: int
    amount: str
    core_hours: float | None = 0.0
    gpu_hours: float | None = 0.0


@dataclass(frozen=True, kw_only=True)
class Cost:
    """What is left of a table.

    Attributes:
        lines: One for each kind of job and what it is of; those with nothing left are in it, too.
        assumptions: What the table lacks here, and how the hours were computed.
        unknown: Sentences about speeds that could not be measured.
    """

    lines: tuple[Line, ...]
    assumptions: tuple[str, ...]
    unknown: tuple[str, ...] = ()

    @property
    def core_hours(self) -> float:
        """Of all jobs."""
        return sum(line.core_hours or 0.0 for line in self.lines)

    @property
    def gpu_hours(self) -> float:
        """Of all jobs."""
        return sum(line.gpu_hours or 0.0 for line in self.lines)

    def jobs(self, kind: str) -> int:
        """Of a kind."""
        return sum(line.jobs for line in self.lines if line.kind == kind)

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON's types."""
        return {
            "lines": [asdict(line) for line in self.lines],
            "core_hours": self.core_hours,
            "gpu_hours": self.gpu_hours,
            "assumptions": list(self.assumptions),
            "unknown": list(self.unknown),
        }


def cost_of(plan: Plan, speeds: Speeds) -> Cost:
    """What is left of a table, and what it costs. Only speeds of what is left are measured.

    Args:
        plan: The table in its workspace.
        speeds: Of this machine.
    """
    return _Estimate(plan, speeds).cost()


class _Estimate:
    def __init__(self, plan: Plan, speeds: Speeds) -> None:
        self.plan, self.speeds = plan, speeds
        self.gpu = speeds.device.type == "cuda"
        self.lines: list[Line] = []
        self.unknown: list[str] = []

    def cost(self) -> Cost:
        for recording in self.plan.recordings:
            self._record(recording)
        for model in dict.fromkeys(training.model for training in self.plan.trainings):
            self._train(model)
        for column in self.plan.table.columns:
            state = state_of(self.plan, column)
            for reference in column.references:
                self._reference(column, reference, state)
            self._score(column, state)
        self._pages()
        told = f"Speeds are {self.speeds.told}" + (_ON_GPU if self.gpu else ".")
        table = self.plan.table
        left_out = [
            f"The column {column.name!r} is left out: nothing of it can be scored at preset {table.preset.value} with "
            "these models."
            for column in table.columns
            if not self.plan.of_column(column)
        ]
        return Cost(lines=tuple(self.lines), assumptions=(*left_out, told, *ASSUMPTIONS), unknown=tuple(self.unknown))

    def _add(
        self, kind: str, what: str, jobs: int, amount: str, seconds: Callable[[], float], *, gpu: bool = False
    ) -> None:
        """A line; the speed is asked for where there is anything left."""
        hours: float | None = 0.0
        if jobs:
            try:
                hours = seconds() / 3600
            except DmbenchError as error:
                hours = None
                self.unknown.append(f"{kind} {what}: {error}")
        own = {"gpu_hours" if gpu else "core_hours": hours}
        self.lines.append(Line(kind=kind, what=what, jobs=jobs, amount=amount if jobs else "", **own))

    def _record(self, recording: Recording) -> None:
        jobs, recipe = recording.shards_left(), recording.recipe
        episodes = min(recipe.episodes, jobs * recipe.shard_episodes)

        def seconds() -> float:
            known = self.speeds.episodes(recording)
            return episodes * known.frames / known.frames_per_s

        self._add("record", recording.world.label, jobs, f"{episodes:,} episodes", seconds)

    def _train(self, model: str) -> None:
        mine = [training for training in self.plan.trainings if training.model == model]
        left = [(training, *training.left(self.plan.workspace)) for training in mine]
        left = [one for one in left if one[1]]
        runs = sum(count for _, count, _ in left)
        whole = sum(trainings for _, _, trainings in left)

        def seconds() -> float:
            total = 0.0
            for training, _, trainings in left:
                triplets = epochs_of(training) * trainings * self._triplets(training)
                total += triplets / self.speeds.triplets_per_s(model, training.request.arch)
            return total

        amount = f"{_counted(runs, 'run')}, {_counted(whole, 'whole training')}"
        self._add("train", model, len(left), amount, seconds, gpu=self.gpu)

    def _reference(self, column: Column, reference: str, state: State) -> None:
        places = control_places(state)

        def seconds() -> float:
            return sum(
                one.tasks() * one.control.steps / self.speeds.oracle_steps_per_s(one.place, one.control)
                for one in places
            )

        amount = f"{sum(one.tasks() for one in places)} tasks"
        self._add(reference, column.name, sum(map(groups_of_tasks, places)), amount, seconds)

    def _score(self, column: Column, state: State) -> None:
        runs = list(state.left())
        groups = sum(groups_of_tasks(scoring) for scoring, _ in runs)

        def seconds() -> float:
            return sum(self._scoring_seconds(*run) for run in runs)

        amount = _counted(len(runs), "run") + (f", {_counted(groups, 'group')} of control tasks" if groups else "")
        self._add("score", column.name, len(runs) + groups, amount, seconds, gpu=self.gpu)

    def _scoring_seconds(self, scoring: Scoring, training: Training) -> float:
        recording, metrics, frames = scoring.place, scoring.metrics(), 0.0
        episodes = TEST_SHARE * recording.recipe.episodes
        if "prediction" in metrics:
            frames += episodes * max(0.0, self._length(recording) - 2)
        if "rollout" in metrics:
            frames += episodes * STARTS_PER_EPISODE * scoring.settings.horizon
        if "gain" in metrics:
            gain = scoring.settings.gain
            frames += gain.moments * gain.sequences * gain.horizon
        model, seconds = training.model, 0.0
        if frames:
            seconds += frames / (PREDICTIONS * self.speeds.triplets_per_s(model, training.request.arch))
        if "control" in metrics:
            steps, share = scoring.tasks() * scoring.control.steps, planned(scoring.control) / PLANNED
            seconds += steps * share / self.speeds.control_steps_per_s(model)
            seconds += steps / self.speeds.episodes(recording).frames_per_s
        return seconds

    def _pages(self) -> None:
        left, entries = 0, 0
        for columns in self.plan.pages():
            states = [state_of(self.plan, column) for column in columns]
            by_report = list(zip([column.frozen for column in columns], states, strict=True))  # an entry for each
            known = {(report, path) for report, state in by_report for _, _, path in state.to_score}
            known |= {(report, path) for report, state in by_report for path in state.to_enter}
            unknown = {(report, id(one)): count for report, state in by_report for _, one, count in state.to_train}
            missing = len(known) + sum(unknown.values())
            left += bool(missing) or Page(self.plan.page(columns[0])).is_behind()
            entries += missing
        self._add("page", self.plan.name, left, f"{entries} entries", lambda: ENTRY_S * entries)

    def _length(self, recording: Recording) -> float:
        """Frames in an episode: counted where the data set is there."""
        dataset = recording.dataset()
        return float(dataset.lengths.mean()) if dataset is not None else self.speeds.episodes(recording).frames

    def _triplets(self, training: Training) -> float:
        """Of an epoch."""
        recording = training.recording
        share = (1 - TEST_SHARE) * (1 - VALIDATION_SHARE)
        return share * recording.recipe.episodes * max(0.0, self._length(recording) - 2)


def _counted(count: float, what: str) -> str:
    return f"{count:,.4g} {what}" + ("" if count == 1 else "s") if count < 1000 else f"{count:,.0f} {what}s"


def planned(scoring: ControlScoring) -> float:
    """Actions in all sequences that a planner tries, on average, for a control step; ``PLANNED`` if it does not say."""
    solver: Solver = make_solver(scoring.planner, scoring.planner_set)
    parts: Sequence[float] = [getattr(solver, name, 0) for name in ("samples", "horizon", "iterations")]
    samples, horizon, iterations = parts
    return samples * horizon * (iterations or 1) / getattr(solver, "replan_every", 1) or PLANNED


def control_places(state: State) -> list[Scoring]:
    """One scoring of each data set on which runs are still to be scored for control, as references are scored.

    What a reference draws is true, so the column's objective judges it, whatever the models draw.
    """
    return list({one.place.folder: replace(one, draws_frames=True) for one, _ in state.left() if one.tasks()}.values())


def groups_of_tasks(scoring: Scoring) -> int:
    """How many jobs the control of a run, or of a reference, is."""
    return -(-scoring.tasks() // scoring.control.group)
