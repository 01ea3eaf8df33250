"""Environments of others that fail in a control task: a sentence names them, and not the planner."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
import pytest
from planning.sliding import FACTS, Sliding, problem

from dmotion_bench.errors import RecordingFailed
from dmotion_bench.planning import tasks
from dmotion_bench.planning.agents import make_reference
from dmotion_bench.planning.choices import make_objective, make_solver
from dmotion_bench.planning.mpc import ControlSettings, control

LATE = 2
FEW = ("samples=2", "elites=1", "iterations=1", "horizon=1", "kept_elites=0")
FRAMES: dict[str, tuple[Any, str]] = {
    "larger": (lambda frame: np.concatenate([frame, frame[:1]]), r"draws uint8 of \(49, 48, 3\)"),
    "gray": (lambda frame: frame[..., 0], r"draws uint8 of \(48, 48\)"),
    "NaN": (lambda frame: np.full(frame.shape, np.nan), "draws float64 of"),
    "of 64 bits": (lambda frame: frame.astype(np.int64), "draws int64 of"),
    "none": (lambda frame: None, "draws NoneType; by its facts a picture is a uint8 array of"),
}
STATES: dict[str, tuple[Any, str]] = {
    "none": (lambda told: None, "tells NoneType where its objects are"),
    "of two objects": (
        lambda told: replace(told, position=np.repeat(told.position, 2, axis=0)),
        r"tells \(2, 3\) where its objects are, in a control task; .* of the shape \(1, 3\)",
    ),
    "raised": (lambda told: told.nowhere, "raised AttributeError in what it tells of its state in control task 0"),
}


class Faulty(Sliding):
    """Is sound for ``LATE`` steps, and then draws and tells what is changed."""

    def __init__(self, draws: Any = None, tells: Any = None) -> None:
        super().__init__()
        self._draws, self._tells, self._taken = draws, tells, 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> Any:
        self._taken = 0
        return super().reset(seed=seed)

    def step(self, action: Any) -> Any:
        self._taken += 1
        return super().step(action)

    def snapshot(self) -> Any:
        return super().snapshot(), self._taken

    def restore(self, snapshot: Any) -> None:
        super().restore(snapshot[0])
        self._taken = snapshot[1]

    def objects(self) -> Any:
        told = super().objects()
        return told if self._tells is None or self._taken < LATE else self._tells(told)

    def _frame(self) -> Any:
        frame = super()._frame()
        return frame if self._draws is None or self._taken < LATE else self._draws(frame)


def _solved(who: str, objective: str | None, **faults: Any) -> None:
    make = partial(Faulty, **faults)
    agent = make_reference(who, FACTS, make, make_solver("icem", FEW), objective and make_objective(objective))
    control(agent, [problem(0, Sliding())], make, ControlSettings(steps=4))


@pytest.mark.parametrize(("who", "objective"), [("random", None), ("oracle", None), ("oracle", "pixel")])
@pytest.mark.parametrize("what", FRAMES)
def test_a_frame_that_is_none_by_the_facts_is_said(who: str, objective: str | None, what: str) -> None:
    draws, said = FRAMES[what]
    with pytest.raises(RecordingFailed, match=f"^the environment 'sliding' {said}"):
        _solved(who, objective, draws=draws)


@pytest.mark.parametrize("who", ["random", "oracle"])
@pytest.mark.parametrize("what", STATES)
def test_what_an_environment_tells_of_its_objects_is_not_the_planner_s_fault(who: str, what: str) -> None:
    tells, said = STATES[what]
    with pytest.raises(RecordingFailed, match=f"^the environment 'sliding' {said}"):
        _solved(who, None, tells=tells)


def test_a_sound_environment_is_left_in_peace() -> None:
    for who in ("random", "oracle"):
        _solved(who, None)


@pytest.mark.parametrize(
    ("goal", "said"),
    [
        (lambda: 1 / 0, "raised ZeroDivisionError in 'task_goal' for task 0"),
        (lambda: (np.zeros((2, 2, 3), np.uint8), None), r"draws uint8 of \(2, 2, 3\)"),
        (lambda: 3, "raised TypeError in 'task_goal' for task 0"),
    ],
)
def test_a_goal_that_an_environment_sets_is_looked_at(goal: Any, said: str) -> None:
    class Setting(Sliding):
        def task_goal(self) -> Any:
            return goal()

    with pytest.raises(RecordingFailed, match=f"^the environment 'sliding' {said}"):
        tasks._with_own_goal(Setting(), problem(0, Sliding()))
