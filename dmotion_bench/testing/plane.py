"""A small made-up world to try solvers and objectives in: a white disc on a plane, which shoves a red one.

It is a ``Dynamics`` whose predictions are true. A step is additions and comparisons, so a state comes out the same to
the last bit, whichever other states it is predicted beside.
"""

from __future__ import annotations

import contextlib
import math
from collections.abc import Iterator
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.planning.dynamics.base import Actions, Observation, State
from dmotion_bench.specs import EnvSpec, ObjectSpec

SIDE: Final = 64  # of a frame [px]
STRIDE: Final = 4.0  # of a discrete action, or of a continuous one at its bound [px]
TOUCH: Final = 8.0  # the disc takes the red one along from this distance on, in both directions [px]
RADIUS: Final = 5.0  # [px]
AGENT, PUCK, GROUND = (240, 240, 240), (220, 30, 30), (60, 60, 60)
STARTS: Final = ((12.0, 12.0, 20.0, 16.0), (20.0, 44.0, 32.0, 40.0), (48.0, 32.0, 28.0, 28.0))
"""Of each task x and y of the disc and of the red one [px]."""
WAYS: Final = ((4, 2), (3, -3), (-5, 1))
"""Of each task, how far both are moved to the goal [strides]."""

Places = Float[np.ndarray, "n 4"]
"""x and y of the disc and of the red one [px]."""


class Plane:
    """The world as a dynamics; a state is x and y of the disc and of the red one [px].

    Args:
        actions: What can be done. Discrete actions are steps in directions that lie evenly on a circle; of continuous
            ones the first number moves to the right, the second down, and further ones do nothing.
    """

    at_once = 256
    device = torch.device("cpu")

    def __init__(self, actions: ActionSpec) -> None:
        self.actions = actions
        self._shown: dict[bytes, Float[np.ndarray, " 4"]] = {}
        if isinstance(actions, Discrete):
            turns = [2 * math.pi * number / len(actions) for number in range(len(actions))]
            self._moves = torch.tensor([[math.cos(turn), math.sin(turn)] for turn in turns]).mul(STRIDE).round()

    @property
    def spec(self) -> EnvSpec:
        """The facts of the world."""
        return EnvSpec(
            id="plane",
            actions=self.actions,
            agent=ObjectSpec(name="disc", shape="disc", color=AGENT),
            objects=(ObjectSpec(name="puck", shape="disc", color=PUCK),),
            height=SIDE,
            width=SIDE,
            agent_has_color=True,
        )

    def observed(self, places: Places, goals: Places, step: int = 0) -> Observation:
        """What is seen of tasks that have stood still until now.

        Args:
            places, goals: Their states, and those of their goals.
            step: How many actions were taken before.
        """
        for place in (*places, *goals):
            self._shown[drawn(place[None])[0].tobytes()] = place
        now = drawn(places)
        return Observation(previous=now.copy(), current=now, goals=drawn(goals), step=step)

    def moved(self, places: Places, action: Int[np.ndarray, " n"] | Float[np.ndarray, "n a"]) -> Places:
        """The states after actions, continuous ones in [-1, 1]."""
        chosen = torch.from_numpy(action)
        given = chosen if isinstance(self.actions, Discrete) else chosen.float()
        return self.step((as_state(places),), given)[0].double().numpy()

    @contextlib.contextmanager
    def computing(self, *, gradients: bool = False) -> Iterator[None]:
        """In float32; gradients reach continuous actions."""
        with torch.set_grad_enabled(gradients):
            yield

    def start(self, observation: Observation) -> State:
        """The states that images of this world show."""
        return (as_state(np.stack([self._shown[image.tobytes()] for image in observation.current])),)

    def step(self, state: State, action: Actions) -> State:
        """Each state after one more action."""
        (places,) = state
        agent, puck = places[:, :2], places[:, 2:]
        move = self._moves[action] if isinstance(self.actions, Discrete) else _of_plane(action) * STRIDE
        shoved = ((puck - agent).abs() < TOUCH).all(dim=1, keepdim=True)
        return (torch.cat([agent + move, torch.where(shoved, puck + move, puck)], dim=1),)

    def frames(self, state: State) -> Float[Tensor, "n c h w"]:
        """The red disc, and the white one over it; no gradient reaches them."""
        return torch.from_numpy(drawn(state[0].detach().numpy())).permute(0, 3, 1, 2).float() / 127.5 - 1

    def features(self, state: State) -> Float[Tensor, "n d"]:
        """The places [strides]."""
        return state[0] / STRIDE


def beginnings() -> Places:
    """The state at the start of each task."""
    return np.array(STARTS)


def ends() -> Places:
    """The state that each task's goal shows."""
    return beginnings() + STRIDE * np.tile(WAYS, 2)


def as_state(places: Places) -> Float[Tensor, "n 4"]:
    """States as the dynamics has them."""
    return torch.from_numpy(places).float()


def drawn(places: Float[np.ndarray, "n 4"]) -> UInt8[np.ndarray, "n h w 3"]:
    """Pictures of states."""
    y, x = np.mgrid[:SIDE, :SIDE]
    frames = np.full((len(places), SIDE, SIDE, 3), GROUND, np.uint8)
    for frame, place in zip(frames, places, strict=True):
        for center, color in ((place[2:], PUCK), (place[:2], AGENT)):
            frame[(x - center[0]) ** 2 + (y - center[1]) ** 2 <= RADIUS**2] = color
    return frames


def _of_plane(action: Float[Tensor, "n a"]) -> Float[Tensor, "n 2"]:
    """The two numbers that move the disc; 0 for a second one where there is none."""
    return torch.cat([action, torch.zeros(len(action), 1)], dim=1)[:, :2]
