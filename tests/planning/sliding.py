"""A small world with continuous actions: a disc slides over a plane, and pushes another out of its way.

It is the environment, the recorder of its own data, and a differentiable model of the disc alone.
"""

from __future__ import annotations

from types import MappingProxyType
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.actions import Continuous
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.planning.tasks import Problem
from dmotion_bench.specs import EnvSpec, ObjectSpec, ObjectStates, Supervision
from dmotion_bench.storage.tasks import ControlTask

SIZE, STEP, TOUCH = 48, 0.1, 0.2  # [px], [m], [m]
Y, X = np.mgrid[:SIZE, :SIZE] / (SIZE - 1)
ACTIONS = Continuous(names=("dx", "dy"), low=(-STEP, -STEP), high=(STEP, STEP), units=("m", "m"))
FACTS = EnvSpec(
    id="sliding",
    actions=ACTIONS,
    agent=ObjectSpec(name="slider", shape="disc", color=(250, 250, 250)),
    objects=(ObjectSpec(name="puck", shape="disc", color=(230, 20, 20)),),
    height=SIZE,
    width=SIZE,
    agent_has_color=True,
)


class Sliding:
    """The slider moves by its action; a puck that it would overlap is pushed ahead, out to its edge."""

    facts = FACTS
    recording: ClassVar[Any] = MappingProxyType({})
    policies: ClassVar[Any] = MappingProxyType({})
    default_policy = "none"

    def __init__(self) -> None:
        self.slider, self.puck = np.zeros(2), np.zeros(2)

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        generator = np.random.default_rng(seed)
        self.slider, self.puck = generator.uniform(0.1, 0.3, 2), generator.uniform(0.45, 0.55, 2)
        return self._frame(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert np.shape(action) == (2,)
        assert ACTIONS.fault(np.asarray(action)[None]) is None
        self.slider = (self.slider + np.asarray(action)).clip(0, 1)
        apart = self.puck - self.slider
        distance = float(np.linalg.norm(apart))
        if distance < TOUCH:
            self.puck = (self.slider + apart / max(distance, 1e-9) * TOUCH).clip(0, 1)
        return self._frame(), 0.0, False, False, {}

    def legal_actions(self) -> np.ndarray:
        return np.ones(0, np.bool_)

    def agent(self) -> ObjectStates:
        return _states(self.slider)

    def objects(self) -> ObjectStates:
        return _states(self.puck)

    def snapshot(self) -> Any:
        return self.slider.copy(), self.puck.copy()

    def restore(self, snapshot: Any) -> None:
        self.slider, self.puck = (part.copy() for part in snapshot)

    def masks(self) -> np.ndarray:
        raise NotImplementedError

    def close(self) -> None:
        pass

    def render(self) -> np.ndarray:
        return self._frame()

    def _frame(self) -> np.ndarray:
        frame = np.zeros((SIZE, SIZE, 3), np.uint8)
        for place, color in ((self.puck, FACTS.objects[0].color), (self.slider, FACTS.agent.color)):
            frame[np.hypot(X - place[0], Y - place[1]) < TOUCH / 2] = color
        return frame


def _states(place: np.ndarray) -> ObjectStates:
    return ObjectStates(
        position=np.array([[*place, 0.0]]),
        orientation=np.array([[0.0, 0, 0, 1]]),
        pixel=place[None] * (SIZE - 1),
        visible=np.ones(1),
    )


def problem(number: int, env: Sliding) -> Problem:
    """Push the puck away from the corner where the slider stands."""
    start = env.reset(seed=number)[0]
    start_objects = env.objects()
    env.slider, env.puck = env.puck - 0.02, env.puck + np.array([0.2, 0.15])
    return Problem(
        number=number,
        task=ControlTask(episode=number, start=0, goal=1),
        seed=number,
        vary=(),
        opening=np.zeros((0, 2)),
        start_frame=start,
        goal_frame=env._frame(),
        start_objects=start_objects,
        goal_objects=env.objects(),
    )


class Blob(ForwardModel[None]):
    """A model whose state is the place of a soft blob, moved by the action; everything can be differentiated."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "none"
    Config: ClassVar[type] = type(None)

    def __init__(self) -> None:
        super().__init__(None, ModelInputs(height=SIZE, width=SIZE, actions=ACTIONS))

    def losses(self, batch: TripletBatch) -> Losses:
        raise NotImplementedError

    def begin(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> tuple[Tensor]:
        light = (current.mean(dim=1) + 1) / 2
        line = torch.linspace(0, 1, SIZE)
        total = light.sum(dim=(1, 2))
        return (
            torch.stack([(light * line).sum(dim=(1, 2)), (light * line[:, None]).sum(dim=(1, 2))], 1) / total[:, None],
        )

    def advance(self, state: tuple[Tensor], action: Tensor) -> tuple[Tensor]:
        return (state[0] + action,)

    def frame(self, state: tuple[Tensor]) -> Float[Tensor, "b c h w"]:
        line = torch.linspace(0, 1, SIZE)
        x, y = state[0].unbind(1)
        soft = torch.exp(-((line - x[:, None, None]) ** 2 + (line[:, None] - y[:, None, None]) ** 2) / 0.02)
        return (2 * soft - 1)[:, None].expand(-1, 3, -1, -1)

    def features(self, state: tuple[Tensor]) -> Tensor:
        return state[0]
