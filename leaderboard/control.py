"""Check the figures of control: take the entry's actions again in the simulator.

An entry holds the actions of whoever planned, task by task (``actions_of``). The simulator is exact: the same actions
from the same start give the same places, so the distances follow from the actions without any model, and the figures
from the distances. That the model chose these actions, and nobody else, shows where it is asked again: one group of
tasks, which whoever checks draws, is planned anew from the weights, from the first step to the last, each step from
where the entry's own actions have led. An author who let somebody else act in a part of the tasks is found by that
share of the checks.
References that take seconds are scored anew as a whole.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping, Sequence
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import UInt8

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.environment import HasScript
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.agents import Agent, Decision, SimulatorAgent, known_actions
from dmotion_bench.planning.columns import TASKS, is_test
from dmotion_bench.planning.mpc import CONTROL_VERSION, ControlProgress, ControlResult, ControlSettings, control
from dmotion_bench.planning.objectives.base import Taken
from dmotion_bench.planning.solvers.base import PlanContext
from dmotion_bench.planning.tasks import Problem, World, load_problems, task_environment
from dmotion_bench.scoring.control import ControlScoring, agent_of, control_samples, score_control
from dmotion_bench.scoring.earlier_planning import present_planning, present_settings
from dmotion_bench.scoring.prediction import MODEL, Execution
from dmotion_bench.scoring.reference_control import QUICK
from dmotion_bench.scoring.samples import column, vectors
from dmotion_bench.scoring.standing import samples_of
from dmotion_bench.storage.dataset import Dataset
from leaderboard.action_texts import METRIC, are_kept, as_text, is_none, read_action
from leaderboard.comparison import figures_by_samples
from leaderboard.verdict import SHOWN, Findings, short

FIGURES: Final = "control_"
"""How the names of control's figures and settings begin."""

PUBLISHED: Final = "paper"
"""The reference whose figures were printed elsewhere, so that nobody's actions led to them."""

MOST_STEPS: Final = 1000
MOST_GROUP: Final = 64
MOST_PLANNED: Final = 10_000
"""Of samples, steps ahead and whatever else a planner counts: planning more anew would take a machine's memory."""
ROUNDING: Final = 1e-4
"""Relative and absolute; between the distances of two simulations, kept as float32."""


def check_control(
    check: Findings,
    run: Run,
    dataset: Dataset,
    samples: pa.Table | None,
    *,
    anew: bool,
    differing: float,
    draw: int,
    how: Execution,
) -> None:
    """Compare everything that an entry says about control with the simulator and, if asked, with its model.

    Args:
        check: Takes down what is found.
        run: Has the entry's weights.
        dataset: Has its tasks.
        samples: Those of the run's report, if they are there.
        anew: Whether to plan, and to score the quick references, anew.
        differing: Share of the actions that may be planned otherwise, on another kind of processor.
        draw: Seed by which the tasks that are planned anew are drawn.
        how: Device and progress.

    Raises:
        DatasetError, LabelsNotAvailable: The tasks cannot be worked on here.
    """
    content = check.entry.content
    if METRIC not in content["settings"]["metrics"]:
        if content[METRIC]:
            check.wrong.append("control: the entry holds actions, and says that control was not scored")
        _expect_none_besides(check, ())
        return
    scoring = _scoring(check)
    if scoring is None:
        return
    if isinstance(dataset.spec.actions, Continuous) and not are_kept(content[METRIC]):
        check.missing.append(
            "control: the entry was made before continuous actions were kept, so they cannot be repeated; score the "
            "run again with 'dmbench score' and build the entry anew"
        )
        return
    if scoring.column is not None and is_test(dataset):
        _expect_frozen(check, scoring)
    problems = load_problems(dataset, scoring.tasks)
    said = present_planning(content["planning"]) if content.get("planning") else {}
    planning = dict[str, Any]()
    if check.entry.planned_by == CONTROL_VERSION and (said or anew):
        planning = scoring.planning(dataset, needs_pixels=run.model.needs_pixels)
    for part, own in planning.items() if said else ():
        check.expect(f"planning.{part}", said.get(part), own)
    found = dict[str, pa.Table]()
    for name in sorted({MODEL, *content[METRIC]}):
        actions = _actions(check, name, problems, scoring.steps, known_actions(dataset.spec))
        if actions is None:
            continue
        repeater = _Repeater(actions, known_actions(dataset.spec))
        result = _control(repeater, problems, dataset, scoring, how, f"control by {name}, again")
        found[name] = control_samples(name, result)
        if name == MODEL and anew and planning and _can_be_planned(check, planning):
            _plan_anew(check, run, dataset, problems, scoring, actions, differing, draw, how)
    if anew:
        found |= {name: _reference(name, dataset, scoring, how) for name in _quick(dataset)}
    else:
        check.remarks.append("control: the simulator repeated the actions, nothing was planned anew")
    _expect_none_besides(check, (MODEL, *content[METRIC], *(found if anew else QUICK)))
    for name, table in found.items():
        _same_figures(check, name, table)
        if samples is not None:
            _same_rows(check, name, _of(samples_of(samples, (METRIC,)), name, "predictor"), table)


def _expect_none_besides(check: Findings, known: Collection[str]) -> None:
    """Add a finding for each predictor with figures of control that no actions lead to, but for some known ones."""
    for name, own in ((MODEL, check.entry.figures), *check.entry.content["reference"].items()):
        if name not in (*known, PUBLISHED) and any(figure.startswith(FIGURES) for figure in own):
            check.wrong.append(f"control of {name}: the entry has figures, and no actions that lead to them")


def _scoring(check: Findings) -> ControlScoring | None:
    """The settings of control; None if the entry's settings are not possible."""
    given = present_settings(check.entry.content["settings"])
    allowed: dict[str, Callable[[Any], bool]] = {
        "tasks": lambda value: value is None or (type(value) is int and value >= 1),
        "steps": lambda value: type(value) is int and 1 <= value <= MOST_STEPS,
        "planner": lambda value: isinstance(value, str),
        "planner_set": _are_settings,
        "objective": lambda value: value is None or isinstance(value, str),
        "objective_set": _are_settings,
        "seed": lambda value: type(value) is int and value >= 0,
        "group": lambda value: type(value) is int and 1 <= value <= MOST_GROUP,
    }
    wrong = [FIGURES + name for name, is_fine in allowed.items() if not is_fine(given.get(FIGURES + name, ()))]
    if wrong:
        check.wrong += [f"settings.{name} is {short(given.get(name))}, which cannot be" for name in wrong]
        return None
    if check.entry.planned_by != CONTROL_VERSION:
        check.missing.append(
            f"version: control was planned by version {short(check.entry.planned_by)}, this is version "
            f"{CONTROL_VERSION}; what its actions lead to was checked, to have them planned anew use the dmbench that "
            "scored it"
        )
    return ControlScoring.from_json(given)


def _can_be_planned(check: Findings, planning: Mapping[str, Mapping[str, Any]]) -> bool:
    """Whether planning anew stays within bounds; if not, that it was not checked is said."""
    beyond = {
        f"{part}.{name}": value
        for part, own in planning.items()
        for name, value in own.items()
        if type(value) is int and value > MOST_PLANNED
    }
    check.missing += [
        f"control: planning.{name} is {value}; nothing is planned anew with more than {MOST_PLANNED}"
        for name, value in beyond.items()
    ]
    return not beyond


def _expect_frozen(check: Findings, scoring: ControlScoring) -> None:
    """Whether a column planned on the protocol's tasks with the protocol's settings."""
    frozen = ControlScoring(column=scoring.column)
    for name in ("steps", "seed", "group"):
        own, wanted = getattr(scoring, name), getattr(frozen, name)
        if own != wanted:
            check.wrong.append(f"settings.{FIGURES}{name} is {own}; the column {scoring.column!r} has {wanted}")
    if scoring.tasks is not None and scoring.tasks < TASKS:
        check.wrong.append(f"settings.{FIGURES}tasks is {scoring.tasks}; the table is of all {TASKS} test tasks")


def _are_settings(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(one, str) for one in value)


def _actions(
    check: Findings, name: str, problems: Sequence[Problem], steps: int, spec: ActionSpec
) -> dict[int, Taken] | None:
    """The entry's actions by task; None if they do not fit the tasks."""
    said = {one["task"]: one["actions"].split() for one in check.entry.content[METRIC].get(name, ())}
    if list(said) != [problem.number for problem in problems]:
        check.wrong.append(f"control of {name}: the actions are those of other tasks than the first {len(problems)}")
        return None
    actions = {task: [read_action(one, spec) for one in taken] for task, taken in said.items()}
    if name == MODEL and any(is_none(one) for taken in actions.values() for one in taken):
        check.wrong.append(
            "control: a task of the model has a step without an action; a planner takes one at each step"
        )
        return None
    if any(len(taken) != steps or None in taken for taken in actions.values()):
        of = f"of {len(spec)}" if isinstance(spec, Discrete) else f"within {spec}"
        check.wrong.append(f"control of {name}: a task has not {steps} actions {of}")
        return None
    return {task: np.array(taken) for task, taken in actions.items()}


def _same_figures(check: Findings, name: str, table: pa.Table) -> None:
    """The figures and sums that follow from the actions."""
    content = check.entry.content
    said = content["figures"] if name == MODEL else content["reference"].get(name, {})
    resamples = content["settings"]["resamples"]
    mine = figures_by_samples(table, name, said, resamples)
    where = "figures" if name == MODEL else f"reference.{name}"
    own = {figure: value for figure, value in said.items() if figure.startswith(FIGURES)}
    check.expect_figures(f"{where}, from the actions", own, mine, ROUNDING)
    if name == MODEL:
        check.figures |= mine.keys()


def _same_rows(check: Findings, name: str, stored: pa.Table, found: pa.Table) -> None:
    """Compare actions, distances and lost objects step by step."""
    stored, found = (table.sort_by([("task", "ascending"), ("ahead", "ascending")]) for table in (stored, found))
    keys, others = (np.stack([column(table, key) for key in ("task", "ahead")], axis=1) for table in (stored, found))
    if not np.array_equal(keys, others):
        check.wrong.append(f"samples: the stored control of {name} is of other tasks")
        return
    check.samples += len(found)
    wrong = np.zeros(len(found), np.bool_)
    for part in ("metric", "episode", "step", "action"):
        wrong |= column(stored, part) != column(found, part)
    lost, others = (column(table, "control_lost").astype(np.float64) for table in (stored, found))
    wrong |= (lost != others) & ~(np.isnan(lost) & np.isnan(others))  # where pictures judge nothing is known of it
    commands, repeated = vectors(stored, "command"), vectors(found, "command")
    if commands is not None and repeated is not None:
        same = commands.shape == repeated.shape and ((commands == repeated) | np.isnan(commands) & np.isnan(repeated))
        wrong |= ~np.all(same, axis=-1)
    said, mine = (column(table, "control_distance").astype(np.float64) for table in (stored, found))
    wrong |= ~np.isclose(said, mine, rtol=ROUNDING, atol=ROUNDING)
    if wrong.any():
        places = "; ".join(f"task {task}, step {step}" for task, step in keys[wrong][:SHOWN].tolist())
        check.wrong.append(f"samples: {int(wrong.sum())} of the control of {name} are not what happens: {places}")


def _plan_anew(
    check: Findings,
    run: Run,
    dataset: Dataset,
    problems: Sequence[Problem],
    scoring: ControlScoring,
    actions: Mapping[int, Taken],
    differing: float,
    draw: int,
    how: Execution,
) -> None:
    """Plan one group of tasks again; the draw decides which, so no author knows it beforehand."""
    groups = range(0, len(problems), scoring.group)
    first = groups[np.random.default_rng([draw, int(check.entry.content["weights"][:8], 16)]).integers(len(groups))]
    group = problems[first : first + scoring.group]
    model = agent_of(run.model.laid_out(), dataset, scoring, how.device)
    witness = _Repeater(actions, known_actions(dataset.spec), model)
    _control(witness, group, dataset, scoring, how, "control, planned anew")
    tasks = ", ".join(str(problem.number) for problem in group)
    check.remarks.append(f"control: {witness.asked} actions of the tasks {tasks} were planned anew (--draw {draw})")
    if len(witness.otherwise) > differing * witness.asked:
        check.wrong.append(
            f"control: {len(witness.otherwise)} of {witness.asked} actions are not the model's: "
            + "; ".join(witness.otherwise[:SHOWN])
        )
    elif witness.otherwise:
        check.remarks.append(f"control: {len(witness.otherwise)} of {witness.asked} were planned otherwise")


class _Repeater(SimulatorAgent):
    """Repeats recorded actions, and can ask another agent at each step which action it would take.

    Args:
        actions: By task.
        spec: What can be done.
        asked_too: Asked in vain: its action is compared, not taken, so that one that was rounded otherwise does not
            lead all that follow elsewhere.

    Attributes:
        asked: How often.
        otherwise: Where it would have acted otherwise.
    """

    def __init__(self, actions: Mapping[int, Taken], spec: ActionSpec, asked_too: Agent | None = None) -> None:
        self._actions, self._spec, self._agent = actions, spec, asked_too
        self.asked, self.otherwise = 0, list[str]()

    def reset(self, first: UInt8[np.ndarray, "b h w 3"], goals: UInt8[np.ndarray, "b h w 3"]) -> None:
        """The other agent begins."""
        if self._agent is not None:
            self._agent.reset(first, goals)

    def observe(self, actions: Taken, frames: UInt8[np.ndarray, "b h w 3"]) -> None:
        """The other agent sees what the recorded actions lead to."""
        if self._agent is not None:
            self._agent.observe(actions, frames)

    def act_in(self, context: PlanContext, worlds: Sequence[World]) -> Decision:
        """The recorded actions of this step."""
        step = context.observation.step
        taken = np.array([self._actions[world.problem.number][step] for world in worlds])
        if self._agent is None:
            return Decision(action=taken)
        wanted = self._agent.act(context)
        for world, one, other in zip(worlds, taken, wanted.action, strict=True):
            self.asked += 1
            if not self._same(one, other):
                said = f"{as_text(one)}, and it plans {as_text(other)}"
                self.otherwise.append(f"task {world.problem.number}, step {step}: {said}")
        return Decision(action=taken, plan=wanted.plan)

    def _same(self, one: Any, other: Any) -> bool:
        """Whether two actions are the same; numbers are, up to rounding, as shares of their ranges."""
        if isinstance(self._spec, Discrete):
            return bool(one == other)
        one, other = (self._spec.normalise(np.asarray(action)) for action in (one, other))
        return bool(np.allclose(one, other, rtol=0, atol=ROUNDING, equal_nan=True))


def _control(
    agent: Agent,
    problems: Sequence[Problem],
    dataset: Dataset,
    scoring: ControlScoring,
    how: Execution,
    what: str,
) -> ControlResult:
    settings = ControlSettings(steps=scoring.steps, seed=scoring.seed, group=scoring.group)

    def make_env() -> Any:
        return task_environment(dataset.recipe)

    return control(agent, problems, make_env, settings, on_progress=_told(what, how))


def _reference(name: str, dataset: Dataset, scoring: ControlScoring, how: Execution) -> pa.Table:
    """Score a quick reference again, without trusting the results in the data set's cache."""
    return control_samples(
        name, score_control(name, dataset, scoring, progress=_told(f"control by {name}", how), checkpoint=None)
    )


def _told(what: str, how: Execution) -> Callable[[ControlProgress], None]:
    return lambda progress: how.progress(what, progress.steps, progress.total)


def _quick(dataset: Dataset) -> list[str]:
    """The references that take seconds and can act in this environment."""
    (env := task_environment(dataset.recipe)).close()
    return [name for name in QUICK if name != "scripted" or isinstance(env, HasScript)]


def _of(table: pa.Table, value: str, name: str) -> pa.Table:
    return table.filter(pc.equal(table[name], value))
