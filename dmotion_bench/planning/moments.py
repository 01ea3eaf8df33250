"""Moments at which something can be gained, and what each of a fixed set of action sequences truly brings there.

A moment is a frame of a stretch of a recorded episode that could be a control task, and is reached as a task is: by
replay, with the recorded actions. Which frame of the stretch it is, the simulator decides and no model: the one at
which the best of the sequences lowers the distance to the goal the most.

The true gain of a sequence is by how much it lowers the judged distance (``planning/tasks.py``), which is 1 at the
stretch's start. The sequences are the same at all moments, and a sequence is always carried out to its end.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.actions import ActionSpec, ActionTaken, Continuous, Discrete, as_actions
from dmotion_bench.environment import Environment
from dmotion_bench.planning.dynamics.simulator import Place, Simulation
from dmotion_bench.planning.tasks import Problem

REPEAT_PROBABILITY: Final = 0.5
"""Of taking an action of a sequence once more; independent actions mostly undo each other."""

SPACING: Final = 2
"""Between the frames of a stretch that are looked at, in lengths of a sequence: the simulator takes its time."""

_STREAM: Final = 0x6A1  # sets the sequences' random numbers apart from others of the same seed


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Where something can be gained.

    Attributes:
        problem: The stretch, as a task.
        offset: Recorded actions from the stretch's start to the moment.
        now: The judged distance there.
        after: The judged distance after each of the sequences.
    """

    problem: Problem
    offset: int
    now: float
    after: Float[np.ndarray, " s"]

    @property
    def gains(self) -> Float[np.ndarray, " s"]:
        """What each sequence brings: the decrease of the judged distance."""
        gains: Float[np.ndarray, " s"] = self.now - self.after
        return gains

    @property
    def best(self) -> float:
        """What the best of the sequences brings."""
        return float(self.gains.max())


_DRAWS: Final = 100
"""For each sequence that is wanted."""


def fixed_sequences(
    spec: ActionSpec, count: int, horizon: int, seed: int
) -> Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"]:
    """Different sequences of actions: a pure function of its arguments.

    Each begins with a random action, and each further action is the one before it with ``REPEAT_PROBABILITY``, else
    another random one. Discrete actions begin with each action repeated all the time.

    Args:
        spec: What can be done.
        count: How many; of discrete actions no more than there are.
        horizon: Actions in a sequence.
        seed: Of the random numbers.

    Returns:
        Numbers of discrete actions, or continuous ones in [-1, 1].
    """
    generator = np.random.default_rng([seed, _STREAM])
    if isinstance(spec, Continuous):
        return _repeated(generator.uniform(-1, 1, (count, horizon, spec.width)), generator)
    if len(spec) ** horizon <= count:
        return np.array(list(itertools.product(range(len(spec)), repeat=horizon)), np.int64)
    found = dict.fromkeys((action,) * horizon for action in range(min(len(spec), count)))
    for _ in range(_DRAWS * count):
        if len(found) == count:
            break
        drawn = _repeated(generator.integers(len(spec), size=(1, horizon)), generator)
        found[tuple(drawn[0].tolist())] = None
    else:  # nearly all that there are: the rarest would hardly ever be drawn
        rest = (one for one in itertools.product(range(len(spec)), repeat=horizon) if one not in found)
        found |= dict.fromkeys(itertools.islice(rest, count - len(found)))
    return np.array(list(found), np.int64)


def _repeated(drawn: np.ndarray, generator: np.random.Generator) -> np.ndarray:
    """The sequences with some actions replaced by the ones before them."""
    repeats = generator.random(drawn.shape[:2]) < REPEAT_PROBABILITY
    repeated = drawn.copy()
    for step in range(1, drawn.shape[1]):
        repeated[repeats[:, step], step] = repeated[repeats[:, step], step - 1]
    return repeated


def find_moment(
    problem: Problem,
    recorded: Int[np.ndarray, " t"] | Float[np.ndarray, "t a"],
    sequences: Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"],
    make_env: Callable[[], Environment],
) -> Moment | None:
    """The moment of a stretch at which the best sequence brings most; None where none brings anything.

    Moments ``SPACING`` times as far apart as a sequence is long are looked at.

    Args:
        problem: The stretch.
        recorded: The actions that were recorded from its start on.
        sequences: As ``fixed_sequences`` gives them.
        make_env: Makes a simulator.
    """
    env = make_env()
    try:
        simulation, found = Simulation(env, problem), list[Moment]()
        tried, walked, horizon = _in_units(env.facts.actions, sequences), as_actions(recorded), sequences.shape[1]
        here, spacing = simulation.here, SPACING * horizon
        for offset in range(0, problem.task.goal - problem.task.start, spacing):
            after = np.array([carried_out(simulation, here, actions).distance for actions in tried])
            found.append(Moment(problem=problem, offset=offset, now=here.distance, after=after))
            here = carried_out(simulation, here, walked[offset : offset + spacing])
    finally:
        env.close()
    best = max(found, key=lambda moment: moment.best)
    return best if best.best > 0 else None


def carried_out(simulation: Simulation, place: Place, actions: Sequence[ActionTaken]) -> Place:
    """The place that some actions lead to."""
    for action in actions:
        place = simulation.step(place, action)
    return place


def _in_units(
    spec: ActionSpec | None, sequences: Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"]
) -> list[list[ActionTaken]]:
    """The sequences as an environment takes them."""
    if isinstance(spec, Continuous):
        sequences = spec.denormalise(sequences)
    else:
        assert isinstance(spec, Discrete), "only what can be done can bring anything"
    return [as_actions(one) for one in sequences]
