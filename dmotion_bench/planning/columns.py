"""The columns of the table of control, and the tasks that it is about: the protocols ``dmbench-2`` to ``dmbench-4``.

A column is a planner that is frozen: a solver and an objective, with every field that differs from its default. It was
chosen on development tasks alone. The tasks of the table are those of a test data set, which is recorded with a seed of
its own and on which nothing may be chosen. A world holds the hash of its test tasks (``HasTestTasks``), so that nobody
can exchange them.

Everything that makes the table reads it from here: the option ``--column``, the leaderboard, and the command that makes
the whole table.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from dmotion_bench.environment import HasTestTasks
from dmotion_bench.errors import DmbenchError, InvalidSetting, UnknownName
from dmotion_bench.planning.choices import generic_objective, make_objective, make_solver
from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.planning.objectives.base import Objective
from dmotion_bench.planning.solvers.base import Solver
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import EnvSpec
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.wording import command

PROTOCOL: Final = "dmbench-2"
"""Of the test tasks, and of the columns that were there from the beginning."""

WITH_RISK: Final = "dmbench-3"
"""The same tasks and columns, and *generic-risk*."""

WITH_BELIEF: Final = "dmbench-4"
"""The same again, and *generic-belief*."""

TASKS: Final = 100
"""Of a development or a test data set; an episode of its own for each, as far as there are enough."""

TRAININGS: Final = 3
"""Of every model between which a ranking is claimed."""


@dataclass(frozen=True, kw_only=True)
class Column:
    """A frozen planner.

    Attributes:
        name: Of the option ``--column``.
        title: Its heading.
        meaning: What it is, in a sentence.
        planner, planner_set: The solver, and ``KEY=VALUE`` for fields that differ from its defaults.
        objective, objective_set: Likewise; without a name the generic objective that suits the model
            (``choices.generic_objective``).
        for_objects: Without a name: that objective's name where there are objects to find.
        protocol: Of reports whose control it planned.
    """

    name: str
    title: str
    meaning: str
    planner: str
    planner_set: tuple[str, ...] = ()
    objective: str | None = None
    objective_set: tuple[str, ...] = ()
    for_objects: str = "tracked"
    protocol: str = PROTOCOL

    def objective_for(self, spec: EnvSpec, *, needs_pixels: bool) -> str:
        """The name of the objective for a model of this kind; arguments as in ``made``."""
        return self.objective or generic_objective(spec, needs_pixels=needs_pixels, for_objects=self.for_objects)

    def made(self, spec: EnvSpec, *, needs_pixels: bool) -> tuple[Solver, Objective]:
        """The solver and the objective for a model of this kind.

        Args:
            spec: The environment's facts.
            needs_pixels: The model's.
        """
        objective = make_objective(self.objective_for(spec, needs_pixels=needs_pixels), self.objective_set)
        return make_solver(self.planner, self.planner_set), objective


COLUMNS: Final[Mapping[str, Column]] = MappingProxyType(
    {
        one.name: one
        for one in (
            Column(
                name="generic-risk",
                title="Generic, with risk",
                meaning="Knows nothing of the scene but that hidden objects are where they were last seen, and that "
                "what the next action makes disappear may be lost.",
                planner="icem",
                planner_set=("cost_at=last",),
                for_objects="tracked-risk",
                protocol=WITH_RISK,
            ),
            Column(
                name="generic-belief",
                title="Generic, with belief",
                meaning="Knows nothing of the scene but that hidden objects are where they were last seen, in imagined "
                "images as well, and where video without labels shows that what vanishes does not come back.",
                planner="icem",
                planner_set=("cost_at=last",),
                for_objects="tracked-belief",
                protocol=WITH_BELIEF,
            ),
            Column(
                name="generic",
                title="Generic",
                meaning="Knows nothing of the scene but that hidden objects are where they were last seen.",
                planner="icem",
                planner_set=("cost_at=last",),
            ),
            Column(
                name="paper",
                title="Paper's",
                meaning="The paper's search and cost: cross-entropy, 50 sequences of 5 actions, 4 iterations, the "
                "centres of what is visible.",
                planner="cem",
                objective="centres",
            ),
            Column(
                name="task-knowledge",
                title="With task knowledge",
                meaning="Rules for objects that are pushed on a table: falls, exploring, ways to a push.",
                planner="icem",
                objective="tabletop",
            ),
        )
    }
)
"""By name, in the order of the table; the first is the headline."""

HEADLINE: Final = next(iter(COLUMNS.values()))
"""The planner that ``dmbench bench`` measures."""


@dataclass(frozen=True, kw_only=True)
class TaskData:
    """A data set that is recorded for its tasks.

    Attributes:
        name: What its role is, ``development`` or ``test``; the data set is called ``ENVIRONMENT-NAME``.
        seed, episodes: Of its recipe; all else is the environment's own.
    """

    name: str
    seed: int
    episodes: int = 600

    def words(self, environment: str) -> str:
        """The command that records it."""
        return command(
            *("dmbench", "record", environment, "--episodes", str(self.episodes), "--tasks", str(TASKS)),
            *("--seed", str(self.seed), "--out", f"data/{environment}-{self.name}"),
        )


DEVELOPMENT: Final = TaskData(name="development", seed=1001)
TEST: Final = TaskData(name="test", seed=2002)


def column_named(name: str) -> Column:
    """A column by its name.

    Raises:
        UnknownName: There is none of this name.
    """
    if name not in COLUMNS:
        raise UnknownName("column of control", name, COLUMNS)
    return COLUMNS[name]


def columns_hash(protocol: str) -> str:
    """The SHA-256 of what a protocol's columns say, and of the version of control, which decides what they mean."""
    told = [
        [one.name, one.planner, list(one.planner_set), one.objective, list(one.objective_set)]
        + [one.for_objects] * (one.for_objects != Column.for_objects)
        for one in COLUMNS.values()
        if one.protocol == protocol
    ]
    return hashlib.sha256(json.dumps([CONTROL_VERSION, told], separators=(",", ":")).encode()).hexdigest()


def tasks_hash(dataset: ReadableDataset) -> str:
    """The SHA-256 of a data set's tasks: each one's episode, its seed, the first frame and the goal's frame."""
    told = [[task.episode, dataset.rows[task.episode].seed, task.start, task.goal] for task in dataset.tasks()]
    return hashlib.sha256(json.dumps(told, separators=(",", ":")).encode()).hexdigest()


def _published(dataset: ReadableDataset) -> str | None:
    """The hash of the test tasks of a data set's world; None for a world without any, or that is not installed."""
    try:
        kind: object = environment_class(dataset.recipe.environment)
    except DmbenchError:
        return None
    return kind.test_tasks.get(dataset.recipe.version) if isinstance(kind, HasTestTasks) else None


def require_fitting_tasks(dataset: ReadableDataset) -> None:
    """Refuse a data set with the seed of the test whose tasks are not those of the protocol.

    Raises:
        InvalidSetting: They differ.
    """
    published = _published(dataset)
    if dataset.recipe.seed == TEST.seed and published is not None and tasks_hash(dataset) != published:
        raise InvalidSetting(
            f"the tasks of {dataset.name!r} are not the test tasks of {PROTOCOL}; record them with "
            f"{TEST.words(dataset.recipe.environment)}."
        )


def is_test(dataset: ReadableDataset) -> bool:
    """Whether a data set's tasks are the test tasks of its environment."""
    published = _published(dataset)
    return published is not None and tasks_hash(dataset) == published
