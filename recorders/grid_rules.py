"""The rules of Grid World: what an action moves, what it pushes, and which actions are possible.

The agent moves up, down, left or right and pushes the whole chain of objects before it; an object pushed over the edge
is gone for good. The agent itself never leaves the grid.

A second agent moves and pushes by the same rules. An action says what both do, ``"up/left"``. The first agent moves
first, the second on the grid that this leaves: so the first has a free cell that both want, and the second pushes an
object from where the first has pushed it to. No agent can be pushed: a move against the other agent, or against objects
behind which it stands, is as impossible as one off the grid, and a joint action is legal if both moves are possible.
There is always one: of an agent's two to four moves on the grid, at most one leads toward the other.

The rules are applied to many grids at once. ``cells`` holds the (x, y) of all things: of the agent, of the objects,
then of other agents. ``there`` says which of them have not been pushed off the grid.
"""

from __future__ import annotations

from typing import Final

import numpy as np
from jaxtyping import Bool, Int

from dmotion_bench.actions import Discrete

CELLS: Final = 5
"""Along x, and along y."""
OBJECTS: Final = 4
PUSHED: Final = slice(1, 1 + OBJECTS)
"""The objects among all things: after the agent, before other agents. So a thing's mask value is its number + 1."""
ACTIONS: Final = Discrete(("up", "down", "left", "right"))
JOINT_ACTIONS: Final = Discrete.joint(ACTIONS.names, ACTIONS.names)
MOVES: Final = np.array([(0, -1), (0, 1), (-1, 0), (1, 0)])
"""What each action of an agent adds to its (x, y)."""


def agents_among(things: int) -> tuple[int, ...]:
    """Which of so many things are agents: the first, and those after the objects."""
    return (0, *range(1 + OBJECTS, things))


def legal_actions(cells: Int[np.ndarray, "n k 2"], there: Bool[np.ndarray, "n k"]) -> Bool[np.ndarray, "n a"]:
    """Which actions, or joint actions, are possible."""
    first, *others = agents_among(cells.shape[1])
    if not others:
        return _moves_on_the_grid(cells[:, 0])
    found = []
    for action in range(len(MOVES)):
        possible = _possible(cells, there, first, action)
        after = advance(cells, there, np.full(len(cells), action))
        found += [possible & _possible(*after, others[0], other) for other in range(len(MOVES))]
    return np.stack(found, axis=-1)


def act(
    cells: Int[np.ndarray, "n k 2"], there: Bool[np.ndarray, "n k"], action: Int[np.ndarray, " n"]
) -> tuple[Int[np.ndarray, "n k 2"], Bool[np.ndarray, "n k"]]:
    """The grids after one legal action, or joint action, each."""
    agents = agents_among(cells.shape[1])
    for thing, part in zip(agents, np.unravel_index(action, (len(MOVES),) * len(agents)), strict=True):
        cells, there = advance(cells, there, part, thing)
    return cells, there


def advance(
    cells: Int[np.ndarray, "n k 2"], there: Bool[np.ndarray, "n k"], action: Int[np.ndarray, " n"], thing: int = 0
) -> tuple[Int[np.ndarray, "n k 2"], Bool[np.ndarray, "n k"]]:
    """The grids after one legal action each of the agent that is ``thing``."""
    move = MOVES[action]
    cells = cells + move[:, None] * _moving(cells, there, move, thing)[..., None]
    return cells, there & ((cells >= 0) & (cells < CELLS)).all(axis=-1)


def _moving(
    cells: Int[np.ndarray, "n k 2"], there: Bool[np.ndarray, "n k"], move: Int[np.ndarray, "n 2"], thing: int
) -> Bool[np.ndarray, "n k"]:
    """The chain of things that an agent's move takes along, itself included."""
    moving = np.zeros_like(there)
    moving[:, thing] = True
    front, chain = cells[:, thing], np.ones(len(cells), np.bool_)
    for _ in range(cells.shape[1] - 1):  # whoever stands before the last of the chain joins it
        front = front + move
        hit = there & (cells == front[:, None]).all(axis=-1) & chain[:, None]
        chain = hit.any(axis=-1)
        moving |= hit
    return moving


def _moves_on_the_grid(agent: Int[np.ndarray, "n 2"]) -> Bool[np.ndarray, "n a"]:
    target = agent[:, None] + MOVES
    inside: Bool[np.ndarray, "n a"] = ((target >= 0) & (target < CELLS)).all(axis=-1)
    return inside


def _possible(
    cells: Int[np.ndarray, "n k 2"], there: Bool[np.ndarray, "n k"], thing: int, action: int
) -> Bool[np.ndarray, " n"]:
    """Whether an agent's action keeps it on the grid and pushes no other agent."""
    others = [agent for agent in agents_among(cells.shape[1]) if agent != thing]
    moving = _moving(cells, there, np.broadcast_to(MOVES[action], (len(cells), 2)), thing)
    possible: Bool[np.ndarray, " n"] = _moves_on_the_grid(cells[:, thing])[:, action] & ~moving[:, others].any(axis=-1)
    return possible


def starting_cells(generator: np.random.Generator, things: int = 1 + OBJECTS) -> Int[np.ndarray, "k 2"]:
    """Agents and objects on cells of their own."""
    chosen = generator.permutation(CELLS * CELLS)[:things]
    return np.stack([chosen % CELLS, chosen // CELLS], axis=-1)
