"""A controller that follows rules and reads the simulator, to show what is possible without a model.

It takes the object that is farthest from its goal along one of the actions' directions, walks around everything to
the place behind it, pushes until it is less than half a step away, and takes the next. When nothing is farther away
than that, it stands still. Walking is a breadth-first search over the places that whole steps reach, away from all
objects, at first far away, if there is no such way then nearer.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from typing import Final

import numpy as np
from jaxtyping import Float

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.controllers import NO_ACTION, Decision, Seen
from dmotion_bench.planning.problems import Moving, World

Node = tuple[int, int]
REACH: Final = 16  # steps that a walk may lead away from where it begins, along x and y
BERTHS: Final = (1.5, 1.2, 0.9)  # steps that a walk keeps away from the objects' middles; the first that works
BEHIND: Final = (1, 2, 3)  # steps behind an object from where a push may start


class ScriptedPusher:
    """Pushes the objects to their goals one by one, along one direction at a time."""

    def act(self, seen: Seen) -> Decision:
        """Not without the simulator."""
        raise TypeError("the scripted pusher needs the simulator")

    def act_in(self, seen: Seen, worlds: Sequence[World]) -> Decision:
        """The next step of each task's walk or push."""
        return Decision(action=np.array([next(_choices(world), NO_ACTION) for world in worlds]))


class _Table:
    """The places of all objects relative to the agent, in units of one step."""

    def __init__(self, world: World) -> None:
        if not isinstance(world.env, Moving):
            raise InvalidSetting(
                f"{world.env.facts.id!r} does not say where its actions lead (it has no 'moves'), "
                "so it cannot be pushed in by rules; use another reference."
            )
        self.step = float(np.linalg.norm(world.env.moves, axis=1).mean())
        self.moves: list[Node] = [(round(float(x)), round(float(y))) for x, y in world.env.moves / self.step]
        here = world.env.agent().position[0, :2]
        objects = world.env.objects().position[:, :2]
        wanted = world.problem.goal_positions[:, :2]
        counted = ~np.isnan(objects[:, 0]) & ~np.isnan(wanted[:, 0])
        self.others = (objects[~np.isnan(objects[:, 0])] - here) / self.step
        self.objects = (objects[counted] - here) / self.step
        self.off = (wanted[counted] - objects[counted]) / self.step
        self.walls = {self._node(place - here) for place in world.walls}

    def _node(self, way: Float[np.ndarray, "2"]) -> Node:
        x, y = np.rint(way / self.step).astype(int).tolist()
        return x, y

    def way(self, goal: Node, berth: float) -> int | None:
        """The first action of the shortest path that avoids all objects; None if there is no such path."""

        def free(node: Node) -> bool:
            if max(map(abs, node)) > REACH or node in self.walls:
                return False
            return node == goal or not (np.hypot(*(self.others - node).T) < berth).any()

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


def _choices(world: World) -> Iterator[int]:
    """The useful next actions, the best first."""
    table = _Table(world)
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
            for berth in BERTHS:
                found = table.way(node, berth)
                if found is not None:
                    yield found
                    break
