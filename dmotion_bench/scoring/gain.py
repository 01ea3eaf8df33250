"""Gain captured: the share of what could be gained at a moment that a model's favourite sequence brings.

At fixed moments of held-out episodes (``planning/moments.py``) a model imagines a fixed set of action sequences. The
one whose last imagined state costs least is carried out in the simulator, and its true gain is divided by that of the
best sequence::

    planning_gain = sum over moments of the pick's true gain / sum over moments of the best true gain

There is no search in it and no control loop, so it says what a model's predictions are worth to a planner. Picking at
random gives the reference ``random``: the mean gain of the sequences. The reference ``oracle`` picks with the true
frames in place of imagined ones: what it leaves out is the objective's to blame, not a model's.

The true gains and what the references pick depend on the data set alone, so they are kept in its ``cache/``.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import logging
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
from jaxtyping import Float, Int, UInt8

from dmotion_bench.actions import ActionSpec, Continuous, Discrete, as_actions
from dmotion_bench.errors import DmbenchError, InvalidSetting, LabelsNotAvailable
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import known_actions, no_action
from dmotion_bench.planning.choices import generic_objective, make_objective, objective_configuration, present_name
from dmotion_bench.planning.dynamics.base import Dynamics, Observation
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.dynamics.simulator import Simulation, SimulatorDynamics
from dmotion_bench.planning.moments import Moment, carried_out, find_moment, fixed_sequences
from dmotion_bench.planning.objectives.base import Objective, taught
from dmotion_bench.planning.objectives.checked import checked_reset
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.planning.solvers.rollouts import Rollouts
from dmotion_bench.planning.solvers.search import Search
from dmotion_bench.planning.tasks import Judge, as_problems, has_recorded_goals, judge_of, task_environment
from dmotion_bench.scoring.kept_gain import Truth, keep, kept
from dmotion_bench.scoring.prediction import MODEL, Execution
from dmotion_bench.scoring.samples import GAIN, SampleRows, action_column
from dmotion_bench.specs import IMPORTED, SplitName, delay_of
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.tasks import (
    FEWEST_INTERACTIONS,
    GOAL_DISTANCE,
    Candidate,
    ControlTask,
    candidates,
    choose_tasks,
)
from dmotion_bench.values import require_bounds
from dmotion_bench.wording import shown
from dmotion_bench.workspace import cache_folder

GAIN_VERSION: Final = 1
"""The version of the gain: of the moments, the sequences and the pick. Raise it when any of them changes."""

GROUP: Final = 4
"""Moments side by side; it only decides which numbers are rounded together."""

MOST: Final = 100_000
"""Of moments, and of actions in all sequences of one together; and the largest seed."""

_LOG = logging.getLogger(__name__)
_DECISIVE: Final = ("moments", "sequences", "horizon", "seed")

RANDOM: Final = "random"
ORACLE: Final = "oracle"


@dataclass(frozen=True, kw_only=True)
class GainScoring:
    """The settings that decide the gain captured, besides the weights and the data.

    Attributes:
        moments: At most so many, each of a stretch of an episode of its own as long as there are enough episodes.
        sequences: How many are compared at each moment.
        horizon: Actions in a sequence.
        objective: The objective's name; None for the generic one that suits (``generic_objective``).
        objective_set: ``KEY=VALUE`` for fields of a named objective that differ from their defaults.
        seed: Of the sequences.
    """

    moments: int = 100
    sequences: int = 64
    horizon: int = 5
    objective: str | None = None
    objective_set: tuple[str, ...] = ()
    seed: int = 0

    def __post_init__(self) -> None:
        require_bounds(self, from_one=("moments", "sequences", "horizon"), from_zero=("seed",))
        if self.objective is not None:
            object.__setattr__(self, "objective", present_name(self.objective))
            make_objective(self.objective, self.objective_set)
        elif self.objective_set:
            raise InvalidSetting(
                f"{', '.join(self.objective_set)} is set, and no objective is named; name one with '--objective'."
            )

    def to_json(self) -> dict[str, Any]:
        """The settings as a report stores them: with a prefix, and with the version of the gain."""
        own = asdict(self) | {"version": GAIN_VERSION}
        return {f"{GAIN}_{name}": list(one) if isinstance(one, tuple) else one for name, one in own.items()}

    @classmethod
    def from_json(cls, settings: Mapping[str, Any]) -> GainScoring:
        """Read the settings back from those of a report.

        Raises:
            InvalidSetting, KeyError: They cannot be.
        """
        read: dict[str, Any] = {one.name: settings[f"{GAIN}_{one.name}"] for one in fields(cls)}
        for name in _DECISIVE:
            if type(read[name]) is not int or not 0 <= read[name] <= MOST:
                raise InvalidSetting(f"{name} is {shown(read[name])}; it is a number up to {MOST}.")
        if read["sequences"] * read["horizon"] > MOST:
            raise InvalidSetting(f"sequences times horizon is {read['sequences'] * read['horizon']}, more than {MOST}.")
        named, chosen = read["objective"], read["objective_set"]
        if not isinstance(named, str | None) or not isinstance(chosen, list):
            raise InvalidSetting(f"the objective is {shown(named)} with {shown(chosen)}; it is a name and settings.")
        return cls(**read | {"objective_set": tuple(map(str, chosen))})


def gain_tables(
    model: ForwardModel[Any], dataset: ReadableDataset, split: SplitName, scoring: GainScoring, how: Execution
) -> list[pa.Table]:
    """The samples of a model's picks and of the references'.

    Args:
        model: Aligned, in evaluation mode, on the device.
        dataset: With labels.
        split: Whose episodes' moments are taken.
        scoring: How many moments and sequences.
        how: Device and progress.

    Raises:
        LabelsNotAvailable: There is nothing to be gained, see ``reason_against``.
        InvalidSetting: The objective needs what the environment lacks.
    """
    truth = known_truth(dataset, split, scoring, how)
    name = scoring.objective or generic_objective(dataset.spec, needs_pixels=model.needs_pixels)
    objective = taught(make_objective(name, scoring.objective_set), dataset)
    dynamics = ModelDynamics(model, bf16=False, device=how.device)
    groups, found = _groups(truth.moments), []
    for done, group in enumerate(groups):
        found.append(_picks(dynamics, objective, dataset, group, truth.sequences))
        how.progress("gain captured", done + 1, len(groups))
    picks = np.concatenate(found)
    return [
        _samples(who, known_actions(dataset.spec), truth, picked)
        for who, picked in ((RANDOM, None), (ORACLE, truth.oracle), (MODEL, picks))
    ]


def reason_against(dataset: ReadableDataset, split: SplitName, scoring: GainScoring) -> str | None:
    """Why a data set has no gain captured; None where it has one."""
    if dataset.recipe.environment == IMPORTED:
        return "the recordings were imported, so there is no simulator in which anything could be tried"
    if dataset.spec.actions is None:
        return "the actions are not known"
    if (known := _kept(dataset, split, scoring)) is not None:
        return None if known.moments else _in_vain(split, scoring)
    try:
        (env := task_environment(dataset.recipe)).close()
    except DmbenchError as error:
        return f"its simulator is not here: {error}"
    if judge_of(env) is Judge.PICTURES:
        return "the environment does not tell how far it is from a goal"
    if not _stretches(dataset, split, scoring.moments):
        return (
            f"no {split} episode has a stretch of up to {GOAL_DISTANCE} steps in which objects are moved in "
            f"{FEWEST_INTERACTIONS} steps and none is lost"
        )
    return None


def require_gain(dataset: ReadableDataset, split: SplitName, scoring: GainScoring) -> None:
    """Raise an error where there is no gain captured.

    Raises:
        LabelsNotAvailable: Says why.
    """
    reason = reason_against(dataset, split, scoring)
    if reason is not None:
        raise _lacking(dataset, reason)


def _lacking(dataset: ReadableDataset, reason: str) -> LabelsNotAvailable:
    return LabelsNotAvailable(f"{dataset.name!r} has no gain captured: {reason}; leave it out of '--metrics'.")


def reason_after_trying(dataset: ReadableDataset, split: SplitName, scoring: GainScoring, how: Execution) -> str | None:
    """As ``reason_against``, where all has been tried out in the simulator that was not known before."""
    if (reason := reason_against(dataset, split, scoring)) is not None:
        return reason
    with contextlib.suppress(LabelsNotAvailable):
        known_truth(dataset, split, scoring, how)
    return reason_against(dataset, split, scoring)


def known_truth(dataset: ReadableDataset, split: SplitName, scoring: GainScoring, how: Execution) -> Truth:
    """What truly could be gained, out of the cache or by trying it out in the simulator.

    Raises:
        LabelsNotAvailable: There is nothing to be gained. That is kept, too.
    """
    if (known := _kept(dataset, split, scoring)) is None:
        key = _key(dataset, split, scoring)
        if (place := _place(dataset, key)).is_file():
            _LOG.warning("%s is damaged; what can be gained is tried out anew.", shown(str(place)))
        require_gain(dataset, split, scoring)
        known = _tried_out(dataset, split, scoring, how)
        keep(place, key, known)
    if not known.moments:
        raise _lacking(dataset, _in_vain(split, scoring))
    return known


def _tried_out(dataset: ReadableDataset, split: SplitName, scoring: GainScoring, how: Execution) -> Truth:
    """What the simulator says; without a moment where no sequence brings anything."""
    sequences = _sequences(dataset, scoring)
    problems = as_problems(dataset, dict(enumerate(_stretches(dataset, split, scoring.moments))))
    found = []
    for done, problem in enumerate(problems):
        recorded = dataset.states(problem.task.episode).actions[problem.task.start :]
        found.append(find_moment(problem, recorded, sequences, lambda: task_environment(dataset.recipe)))
        how.progress("what can be gained", done + 1, len(problems))
    moments = [moment for moment in found if moment is not None]
    return Truth(
        sequences=sequences,
        moments=moments,
        oracle=_by_true_frames(dataset, scoring, moments, sequences),
        recorded_goals=has_recorded_goals(dataset.recipe),
    )


def _in_vain(split: SplitName, scoring: GainScoring) -> str:
    return (
        f"none of {scoring.sequences} action sequences brings an object nearer to its goal at any moment of the "
        f"{split} episodes that was tried (more episodes give more moments)"
    )


def _sequences(dataset: ReadableDataset, scoring: GainScoring) -> Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"]:
    return fixed_sequences(known_actions(dataset.spec), scoring.sequences, scoring.horizon, scoring.seed)


def _stretches(dataset: ReadableDataset, split: SplitName, count: int) -> list[ControlTask]:
    """The stretches of a split's episodes that could be control tasks, chosen as those are."""
    found: dict[int, tuple[Candidate, ...]] = {}
    for episode in dataset.split(split).tolist():
        states = dataset.states(episode)
        positions, delay = states.objects.position, delay_of(states.factors)
        found[episode] = candidates(positions, states.pushed, dataset.spec.push_threshold, delay=delay)
    return choose_tasks(found, found, count)


def _groups(moments: Sequence[Moment]) -> list[Sequence[Moment]]:
    return [moments[first : first + GROUP] for first in range(0, len(moments), GROUP)]


def _picks(
    dynamics: Dynamics,
    objective: Objective,
    dataset: ReadableDataset,
    moments: Sequence[Moment],
    sequences: Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"],
) -> Int[np.ndarray, " b"]:
    """The sequence of each moment whose last imagined state costs least."""
    problems = [moment.problem for moment in moments]
    goals = np.stack([problem.goal_frame for problem in problems])
    seen = [_seen(dataset, moment) for moment in moments]
    evaluator = checked_reset(objective, dataset.spec, np.stack([frames[0] for frames in seen]), goals)
    spec, longest = known_actions(dataset.spec), max(map(len, seen))
    recorded = [dataset.states(problem.task.episode).actions[problem.task.start :] for problem in problems]
    current = np.stack([frames[0] for frames in seen])
    for step in range(1, longest):  # who has seen less begins later
        actions = no_action(spec, len(moments))
        for place, frames in enumerate(seen):
            own = step - (longest - len(frames))
            if own > 0:
                actions[place], current[place] = recorded[place][own - 1], frames[own]
        evaluator.observe(actions, current.copy())
    previous = np.stack([_before(frames) for frames in seen])
    observation = Observation(previous=previous, current=current, goals=goals, step=longest - 1)
    search: Search = (
        PrefixTree(dynamics, evaluator, observation, sequences.shape[1])
        if isinstance(spec, Discrete)
        else Rollouts(dynamics, evaluator, observation)
    )
    costs = search.costs(np.broadcast_to(sequences, (len(moments), *sequences.shape)))
    picked: Int[np.ndarray, " b"] = costs[..., -1].argmin(axis=1)
    return picked


def _seen(dataset: ReadableDataset, moment: Moment) -> UInt8[np.ndarray, "t h w 3"]:
    """What is seen from a stretch's start to the moment."""
    start = moment.problem.task.start
    frames: UInt8[np.ndarray, "t h w 3"] = dataset.video(moment.problem.task.episode)[start : start + moment.offset + 1]
    return frames


def _before(frames: UInt8[np.ndarray, "t h w 3"]) -> UInt8[np.ndarray, "h w 3"]:
    """The last frame that differs from the present one, as in control; else the present one."""
    differing = np.flatnonzero((frames != frames[-1]).any(axis=(1, 2, 3)))
    before: UInt8[np.ndarray, "h w 3"] = frames[differing[-1] if len(differing) else -1]
    return before


def _by_true_frames(
    dataset: ReadableDataset,
    scoring: GainScoring,
    moments: Sequence[Moment],
    sequences: Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"],
) -> Int[np.ndarray, " m"]:
    """The picks of somebody who foresees the true frames, and judges them by the same objective."""
    objective = taught(_frame_objective(dataset, scoring)[1], dataset)
    picks = []
    for moment in moments:
        env = task_environment(dataset.recipe)
        try:
            simulation, problem = Simulation(env, moment.problem, pictures=True), moment.problem
            walked = as_actions(dataset.states(problem.task.episode).actions[problem.task.start :])[: moment.offset]
            simulation.here = carried_out(simulation, simulation.here, walked)
            dynamics = SimulatorDynamics([simulation], known_actions(dataset.spec))
            picks.append(_picks(dynamics, objective, dataset, [moment], sequences))
        finally:
            env.close()
    return np.concatenate(picks) if picks else np.zeros(0, np.int64)


def _frame_objective(dataset: ReadableDataset, scoring: GainScoring) -> tuple[str, Objective]:
    """By which the true frames are judged, and its name; one that looks at a model's features has none to look at."""
    if scoring.objective is None or scoring.objective == "feature":
        name = generic_objective(dataset.spec, needs_pixels=True)
        return name, make_objective(name)
    return scoring.objective, make_objective(scoring.objective, scoring.objective_set)


def _samples(who: str, spec: ActionSpec, truth: Truth, picks: Int[np.ndarray, " m"] | None) -> pa.Table:
    """One row a moment; without picks the mean over all sequences."""
    rows, moments = SampleRows(GAIN, who), truth.moments
    gains = np.stack([moment.gains for moment in moments])
    taken = None if picks is None else truth.sequences[picks, 0]
    if taken is not None and isinstance(spec, Continuous):
        taken = spec.denormalise(taken)
    rows.add(
        {
            "episode": np.array([moment.problem.task.episode for moment in moments]),
            "step": np.array([moment.problem.task.start + moment.offset for moment in moments]),
            "ahead": np.full(len(moments), truth.sequences.shape[1]),
            "gain": gains.mean(axis=1) if picks is None else gains[np.arange(len(moments)), picks],
            "best_gain": gains.max(axis=1),
        }
        | ({} if taken is None else action_column(taken))
    )
    return rows.table()


def _key(dataset: ReadableDataset, split: SplitName, scoring: GainScoring) -> dict[str, Any]:
    """Everything that decides the truth and the oracle's picks.

    The generic objective stands there without its name, as in the files that there are. Another one is told by it: two
    objectives may have the same fields, or none.
    """
    name, objective = _frame_objective(dataset, scoring)
    told = "" if name == generic_objective(dataset.spec, needs_pixels=True) else name
    return {
        "version": GAIN_VERSION,
        "dataset": dataset.fingerprint,
        "split": split,
        "objective": objective_configuration(told, objective),
        **{name: getattr(scoring, name) for name in _DECISIVE},
    }


def _place(dataset: ReadableDataset, key: Mapping[str, Any]) -> Path:
    text = json.dumps(key, sort_keys=True)
    return cache_folder(dataset.path) / f"gain-{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"


def _kept(dataset: ReadableDataset, split: SplitName, scoring: GainScoring) -> Truth | None:
    """What the cache knows; None where that is nothing, or nothing usable."""
    key = _key(dataset, split, scoring)
    return kept(_place(dataset, key), key, dataset, split, _sequences(dataset, scoring))
