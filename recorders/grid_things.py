"""What stands on the grid: names and colours of the things, how they look, and the states that labels tell of them."""

from __future__ import annotations

from dataclasses import replace
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.specs import EnvSpec, ObjectSpec, ObjectStates
from recorders import grid_drawing
from recorders.grid_drawing import SIZE, Drawn, Version
from recorders.grid_rules import ACTIONS, JOINT_ACTIONS, MOVES

FACTS: Final = EnvSpec(
    id="grid_world",
    actions=ACTIONS,
    agent=ObjectSpec(name="agent", shape="square", color=(0, 255, 0)),
    objects=(
        ObjectSpec(name="red_circle", shape="circle", color=(255, 0, 0)),
        ObjectSpec(name="magenta_circle", shape="circle", color=(255, 0, 255)),
        ObjectSpec(name="blue_triangle", shape="triangle", color=(0, 0, 255)),
        ObjectSpec(name="yellow_triangle", shape="triangle", color=(255, 255, 0)),
    ),
    height=SIZE,
    width=SIZE,
    agent_has_color=True,
)
SECOND_AGENT: Final = ObjectSpec(name="second_agent", shape="square", color=(0, 255, 255))
FACTS_OF_TWO: Final = replace(FACTS, actions=JOINT_ACTIONS, other_agents=(SECOND_AGENT,))
HEADINGS: Final = [(float(x), float(y)) for x, y in MOVES.tolist()]


def heading(action: int, agents: int) -> tuple[float, float]:
    """Where an action, or the first part of a joint one, points."""
    first: int = action // len(MOVES) ** (agents - 1)
    return HEADINGS[first]


def draw(cells: Int[np.ndarray, "t n 2"], there: Bool[np.ndarray, "t n"], version: Version = 1) -> Drawn:
    """What things (the agent, the objects, other agents) look like at a sequence of moments."""
    return grid_drawing.draw((FACTS.agent, *FACTS.objects, SECOND_AGENT)[: cells.shape[1]], cells, there, version)


def states(
    cells: Int[np.ndarray, "*t k 2"],
    there: Bool[np.ndarray, "*t k"],
    centers: Float[np.ndarray, "*t k 2"],
    visible: Float[np.ndarray, "*t k"],
) -> ObjectStates:
    """The labels of things in those cells; of one that is gone, nothing is known but its picture."""
    known = there[..., None]
    position = np.concatenate([cells, np.zeros_like(cells[..., :1])], axis=-1)
    return ObjectStates(
        position=np.where(known, position, np.nan),
        orientation=np.where(known, (0.0, 0.0, 0.0, 1.0), np.nan),
        pixel=centers,
        visible=visible,
    )
