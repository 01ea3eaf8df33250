"""A table as jobs: recordings, trainings and scorings, in folders of a workspace, and which of them are done.

Nothing here does any work. ``dmotion_bench.api.table_work`` does it, and ``cost.py`` says what it takes; both count
the same jobs.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, Final

import torch

from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import DmbenchError, RunError, RunMismatch, UsageError
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.learning.runs.checkpoint import identity
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, default_path, differences, resolve
from dmotion_bench.learning.settings import with_settings
from dmotion_bench.learning.training.beginning import is_finished
from dmotion_bench.learning.training.table import Row
from dmotion_bench.planning.choices import make_objective
from dmotion_bench.registry import model_class
from dmotion_bench.reproduction.recording import ELSEWHERE, Recording
from dmotion_bench.reproduction.table import Column, Entrant, Table, World
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.gain import reason_against
from dmotion_bench.scoring.settings import Metric, ScoreSettings
from dmotion_bench.specs import EnvSpec, Preset, Supervision
from dmotion_bench.workspace import RUN_MANIFEST, Workspace

FEATURE: Final = "feature"
"""The objective of models that draw no frames, whatever a column says."""


@dataclass(frozen=True)
class Training:
    """The runs of a model on a data set with one seed: one job, if they share what needs no labels.

    Attributes:
        recording: What it learns from.
        request: What holds for all of its runs.
        rows: The model under each of its budgets.
        shared: The share of a training that needs no labels, and is done once for all of them.
        labelled: The share that every run needs for itself.
    """

    recording: Recording
    request: TrainingRequest
    rows: tuple[Row, ...]
    shared: float
    labelled: float

    @property
    def model(self) -> str:
        """Registry name."""
        return self.rows[0].model

    @property
    def seed(self) -> int:
        """Of the weights and batches."""
        return self.request.seed

    def runs(self, workspace: Workspace) -> list[Path]:
        """The folders of its runs; empty before the data set is there."""
        dataset = self.recording.dataset()
        if dataset is None:
            return []
        return [default_path(one, resolve(one, dataset), workspace) for one in self._requests()]

    def _requests(self) -> list[TrainingRequest]:
        return [replace(self.request, model=row.model, labels=row.labels) for row in self.rows]

    def others(self, workspace: Workspace) -> dict[Path, str]:
        """In what the runs that stand in its folders differ from what it asks for, by the folders of those that do."""
        dataset, found = self.recording.dataset(), {}
        for request, path in zip(self._requests(), self.runs(workspace), strict=False):
            if dataset is not None and (path / RUN_MANIFEST).exists():
                with contextlib.suppress(RunError):  # its training says what is wrong with the folder
                    found[path] = differences(request, dataset, path)
        return {path: differing for path, differing in found.items() if differing}

    def left(self, workspace: Workspace) -> tuple[int, float]:
        """How many runs are still to be trained, and how many whole trainings that takes."""
        done = sum(is_trained(path) for path in self.runs(workspace))
        missing = len(self.rows) - done
        return missing, (self.shared if not done else 0.0) + self.labelled * missing if missing else 0.0


@dataclass(frozen=True)
class Scoring:
    """The runs of a data set, to be scored for a column with the same settings.

    Attributes:
        column: Of the table.
        recording: What the runs were trained on.
        scored_on: Another recording that they are scored on; None for their own.
        trainings: Whose runs.
        draws_frames: Whether their models do; the others are scored by features.
    """

    column: Column
    recording: Recording
    scored_on: Recording | None
    trainings: tuple[Training, ...]
    draws_frames: bool
    preset: Preset

    @property
    def data(self) -> Path | None:
        """The folder of the other recording, if there is one."""
        return None if self.scored_on is None else self.scored_on.folder

    @property
    def settings(self) -> ScoreSettings:
        """What decides the figures."""
        return ScoreSettings(control=self.control)

    @property
    def control(self) -> ControlScoring:
        """The settings of control."""
        control = self.column.scoring(self.preset)
        if control.objective is None or self.draws_frames or not _finds_objects(control):
            return control
        return replace(control, objective=FEATURE, objective_set=())

    def metrics(self) -> tuple[Metric, ...]:
        """The groups of figures that the data set can have; before it is recorded, all that are asked for."""
        recording, asked = self.place, self.column.metrics
        if recording.recipe.tasks == 0:
            asked = tuple(metric for metric in asked if metric != "control")
        dataset = recording.dataset()
        if "gain" in asked and dataset is not None and reason_against(dataset, "test", self.settings.gain):
            asked = tuple(metric for metric in asked if metric != "gain")
        if not self.draws_frames:
            asked = tuple(metric for metric in asked if metric in ("gain", "control"))
        return asked

    @property
    def references(self) -> tuple[str, ...]:
        """The references that are to stand beside the runs' control."""
        return self.column.references if self.tasks() else ()

    @property
    def place(self) -> Recording:
        """The recording whose episodes and tasks they are scored on."""
        return self.scored_on or self.recording

    def tasks(self) -> int:
        """How many control tasks each run works on; of a data set that is not there yet, as many as are asked for."""
        if "control" not in self.metrics():
            return 0
        dataset = self.place.dataset()
        known = self.place.recipe.tasks if dataset is None else len(dataset.tasks())
        return known if self.control.tasks is None else min(known, self.control.tasks)

    def runs(self, workspace: Workspace) -> list[tuple[Training, Path]]:
        """The folders of the runs, each with its training."""
        return [(training, path) for training in self.trainings for path in training.runs(workspace)]


class Plan:
    """A table in a workspace.

    Args:
        table: Narrowed to what is asked for.
        name: Of the table; its pages are in a folder of this name.
        workspace: Where everything goes.
        whole: What the table was narrowed from, which says where the pages are; None: the table is whole.

    Attributes:
        recordings: The data sets, each once.
        trainings: The jobs of training.
        scorings: By column, in the order of the columns.
    """

    def __init__(self, table: Table, name: str, workspace: Workspace, whole: Table | None = None) -> None:
        self.table, self.name, self.workspace = table, name, workspace
        self._whole = whole or table
        by_world = {world.label: self._recording(world) for world in table.worlds}
        others = {world.label: self._recording(world.control_on) for world in table.worlds if world.control_on}
        self.trainings = [
            training
            for recording in by_world.values()
            for seed in table.seeds
            for entrant in table.entrants
            for training in _trainings(entrant, recording, seed, table.preset)
        ]
        if not self.trainings:
            raise UsageError("no model of this table can use any of its label budgets here; name other models.")
        self.scorings = [
            scoring
            for column in table.columns
            for label, recording in by_world.items()
            if not column.worlds or label in column.worlds
            for scoring in self._scorings(column, recording, others.get(label))
        ]
        used = [*by_world.values(), *(scoring.place for scoring in self.scorings)]
        self.recordings = list({one.folder: one for one in used}.values())

    def require_own(self) -> None:
        """See that the folders of the table hold its data sets and runs, parts of them, or nothing.

        Raises:
            RecipeMismatch: One holds another data set.
            RunMismatch: One holds a run of other settings, or one that learnt from other data.
            DatasetError: What one holds cannot be read.
        """
        for recording in self.recordings:
            recording.require_own()
        others = {path: why for training in self.trainings for path, why in training.others(self.workspace).items()}
        if not others:
            return
        first, differing = next(iter(others.items()))
        more = [path.name for path in others if path != first]
        besides = f" So do {len(more)} more: {', '.join(more)}." if more else ""
        raise RunMismatch(
            f"{str(first)!r} holds another run than the table {self.name!r} asks for: {differing}.{besides} To train "
            f"anew, delete or {ELSEWHERE}."
        )

    def page(self, column: Column) -> Path:
        """The folder of a column's page."""
        own = self.workspace.reports / self.name
        return own if self._one_page else own / column.name

    def pages(self) -> list[tuple[Column, ...]]:
        """The columns of each page, which is built once all of them are scored."""
        columns = self.table.columns
        return [columns] if self._one_page else [(column,) for column in columns]

    @property
    def _one_page(self) -> bool:
        """Whether the reports of a run can hold all columns: each holds control of one planner."""
        return sum(column.overwrites for column in self._whole.columns) <= 1

    def of_column(self, column: Column) -> list[Scoring]:
        """The scorings of a column."""
        return [scoring for scoring in self.scorings if scoring.column is column]

    def _recording(self, world: World) -> Recording:
        preset, size = self.table.preset, self.table.preset.value
        if world.fixed and preset is Preset.TINY:
            world = world.trial()
        elif world.fixed:
            preset, size = Preset.SMALL, ""
        parts = (world.environment.replace(":", "-").replace("/", "-"), world.name, size)
        return Recording(world, preset, self.workspace.data / "-".join(part for part in parts if part))

    def _scorings(self, column: Column, recording: Recording, scored_on: Recording | None) -> Iterator[Scoring]:
        chosen = [
            training
            for training in self.trainings
            if training.recording is recording and (not column.models or training.model in column.models)
        ]
        for draws in (True, False):
            mine = tuple(training for training in chosen if model_class(training.model).needs_pixels is draws)
            if mine:
                other = scored_on if "control" in column.metrics else None
                scoring = Scoring(column, recording, other, mine, draws, self.table.preset)
                if scoring.metrics():
                    yield scoring


def _finds_objects(control: ControlScoring) -> bool:
    """Whether an objective looks for objects in predicted frames, which models that draw none do not have."""
    return bool(getattr(make_objective(control.objective or FEATURE), "finds_objects", False))


def is_trained(path: Path) -> bool:
    """Whether a run is trained to its end and its weights are whole; if not, its training goes on or begins anew."""
    try:
        run = Run.open(path)
        return run.result is not None and _is_whole(path, run.result["weights"], identity(run.best))
    except RunError:
        return False


@cache
def _is_whole(path: Path, _weights: str, _file: tuple[int, int] | None) -> bool:
    """Read the weights of a run once, for it is asked often: again only where another file is there."""
    return is_finished(Run.open(path))


def _trainings(entrant: Entrant, recording: Recording, seed: int, preset: Preset) -> Iterator[Training]:
    kind, actions = model_class(entrant.model), recording.facts.actions
    most = recording.recipe.episodes * (recording.recipe.frames - 1)
    budgets = dict.fromkeys(
        str(budget)
        for labels in entrant.labels
        if (budget := _usable(entrant.model, kind.supervision, labels, actions, most)) is not None
    )
    rows = tuple(Row(model=entrant.model, labels=labels) for labels in budgets)
    request = TrainingRequest(model="", preset=preset, arch=entrant.arch, seed=seed, settings=entrant.settings)
    shared, labelled = shares_of_training(entrant, recording.facts)
    if shared and rows:
        yield Training(recording, request, rows, shared, labelled)
    else:
        for row in rows:
            yield Training(recording, request, (row,), shared, labelled)


def _usable(
    model: str, supervision: Supervision, labels: str, actions: ActionSpec | None, most: int
) -> LabelRequest | None:
    """A budget that the model can use and the data set can pay; else None."""
    try:
        request = LabelRequest.for_model(model, supervision, labels, actions)
    except UsageError:
        return None
    return None if request.kind == "count" and request.amount > most else request


def shares_of_training(entrant: Entrant, facts: EnvSpec) -> tuple[float, float]:
    """How much of a training needs no labels, and how much does; 1 is as many steps as the epochs say."""
    inputs = ModelInputs(height=facts.height, width=facts.width, actions=facts.actions)
    return _shares(model_class(entrant.model), entrant.arch, entrant.settings, inputs)


@cache
def _shares(kind: type[Any], arch: str | None, settings: tuple[str, ...], inputs: ModelInputs) -> tuple[float, float]:
    arch = arch or kind.architectures[0]
    config, _ = with_settings(settings, kind.configure(arch), kind.training_defaults(Preset.SMALL, arch))
    with torch.random.fork_rng():
        model = kind(config, inputs)
    phases = model.phases()
    whole = sum(phase.fraction for phase in phases)
    if kind.supervision is Supervision.NONE:
        return whole, 0.0
    first = 0.0
    for phase in phases:
        if phase.needs_actions or phase.with_labels:
            break
        first += phase.fraction
    return first, whole - first


def epochs_of(training: Training) -> float:
    """Passes over the data of a whole training."""
    kind = model_class(training.model)
    arch = training.request.arch or kind.architectures[0]
    preset = training.request.preset or Preset.SMALL
    _, config = with_settings(training.request.settings, kind.configure(arch), kind.training_defaults(preset, arch))
    return float(config.epochs)


def require_models(table: Table) -> None:
    """Raise what is wrong with a table before any of its work begins.

    Raises:
        DmbenchError: A model or a world is not installed, or a column names a model that the table does not train.
    """
    for entrant in table.entrants:
        model_class(entrant.model)
    names = {entrant.model for entrant in table.entrants}
    for column in table.columns:
        column.scoring(table.preset)
        if column.models and not names & {*column.models}:
            raise DmbenchError(f"the column {column.name!r} names no model that this table trains.")
