"""Predictions of many action sequences; a beginning that several sequences share is predicted once.

Fifty sequences of five actions out of four share most of their first steps: of their 250 frames only some 150 are
different, and a planner's later iterations meet most of its earlier prefixes again. So frames are nodes of a tree
whose edges are actions; a node is imagined when a sequence first goes through it and is remembered from then on.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Discrete
from dmotion_bench.errors import InvalidSetting, PlannerContractBroken
from dmotion_bench.planning.dynamics.base import Dynamics, Observation, State, branched, pixels_of
from dmotion_bench.planning.objectives.base import PARTS, Evaluator
from dmotion_bench.planning.solvers.search import Search, known_costs, require_sequences


@dataclass(kw_only=True)
class _Level:
    """All nodes at one depth, in the order in which they were predicted.

    Attributes:
        key: ``parent * actions + action`` of each node.
        task: Which task it belongs to.
        cost: Of each node: the total and its parts.
        chunks: Their states, each with what its cost carries, in the batches in which they were predicted.
        starts: The first node of each chunk.
    """

    key: Int[np.ndarray, " n"]
    task: Int[np.ndarray, " n"]
    cost: Float[np.ndarray, "n 4"]
    chunks: list[State] = field(default_factory=list)
    starts: list[int] = field(default_factory=list)

    def nodes_of(self, keys: Int[np.ndarray, " m"]) -> Int[np.ndarray, " m"]:
        """The nodes with these keys, -1 where there is none yet."""
        if not len(self.key):
            return np.full(len(keys), -1)
        order = self.key.argsort(kind="stable")
        place = np.searchsorted(self.key, keys, sorter=order).clip(max=len(order) - 1)
        nodes: Int[np.ndarray, " m"] = np.where(self.key[order[place]] == keys, order[place], -1)
        return nodes

    def gather(self, nodes: Int[np.ndarray, " m"]) -> State:
        """The states of some nodes, whose numbers are in ascending order."""
        chunk = np.searchsorted(self.starts, nodes, side="right") - 1
        parts = []
        for index in np.unique(chunk).tolist():
            rows = torch.from_numpy(nodes[chunk == index] - self.starts[index])
            parts.append(tuple(tensor[rows.to(tensor.device)] for tensor in self.chunks[index]))
        return parts[0] if len(parts) == 1 else tuple(torch.cat(tensors) for tensors in zip(*parts, strict=True))


class PrefixTree(Search):
    """Stores the predictions for some tasks from one control step on; for discrete actions.

    Args:
        dynamics: Predicts the states.
        evaluator: Says what they cost.
        observation: Of the tasks, now.
        horizon: The length of the longest sequence; the states at its end are not kept.

    Raises:
        InvalidSetting: The actions are continuous.

    Attributes:
        actions: How many there are.
    """

    def __init__(self, dynamics: Dynamics, evaluator: Evaluator, observation: Observation, horizon: int) -> None:
        self.dynamics, self.horizon, self.frames = dynamics, horizon, 0
        if not isinstance(dynamics.actions, Discrete):
            raise needs_discrete(dynamics.actions)
        self.actions = len(dynamics.actions)
        self._evaluator = evaluator
        with torch.inference_mode():
            carried = evaluator.begin(dynamics)
        with dynamics.computing():
            start = dynamics.start(observation)
        self._carried = len(carried)
        tasks = np.arange(len(observation.current))
        nothing = np.full((len(tasks), 1 + len(PARTS)), np.nan)
        root = _Level(key=tasks, task=tasks, cost=nothing, chunks=[(*start, *carried)], starts=[0])
        self._tasks = len(tasks)
        self._levels = [root] + [
            _Level(key=np.zeros(0, np.int64), task=np.zeros(0, np.int64), cost=nothing[:0]) for _ in range(horizon)
        ]

    def stacked_costs(self, sequences: Any) -> Float[np.ndarray, "b s t 4"]:
        """See ``Search``."""
        require_sequences(sequences, self.dynamics.actions, self._tasks)
        if sequences.shape[2] > self.horizon:
            raise ValueError(f"sequences of {sequences.shape[2]} actions in a tree made for {self.horizon}")
        if not 0 <= sequences.min() <= sequences.max() < self.actions:
            tried, known = f"{sequences.min()} to {sequences.max()}", f"0 to {self.actions - 1}"
            raise PlannerContractBroken(f"the solver tries the actions {tried}; there are {known}.")
        tasks, count, steps = sequences.shape
        found, _ = self._follow(np.arange(tasks).repeat(count), sequences.reshape(-1, steps))
        return found.reshape(*sequences.shape, 1 + len(PARTS))

    def costs_of(self, task: int, sequences: Int[np.ndarray, "n t"]) -> Float[np.ndarray, "n 4"]:
        """What sequences of one task cost at their ends, and the parts of it; nothing is predicted of other tasks.

        Raises:
            PlannerContractBroken: The objective gives costs that are not numbers.
        """
        costs = self._follow(np.full(len(sequences), task), sequences)[0][:, -1]
        known_costs(costs[:, 0])
        return costs

    def pixels_of(self, task: int, sequences: Int[np.ndarray, "n t"]) -> UInt8[Tensor, "n h w 3"]:
        """What sequences of one task, shorter than the horizon, end with."""
        level = self._levels[sequences.shape[1]]
        nodes, place = np.unique(self._follow(np.full(len(sequences), task), sequences)[1], return_inverse=True)
        shown = []
        with self.dynamics.computing():
            for start in range(0, len(nodes), self.dynamics.at_once):
                states = level.gather(nodes[start : start + self.dynamics.at_once])
                shown.append(pixels_of(self.dynamics, states[: len(states) - self._carried]).cpu())
        return torch.cat(shown)[torch.from_numpy(place)]

    def _follow(
        self, task: Int[np.ndarray, " n"], sequences: Int[np.ndarray, "n t"]
    ) -> tuple[Float[np.ndarray, "n t 4"], Int[np.ndarray, " n"]]:
        """The costs of sequences of some tasks, and the nodes of the last level that they end at."""
        node, costs = task, np.empty((*sequences.shape, 1 + len(PARTS)))
        with self.dynamics.computing():  # once for all, so that autocast keeps the weights that it has rounded
            for depth in range(sequences.shape[1]):
                wanted, place = np.unique(node * self.actions + sequences[:, depth], return_inverse=True)
                level = self._levels[depth + 1]
                unknown = wanted[level.nodes_of(wanted) < 0]
                if len(unknown):
                    self._predict(depth, unknown)
                node = level.nodes_of(wanted)[place]
                costs[:, depth] = level.cost[node]
        return costs, node

    def _predict(self, depth: int, keys: Int[np.ndarray, " n"]) -> None:
        """Add nodes below those at ``depth``; the keys rise, so parents do not fall."""
        above, level = self._levels[depth], self._levels[depth + 1]
        parent, action = np.divmod(keys, self.actions)
        task, costs = above.task[parent], []
        for start in range(0, len(keys), self.dynamics.at_once):
            part = slice(start, start + self.dynamics.at_once)
            nodes, place = np.unique(parent[part], return_inverse=True)
            states, cost = self._expand(
                above.gather(nodes), *(torch.from_numpy(one) for one in (place, task[part], action[part]))
            )
            costs.append(cost.double().numpy())
            if depth + 1 < self.horizon:
                level.starts.append(len(level.key) + start)
                level.chunks.append(states)
        level.key = np.concatenate([level.key, keys])
        level.task = np.concatenate([level.task, task])
        level.cost = np.concatenate([level.cost, *costs])
        self.frames += len(keys)

    def _expand(
        self, states: State, place: Int[Tensor, " n"], task: Int[Tensor, " n"], action: Int[Tensor, " n"]
    ) -> tuple[State, Float[Tensor, "n 4"]]:
        """The states after actions, each at the state of row ``place``, and their costs."""
        dynamics, split = self.dynamics, len(states) - self._carried
        place, task, action = (rows.to(dynamics.device) for rows in (place, task, action))
        after = branched(dynamics, states[:split], place, action)
        before = tuple(part[place] for part in states[split:])
        cost, carried = self._evaluator.step(dynamics, after, task, action, before)
        return (*after, *carried), cost.stacked().cpu()


def needs_discrete(spec: ActionSpec) -> InvalidSetting:
    """The error that a planner needs discrete actions, and these are continuous."""
    return InvalidSetting(
        f"the planner needs discrete actions, and these are continuous: {spec}; take a data set with discrete actions, "
        "or another planner: '--planner icem'."
    )
