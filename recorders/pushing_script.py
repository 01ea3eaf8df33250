"""Rules that solve the tasks of the pushing environments, to show what is possible without a model.

They take the object that is farthest from its goal along one of the actions' directions, walk around everything to
the place behind it, push until it is less than half a step away, and take the next. When nothing is farther away
than that, they stand still. Walking is a breadth-first search over the places that whole steps reach, away from all
objects, at first far away, if there is no such way then nearer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Final, cast

import numpy as np
from jaxtyping import Float

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Action, Environment
from dmotion_bench.specs import ObjectStates
from recorders.push_policy import Pushing

Node = tuple[int, int]
REACH: Final = 16  # steps that a walk may lead away from where it begins, along x and y
CLEARANCES: Final = (1.5, 1.2, 0.9)  # steps that a walk keeps away from the objects' middles; the first that works
BEHIND: Final = (1, 2, 3)  # steps behind an object from where a push may start


class PushingScript:
    """Pushes the objects of one task to their goals one by one, along one direction at a time."""

    def __init__(self) -> None:
        self._walls: list[Float[np.ndarray, "2"]] = []

    def watch(self, env: Environment) -> None:
        """Take down the places [m] that the agent is kept from."""
        world = cast(Pushing, env)
        self._walls += list(world.agent().position[0, :2] + world.moves[~world.legal_actions()])

    def act(self, env: Environment, goal: ObjectStates) -> Action | None:
        """The next step of a walk or a push; ``env`` must also be ``Pushing``.

        Where actions are displacements, it is one of a whole step.
        """
        world = cast(Pushing, env)
        chosen = next(_choices(_Surroundings(world, goal, self._walls)), None)
        if chosen is None or not isinstance(world.facts.actions, Continuous):
            return chosen
        move: Float[np.ndarray, "2"] = world.moves[chosen]
        return move


class _Surroundings:
    """The places of all objects relative to the agent, in units of one step."""

    def __init__(self, world: Pushing, goal: ObjectStates, walls: Sequence[Float[np.ndarray, "2"]]) -> None:
        moves = world.moves
        self.step = float(np.linalg.norm(moves, axis=1).mean())
        self.moves: list[Node] = [(round(float(x)), round(float(y))) for x, y in moves / self.step]
        here = world.agent().position[0, :2]
        objects = world.objects().position[:, :2]
        wanted = goal.position[:, :2]
        counted = ~np.isnan(objects[:, 0]) & ~np.isnan(wanted[:, 0])
        self.others = (objects[~np.isnan(objects[:, 0])] - here) / self.step
        self.objects = (objects[counted] - here) / self.step
        self.off = (wanted[counted] - objects[counted]) / self.step
        self.walls = {self._node(place - here) for place in walls}

    def _node(self, way: Float[np.ndarray, "2"]) -> Node:
        x, y = np.rint(way / self.step).astype(int).tolist()
        return x, y

    def way(self, goal: Node, clearance: float) -> int | None:
        """The first action of the shortest path that avoids all objects; None if there is no such path."""

        def free(node: Node) -> bool:
            if max(map(abs, node)) > REACH or node in self.walls:
                return False
            return node == goal or not (np.hypot(*(self.others - node).T) < clearance).any()

        first: dict[Node, int] = {}
        waiting: deque[Node] = deque([(0, 0)])
        while waiting:
            node = waiting.popleft()
            for action, (x, y) in enumerate(self.moves):
                after = node[0] + x, node[1] + y
                if after == (0, 0) or after in first or not free(after):
                    continue
                first[after] = first.get(node, action)
                if after == goal:
                    return first[after]
                waiting.append(after)
        return None


def _choices(table: _Surroundings) -> Iterator[int]:
    """The useful next actions, the best first."""
    moves = np.array(table.moves)
    gains = table.off @ moves.T
    for index in np.argsort(-gains, axis=None, kind="stable").tolist():
        thing, action = divmod(index, len(moves))
        if gains[thing, action] <= 0.5:
            return
        move, place = moves[action], table.objects[thing]
        ahead, aside = float(place @ move), place - (place @ move) * move
        before = np.abs(aside).max() <= 0.5 and 0 < ahead <= max(BEHIND) + 0.5
        if before and tuple(move.tolist()) not in table.walls:
            yield action
            continue
        for back in BEHIND:
            node = tuple(np.rint(place - back * move).astype(int).tolist())
            if (place @ move) - (np.array(node) @ move) < 0.5 or node == (0, 0):
                continue
            for clearance in CLEARANCES:
                found = table.way(node, clearance)
                if found is not None:
                    yield found
                    break
