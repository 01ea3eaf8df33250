"""How far a T is from a goal: the judged distance of the control tasks, and what the oracle minimises."""

from __future__ import annotations

import math
from typing import Final, cast

from dmotion_bench.environment import Environment, ObjectEnvironment
from dmotion_bench.specs import ObjectStates
from recorders.push_t.tee import MM, OUTLINE, Pose, coverage

SUCCESS_COVERAGE: Final = 0.95
"""The published rule: a T that covers more than this share of the goal has solved the task."""

SUCCESS_DISTANCE: Final = 0.2
"""The judged distance at that coverage: up to here control counts a task as solved (``scoring.figures.SUCCESS``)."""

EXACT: Final = 1e-9  # an uncovered share below this is rounding


class GoalCoverage:
    """The judged distance by the share of the goal that the T leaves uncovered.

    It falls in a straight line from 1 at the share of the start to 0.2 at a share of 5%, and from there to 0. Where
    a start leaves 5% or less, the distance is the share divided by the start's; where it leaves nothing, it stays 1.

    Args:
        start, goal: The T at a task's start and goal.
    """

    def __init__(self, start: Pose, goal: Pose) -> None:
        self._goal = goal
        self._start = self.uncovered(start)
        self._corners = [goal.place(*corner) for corner in OUTLINE]

    def uncovered(self, pose: Pose) -> float:
        """The share of the goal that a T leaves open, 0 to 1."""
        share = 1 - coverage(pose, self._goal)
        return share if share > EXACT else 0.0

    def distance(self, env: Environment) -> float:
        """The judged distance."""
        share, rule = self.uncovered(pose_of(_objects(env))), 1 - SUCCESS_COVERAGE
        if self._start <= rule:  # solved before it began
            return share / self._start if self._start else 1.0
        if share < rule:
            return SUCCESS_DISTANCE * share / rule
        return SUCCESS_DISTANCE + (1 - SUCCESS_DISTANCE) * ((share - rule) / (self._start - rule))

    def lost(self, env: Environment) -> int:
        """0: the walls hold the T."""
        return 0

    def cost(self, env: Environment) -> float:
        """The mean squared distance of the T's eight corners from their places at the goal [m^2]."""
        pose = pose_of(_objects(env))
        away = (math.dist(pose.place(*corner), there) for corner, there in zip(OUTLINE, self._corners, strict=True))
        return sum(one**2 for one in away) / len(OUTLINE) * MM**2


def _objects(env: Environment) -> ObjectStates:
    return cast(ObjectEnvironment, env).objects()


def pose_of(objects: ObjectStates) -> Pose:
    """Where the T is, by its states."""
    (x, y), (turn, whole) = objects.position[0, :2].tolist(), objects.orientation[0, 2:].tolist()
    return Pose.of_centre(x / MM, y / MM, 2 * math.atan2(turn, whole))
