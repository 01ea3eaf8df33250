"""The columns of the table of control, and the tasks that it is about: the protocols ``dmbench-2`` to ``dmbench-5``.

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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Final

from dmotion_bench.actions import Discrete
from dmotion_bench.environment import HasTestTasks
from dmotion_bench.errors import DmbenchError, InvalidSetting, UnknownName
from dmotion_bench.planning.choices import generic_objective, make_objective, make_solver
from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.planning.objectives.base import Objective
from dmotion_bench.planning.solvers.base import Solver
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import VERSION, DatasetRecipe, EnvSpec
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.wording import command

PROTOCOL: Final = "dmbench-2"
"""Of the test tasks, and of the columns that were there from the beginning."""

WITH_RISK: Final = "dmbench-3"
"""The same tasks and columns, and *generic-risk*."""

WITH_BELIEF: Final = "dmbench-4"
"""The same again, and *generic-belief*."""

FOR_CONTINUOUS: Final = "dmbench-5"
"""The same again, and *generic-wide*, for continuous actions."""

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
        continuous: Whether it is for continuous actions alone.
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
    continuous: bool = False

    def require_suited(self, spec: EnvSpec) -> None:
        """Refuse an environment that the column is not for.

        Raises:
            InvalidSetting: Its actions are discrete, and the column is for continuous ones.
        """
        if self.continuous and isinstance(spec.actions, Discrete):
            raise InvalidSetting(
                f"the column {self.name!r} is for continuous actions, and those of {spec.id!r} are discrete here; use "
                f"{HEADLINE.name!r}."
            )

    def objective_for(self, spec: EnvSpec, *, needs_pixels: bool) -> str:
        """The name of the objective for a model of this kind; arguments and errors as of ``made``."""
        self.require_suited(spec)
        return self.objective or generic_objective(spec, needs_pixels=needs_pixels, for_objects=self.for_objects)

    def made(self, spec: EnvSpec, *, needs_pixels: bool) -> tuple[Solver, Objective]:
        """The solver and the objective for a model of this kind.

        Args:
            spec: The environment's facts.
            needs_pixels: The model's.

        Raises:
            InvalidSetting: The column is not for such actions.
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
                name="generic-wide",
                title="Generic, wide",
                meaning="For continuous actions: as with risk, but its first sequences reach their bounds, and look "
                "ten steps ahead, each action held for two.",
                planner="icem",
                planner_set=("cost_at=last", "initial_std=1", "horizon=10", "hold=2", "samples=25"),
                for_objects="tracked-risk",
                protocol=FOR_CONTINUOUS,
                continuous=True,
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

    def label(self, settings: Sequence[str] = ()) -> str:
        """What its folder is called after the environment; settings as in ``words``."""
        return "-".join([*(setting.partition("=")[2] for setting in settings), self.name])

    def words(self, environment: str, settings: Sequence[str] = ()) -> str:
        """The command that records it.

        Args:
            environment: Registry name.
            settings: ``KEY=VALUE`` for parameters that are not the environment's own.
        """
        return command(
            *("dmbench", "record", environment, *(word for setting in settings for word in ("--set", setting))),
            *("--episodes", str(self.episodes), "--tasks", str(TASKS), "--seed", str(self.seed)),
            *("--out", f"data/{environment}-{self.label(settings)}"),
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


def settings_of(recipe: DatasetRecipe) -> tuple[str, ...]:
    """The settings of a recording as ``KEY=VALUE``, without the version."""
    return tuple(f"{key}={value}" for key, value in sorted(recipe.parameters.items()) if key != VERSION)


def _published(recipe: DatasetRecipe) -> Mapping[str, str]:
    """The hashes of the test tasks of a world, by settings; empty if it has none, or is not installed."""
    try:
        kind: object = environment_class(recipe.environment)
    except DmbenchError:
        return {}
    return kind.test_tasks.get(recipe.version, {}) if isinstance(kind, HasTestTasks) else {}


def require_fitting_tasks(dataset: ReadableDataset) -> None:
    """Refuse a data set with the seed of the test whose tasks are not those of the protocol.

    Raises:
        InvalidSetting: They differ.
    """
    if dataset.recipe.seed == TEST.seed and _published(dataset.recipe) and not is_test(dataset):
        raise InvalidSetting(
            f"the tasks of {dataset.name!r} are not the test tasks of {PROTOCOL}; record them with "
            f"{words_of_test(dataset.recipe)}."
        )


def is_test(dataset: ReadableDataset) -> bool:
    """Whether a data set's tasks are the test tasks of its environment with these settings; nothing varies in them.

    The hash would not tell: where the light varies, the same objects stand in the same places of other pictures.
    """
    published = _published(dataset.recipe).get(" ".join(settings_of(dataset.recipe)))
    return published is not None and not dataset.recipe.vary and tasks_hash(dataset) == published


def words_of_test(recipe: DatasetRecipe) -> str:
    """The command that records the test tasks for what was learned from a recording.

    Args:
        recipe: Of that recording; of its settings those stay with which the world has test tasks.
    """
    own = {*settings_of(recipe)}
    known = [settings for text in _published(recipe) if own.issuperset(settings := text.split())]
    return TEST.words(recipe.environment, max(known, key=len, default=()))
