"""What a table of figures is made of: worlds, models, label budgets, seeds, and how their runs are scored.

A table is data. ``dmbench reproduce NAME`` makes it: it records the worlds, trains the models, scores their runs and
builds the page. Tables reach the core through entry points of the group ``dmbench.tables``; a package of your own adds
one under a name of its own.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Final, TypeVar

import numpy as np

from dmotion_bench.errors import InvalidSetting, UnknownName, UsageError
from dmotion_bench.planning.choices import DEFAULT_SOLVER
from dmotion_bench.planning.columns import TASKS, TaskData, column_named
from dmotion_bench.planning.mpc import STEPS
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.settings import METRICS, Metric
from dmotion_bench.specs import Preset
from dmotion_bench.wording import shown

Kept = TypeVar("Kept")
TRIAL_TASKS, TRIAL_STEPS, TRIAL_EPISODES = 2, 4, 12
"""Of control at preset tiny, which is for trying a table out: no figure of it means anything."""

_SEEDS: Final = range(2**53)
"""Those that every reader of JSON reads exactly."""

ORACLE: Final = "oracle"
"""The reference that is scored before the models, so that it stands beside them."""


@dataclass(frozen=True, kw_only=True)
class World:
    """A data set to be recorded: an environment as its preset says it, but for what is given here.

    Attributes:
        environment: Registry name.
        name: Sets two data sets of one environment apart; part of the folder's name.
        episodes, frames, tasks: In place of the preset's.
        seed: Of the recording.
        settings: ``KEY=VALUE`` for parameters of the environment.
        vary: Factors that differ between episodes.
        policy: Chooses the actions; None for the environment's own.
        control_on: Another recording whose tasks control is scored on; None for this one.
        fixed: Whether it is the same in tables of every size, and named without one. Only at preset tiny, which is a
            trial, it is replaced by a few episodes with the next seed.
    """

    environment: str
    name: str = ""
    episodes: int | None = None
    frames: int | None = None
    tasks: int | None = None
    seed: int = 0
    settings: tuple[str, ...] = ()
    vary: tuple[str, ...] = ()
    policy: str | None = None
    control_on: World | None = None
    fixed: bool = False

    def __post_init__(self) -> None:
        if self.control_on is not None and self.control_on.control_on is not None:
            raise InvalidSetting("control is scored on a world that names another world; name that one at once.")

    @property
    def label(self) -> str:
        """What it is called in output and by ``--worlds``."""
        return f"{self.environment}-{self.name}" if self.name else self.environment

    @classmethod
    def for_tasks(cls, environment: str, data: TaskData, settings: tuple[str, ...] = ()) -> World:
        """The data set of a protocol's tasks, as its own command (``TaskData.words``) records it."""
        return cls(
            environment=environment,
            name=data.label(settings),
            episodes=data.episodes,
            tasks=TASKS,
            seed=data.seed,
            settings=settings,
            fixed=True,
        )

    def trial(self) -> World:
        """A few episodes in its place, which are none of its own and none of those with the seed before."""
        return dataclasses.replace(self, episodes=TRIAL_EPISODES, tasks=TRIAL_TASKS, seed=self.seed + 1)


@dataclass(frozen=True, kw_only=True)
class Entrant:
    """A model with the label budgets that it is trained with.

    Attributes:
        model: Registry name.
        labels: Budgets, as ``--labels`` takes them; those that the model or the data set cannot use are left out.
        arch: None for the model's first.
        settings: ``KEY=VALUE`` of the model or the training.
        on_request: Whether it is left out unless it is named, as by ``--models``.
    """

    model: str
    labels: tuple[str, ...]
    arch: str | None = None
    settings: tuple[str, ...] = ()
    on_request: bool = False

    def __post_init__(self) -> None:
        if not self.labels:
            raise InvalidSetting(f"{self.model} has no label budget in this table; name at least one.")


@dataclass(frozen=True, kw_only=True)
class Column:
    """How the runs of a table are scored.

    Attributes:
        name: Of its page, where it has one of its own.
        metrics: Groups of figures; those that a data set cannot have are left out of its runs.
        frozen: The name of a frozen planner (``planning/columns.py``), which has a report of its own; then the next
            four are left out. ``frozen_column`` makes such a column.
        planner, planner_set, objective, objective_set: Of control, as ``dmbench score`` takes them.
        tasks, steps: Of control: how many tasks (None for all), and actions in each.
        models: The models that are scored; empty for all of the table.
        worlds: The worlds whose runs are scored, by their labels; empty for all of the table.
        references: Of control, to stand beside: ``oracle`` (others are scored with the runs).
    """

    name: str
    metrics: tuple[Metric, ...]
    frozen: str | None = None
    planner: str = DEFAULT_SOLVER
    planner_set: tuple[str, ...] = ()
    objective: str | None = None
    objective_set: tuple[str, ...] = ()
    tasks: int | None = None
    steps: int = STEPS
    models: tuple[str, ...] = ()
    worlds: tuple[str, ...] = ()
    references: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if unknown := [metric for metric in self.metrics if metric not in METRICS]:
            raise UnknownName("group of figures", unknown[0], METRICS)
        if self.frozen is not None and self.metrics != ("control",):
            raise InvalidSetting(f"the column {self.name!r} has a frozen planner, so it is of control alone.")

    @property
    def overwrites(self) -> bool:
        """Whether it takes the place of another planner's control in a run's report."""
        return "control" in self.metrics and self.frozen is None

    def scoring(self, preset: Preset) -> ControlScoring:
        """The settings of control; few tasks and steps where a table is only tried out."""
        tasks, steps = self.tasks, self.steps
        if preset is Preset.TINY:
            tasks, steps = min(tasks or TRIAL_TASKS, TRIAL_TASKS), min(steps, TRIAL_STEPS)
        return ControlScoring(
            tasks=tasks,
            steps=steps,
            planner=self.planner,
            planner_set=self.planner_set,
            objective=self.objective,
            objective_set=self.objective_set,
            column=self.frozen,
        )


def frozen_column(name: str, models: tuple[str, ...] = ()) -> Column:
    """A column of the protocol's table of control, and the oracle beside its models.

    Args:
        name: Of the frozen planner.
        models: That are scored; empty for all of the table.

    Raises:
        UnknownName: There is no such planner.
    """
    frozen = column_named(name).name
    return Column(name=frozen, metrics=("control",), frozen=frozen, models=models, references=(ORACLE,))


@dataclass(frozen=True, kw_only=True)
class Table:
    """A table: every model with each of its budgets and seeds on every world, scored for each column.

    Attributes:
        title: What it is, in a line.
        worlds: To be recorded.
        entrants: To be trained on each of them.
        columns: How they are scored, in this order. Frozen ones have reports of their own. Of the others with control a
            run's report holds one at a time: the last one stays in the runs' folders, and the pages hold all.
        preset: Size of recordings and trainings.
        seeds: Of the trainings.
    """

    title: str
    worlds: tuple[World, ...]
    entrants: tuple[Entrant, ...]
    columns: tuple[Column, ...]
    preset: Preset = Preset.PAPER
    seeds: tuple[int, ...] = (0,)

    def __post_init__(self) -> None:
        for what, given in (("worlds", self.worlds), ("models", self.entrants), ("columns", self.columns)):
            if not given:
                raise InvalidSetting(f"a table needs {what}, and this one ({self.title}) has none.")
        if not self.seeds:
            raise InvalidSetting(f"a table needs seeds, and this one ({self.title}) has none.")
        for seed in self.seeds:
            if type(seed) is not int or seed not in _SEEDS:
                raise InvalidSetting(f"a seed is {shown(seed)}; it must be a whole number from 0 to {_SEEDS[-1]}.")
        for what, names in (
            ("world", [world.label for world in self.worlds]),
            ("column", [column.name for column in self.columns]),
        ):
            if len({*names}) < len(names):
                raise InvalidSetting(f"two {what}s of a table have the same name ({', '.join(names)}).")

    def narrowed(
        self,
        *,
        preset: Preset | None = None,
        seeds: Sequence[int] | None = None,
        models: Sequence[str] | None = None,
        worlds: Sequence[str] | None = None,
        columns: Sequence[str] | None = None,
    ) -> Table:
        """A part of the table, or the table at another size.

        Models on request are in it only if they are named. Where columns are named, models and worlds that none of them
        has are left out, unless these are named, too.

        Raises:
            UnknownName: A model, a world or a column that it does not have.
            UsageError: No model, world or column is named, nothing is left of it, or a seed cannot be one.
        """
        entrants = _chosen("model of this table", models, self.entrants, [one.model for one in self.entrants])
        if models is None:
            entrants = tuple(one for one in entrants if not one.on_request)
        kept = _chosen("world of this table", worlds, self.worlds, [one.label for one in self.worlds])
        names, labels = {one.model for one in entrants}, {one.label for one in kept}
        asked = _chosen("column of this table", columns, self.columns, [one.name for one in self.columns])
        having = tuple(
            column
            for column in asked
            if (not column.models or names & {*column.models}) and (not column.worlds or labels & {*column.worlds})
        )
        if not having:
            raise UsageError("no column of this table has figures of these models in these worlds; name others.")
        if columns is not None and models is None and all(column.models for column in having):
            entrants = tuple(one for one in entrants if any(one.model in column.models for column in having))
        if columns is not None and worlds is None and all(column.worlds for column in having):
            kept = tuple(one for one in kept if any(one.label in column.worlds for column in having))
        given: Any = seeds
        if given is not None and (isinstance(given, str) or not isinstance(given, Iterable)):
            raise UsageError(f"seeds is {shown(seeds)}; give a list of whole numbers, such as [0, 1, 2].")
        named = self.seeds if given is None else tuple(dict.fromkeys(map(_plain, given)))
        if not named:
            raise UsageError("no seed is named; name at least one, such as 0.")
        return dataclasses.replace(
            self,
            worlds=kept,
            entrants=entrants,
            columns=having,
            preset=preset or self.preset,
            seeds=named,
        )


def _plain(seed: Any) -> Any:
    """One of NumPy's whole numbers as Python's own; anything else as it is."""
    return int(seed) if isinstance(seed, np.integer) else seed


def _chosen(kind: str, asked: Sequence[str] | None, given: Sequence[Kept], names: Sequence[str]) -> tuple[Kept, ...]:
    if asked is None:
        return tuple(given)
    asked = [asked] if isinstance(asked, str) or not isinstance(asked, Iterable) else [*asked]
    if not asked:
        raise UsageError(f"no {kind} is named; name at least one: {', '.join(dict.fromkeys(names))}.")
    for name in asked:
        if name not in names:
            raise UnknownName(kind, name, names)
    return tuple(one for one, name in zip(given, names, strict=True) if name in asked)


def powers_of_two(most: int) -> Iterable[str]:
    """Budgets of so many labelled transitions: 1, 2, 4 and so on."""
    count = 1
    while count <= most:
        yield str(count)
        count *= 2
