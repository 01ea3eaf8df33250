"""A small world in which more than places decides what follows: an agent that turns, and a box that slides on.

It tells where everything is, as many simulators do, and cannot be restored.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np

from dmotion_bench.actions import Discrete
from dmotion_bench.planning.tasks import Problem
from dmotion_bench.specs import EnvSpec, ObjectSpec, ObjectStates
from dmotion_bench.storage.tasks import ControlTask

TURN, FORWARD, WAIT = range(3)
SIZE = 16  # [px]
FACTS = EnvSpec(
    id="turning",
    actions=Discrete(("turn", "forward", "wait")),
    agent=ObjectSpec(name="turtle", shape="square", color=(0, 255, 0)),
    objects=(ObjectSpec(name="box", shape="square", color=(255, 0, 0)),),
    height=SIZE,
    width=SIZE,
)
HEADINGS = np.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0], [0.0, -1.0]])


class Turning:
    """The turtle turns left or goes forward, and pushes the box; while ``slides``, a pushed box moves on next time.

    Attributes:
        slides: Whether the box has a velocity, which nobody is told of.
        tells_heading: Whether the turtle's orientation is told.
        settled: What it promises (``environment.Settled``); true where the box does not slide and the heading is told.
    """

    facts = FACTS
    recording: ClassVar[Any] = MappingProxyType({})
    policies: ClassVar[Any] = MappingProxyType({})
    default_policy = "none"

    def __init__(self, *, slides: bool = False, tells_heading: bool = True, settled: bool = False) -> None:
        self.slides, self.tells_heading, self.settled = slides, tells_heading, settled

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.turtle, self.heading = np.zeros(2), 0
        self.box, self.velocity = np.array([0.0, 1.0]), np.zeros(2)
        return self.render(), {}

    def step(self, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        self.box, self.velocity = self.box + self.velocity, np.zeros(2)
        if action == TURN:
            self.heading = (self.heading + 1) % 4
        elif action == FORWARD:
            self.turtle = self.turtle + HEADINGS[self.heading]
            if np.array_equal(self.turtle, self.box):
                self.box = self.box + HEADINGS[self.heading]
                self.velocity = HEADINGS[self.heading] * self.slides
        return self.render(), 0.0, False, False, {}

    def legal_actions(self) -> np.ndarray:
        return np.ones(3, np.bool_)

    def agent(self) -> ObjectStates:
        return _states(self.turtle, self.heading if self.tells_heading else 0)

    def objects(self) -> ObjectStates:
        return _states(self.box, 0)

    def render(self) -> np.ndarray:
        return np.zeros((SIZE, SIZE, 3), np.uint8)

    def close(self) -> None:
        pass


def _states(place: np.ndarray, quarters: int) -> ObjectStates:
    half = quarters * np.pi / 4
    return ObjectStates(
        position=np.array([[*place, 0.0]]),
        orientation=np.array([[0.0, 0.0, np.sin(half), np.cos(half)]]),
        pixel=np.zeros((1, 2)),
        visible=np.ones(1),
    )


def problem(env: Turning) -> Problem:
    """Push the box four places ahead of where it lies."""
    frame = env.reset()[0]
    return Problem(
        number=0,
        task=ControlTask(episode=0, start=0, goal=5),
        seed=0,
        vary=(),
        opening=np.zeros(0, np.int64),
        start_frame=frame,
        goal_frame=frame,
        start_objects=env.objects(),
        goal_objects=_states(np.array([0.0, 5.0]), 0),
    )
