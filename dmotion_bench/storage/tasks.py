"""Control tasks: bring the objects from where they are at one frame to where they are at a later one.

Tasks are cut out of recorded episodes, so each can be reached: the goal is 29 frames after the start, the
original's distance, or the episode's end where that comes sooner. They are chosen when the data set is recorded
and stored with it, so that every model faces the same ones, whatever its own policy.

The original asks for at least 15 interactions (steps in which an object moves) between start and goal. In
Grid World 31 random moves give about three, so a task there has at least two; in every environment the
stretches with 15 or more come first, and the pushing environments' data sets have enough of them. A task
never loses an object that is there at its start.

Where no positions are known an interaction is a step that changes the picture. The pictures at the start and at the
goal must differ at least as much as the episode's frames usually do from one step to the next.
"""

from __future__ import annotations

import itertools
from collections.abc import Collection, Mapping, Sequence
from typing import Final, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.split import split_episodes

GOAL_DISTANCE: Final = 29  # frames, the original's
ENOUGH_INTERACTIONS: Final = 15  # the original's
FEWEST_INTERACTIONS: Final = 2
START_SPACING: Final = 4  # frames between the starts of two tasks of one episode, at least


class ControlTask(NamedTuple):
    """Frame numbers within an episode: where the task starts, and what it is to look like."""

    episode: int
    start: int
    goal: int


class Candidate(NamedTuple):
    """A stretch of an episode that could be a task."""

    start: int
    goal: int
    interactions: int


def candidates(
    positions: Float[np.ndarray, "t k 3"], pushed: Bool[np.ndarray, "t-1"], threshold: float, *, delay: int = 0
) -> tuple[Candidate, ...]:
    """The stretches of an episode that could be tasks, the best first.

    Args:
        positions: Of the objects [m]; NaN for one that is gone.
        pushed: Whether an object moved in each step.
        threshold: An object that is displaced by more than this counts as displaced [m].
        delay: Steps by which the goal's picture lags: the task is to do what it shows.
    """
    last, gone = len(positions) - 1, np.isnan(positions[..., 0])
    before = np.concatenate([[0], np.cumsum(pushed)])
    goals = np.minimum(np.arange(last) + GOAL_DISTANCE, last)
    interacting = before[goals] - before[:-1]
    found = []
    for start in np.flatnonzero(interacting >= FEWEST_INTERACTIONS).tolist():
        goal, interactions = int(goals[start]), int(interacting[start])
        if (gone[goal] & ~gone[start]).any():
            continue
        moved = np.linalg.norm(positions[max(0, goal - delay)] - positions[start], axis=-1)[~gone[start]]
        if (moved > threshold).any():
            found.append(Candidate(start, goal, interactions))
    return _spaced(found, last)


def picture_candidates(frames: UInt8[np.ndarray, "t h w 3"]) -> tuple[Candidate, ...]:
    """The stretches of an episode that could be tasks by its pictures alone, the best first."""
    last = len(frames) - 1
    if last < 1:
        return ()
    steps = np.array([_difference(*pair) for pair in itertools.pairwise(frames)])
    before = np.concatenate([[0], np.cumsum(steps > 0)])
    goals = np.minimum(np.arange(last) + GOAL_DISTANCE, last)
    changes = before[goals] - before[:-1]
    usual = float(np.median(steps[steps > 0])) if (steps > 0).any() else 0.0
    found = []
    for start in np.flatnonzero(changes >= FEWEST_INTERACTIONS).tolist():
        goal = int(goals[start])
        if _difference(frames[start], frames[goal]) >= usual:
            found.append(Candidate(start, goal, int(changes[start])))
    return _spaced(found, last)


def _difference(one: UInt8[np.ndarray, "h w 3"], other: UInt8[np.ndarray, "h w 3"]) -> float:
    """Mean squared difference of two pictures."""
    return float(np.square(one.astype(np.int32) - other).mean())


def _spaced(found: list[Candidate], last: int) -> tuple[Candidate, ...]:
    """The best candidates of an episode whose starts are far enough apart."""
    found.sort(key=lambda one: (-one.interactions, one.start))
    spaced: list[Candidate] = []
    near = np.zeros(last + START_SPACING, np.bool_)  # whether a start would be too near to one that is taken
    for one in found:
        if not near[one.start]:
            spaced.append(one)
            near[max(0, one.start - START_SPACING + 1) : one.start + START_SPACING] = True
    return tuple(spaced)


def tasks_of(
    recipe: DatasetRecipe,
    sources: Int[np.ndarray, " e"] | None,
    possible: Sequence[Sequence[Candidate]],
    *,
    repeats: bool,
) -> list[ControlTask]:
    """The control tasks of a data set, which follow from its recordings alone.

    Args:
        recipe: Of the data set.
        sources: Of each episode the number of the recording that it is a part of; None: each is its own.
        possible: The candidates of each episode.
        repeats: Whether the same recording gives the same frames; else no task could be begun, and there is none.
    """
    if not recipe.tasks or not repeats:
        return []
    held_out = split_episodes(recipe.seed, recipe.episodes, sources)["test"]
    return choose_tasks(dict(enumerate(possible)), set(held_out.tolist()), recipe.tasks)


def choose_tasks(found: Mapping[int, Sequence[Candidate]], held_out: Collection[int], count: int) -> list[ControlTask]:
    """The best ``count`` tasks, or all there are, in the order of their episodes.

    Tasks with enough interactions come before others. Within that, an episode's second task is used only when every
    episode has given its first; then those of held-out episodes come first, then those with more interactions.

    Args:
        found: The candidates of each episode, the best first.
        held_out: The episodes of the test split.
        count: How many tasks are wanted.
    """
    ranked = sorted(
        (one.interactions < ENOUGH_INTERACTIONS, rank, episode not in held_out, -one.interactions, episode, one)
        for episode, ones in found.items()
        for rank, one in enumerate(ones)
    )
    return sorted(ControlTask(entry[4], entry[5].start, entry[5].goal) for entry in ranked[:count])
