"""The distributions that solvers draw sequences from, for each kind of action.

Continuous actions are in [-1, 1]. Their noise may be coloured: its power falls with frequency as f^-beta, so a sequence
pushes on in one direction instead of trembling (Pinneri et al. 2020, section 3.1; drawn in the frequency domain after
Timmer & Koenig 1995, "On generating power law noise", Astronomy and Astrophysics 300, 707-710).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from dmotion_bench.actions import ActionSpec, Continuous
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.base import Dynamics, Observation
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.planning.solvers.rollouts import Rollouts
from dmotion_bench.planning.solvers.search import Search


def search(dynamics: Dynamics, evaluator: Evaluator, observation: Observation, horizon: int) -> Search:
    """The search that suits the actions."""
    if isinstance(dynamics.actions, Continuous):
        return Rollouts(dynamics, evaluator, observation)
    return PrefixTree(dynamics, evaluator, observation, horizon)


def require_continuous(actions: ActionSpec, solver: str) -> Continuous:
    """The specification, for solvers of continuous actions.

    Raises:
        InvalidSetting: The actions are discrete.
    """
    if isinstance(actions, Continuous):
        return actions
    raise InvalidSetting(
        f"the planner {solver!r} needs continuous actions, and these are discrete: {actions}; "
        "use 'cem', 'icem', 'random-shooting' or 'exhaustive'."
    )


@dataclass(frozen=True, kw_only=True)
class Categorical:
    """A chance for each discrete action at each step.

    Attributes:
        chance: Of each action.
        allowed: Actions that may be the first.
        repeat: The probability to repeat the action before, at temperature 1.
    """

    chance: Float[np.ndarray, "b t a"]
    allowed: Bool[np.ndarray, "b a"]
    repeat: float

    @classmethod
    def uniform(cls, actions: int, blocked: Bool[np.ndarray, "b a"], horizon: int, repeat: float) -> Categorical:
        """All actions alike; none that is blocked comes first, unless all are."""
        chance = np.full((len(blocked), horizon, actions), 1 / actions)
        return cls(chance=chance, allowed=~(blocked & ~blocked.all(axis=1, keepdims=True)), repeat=repeat)

    def draw(
        self, generators: Sequence[np.random.Generator], count: int, temperature: float = 1.0
    ) -> Int[np.ndarray, "b s t"]:
        """Sequences for each task; ``temperature`` is 1 in a search's first iteration and 0 in its last."""
        return np.stack(
            [
                draw(generator, own, first, count, self.repeat * temperature)
                for generator, own, first in zip(generators, self.chance, self.allowed, strict=True)
            ]
        )

    def fitted(self, elite: Int[np.ndarray, "b e t"]) -> Categorical:
        """The shares of the actions among the elites."""
        return replace(self, chance=(elite[..., None] == np.arange(self.chance.shape[2])).mean(axis=1))


@dataclass(frozen=True, kw_only=True)
class Gaussian:
    """A mean and a standard deviation for each number of a continuous action at each step; samples are clipped.

    Attributes:
        mean, std: In [-1, 1] units.
        exponent: beta, of the noise's colour; 0 is white.
        momentum: The share of the mean and the deviation before that a fit keeps.
    """

    mean: Float[np.ndarray, "b t a"]
    std: Float[np.ndarray, "b t a"]
    exponent: float
    momentum: float

    def draw(
        self, generators: Sequence[np.random.Generator], count: int, temperature: float = 1.0
    ) -> Float[np.ndarray, "b s t a"]:
        """Sequences for each task; at temperature 0 the last one is the mean itself."""
        steps, numbers = self.mean.shape[1:]
        noise = np.stack(
            [coloured(one, (count, numbers, steps), self.exponent).transpose(0, 2, 1) for one in generators]
        )
        if temperature == 0:
            noise[:, -1] = 0
        drawn: Float[np.ndarray, "b s t a"] = (self.mean[:, None] + self.std[:, None] * noise).clip(-1, 1)
        return drawn

    def fitted(self, elite: Float[np.ndarray, "b e t a"]) -> Gaussian:
        """The mean and the deviation of the elites."""
        old = self.momentum
        mean, std = elite.mean(axis=1), elite.std(axis=1)
        return replace(self, mean=old * self.mean + (1 - old) * mean, std=old * self.std + (1 - old) * std)


def coloured(generator: np.random.Generator, shape: tuple[int, ...], exponent: float) -> Float[np.ndarray, "*n t"]:
    """Noise along the last axis whose power falls as f^-exponent; each number has the standard deviation 1.

    The lowest frequency that so few steps hold stands for all below it, the constant one, too.
    """
    steps = shape[-1]
    if exponent == 0 or steps == 1:
        return generator.standard_normal(shape)
    frequency = np.fft.rfftfreq(steps)
    frequency[0] = frequency[1]
    scale = frequency ** (-exponent / 2)
    count = (*shape[:-1], len(frequency))
    real, imaginary = generator.standard_normal(count), generator.standard_normal(count)
    weight = np.full(len(frequency), 2.0)  # of a frequency's power: it stands for its negative, too
    edges = [0] + ([-1] if steps % 2 == 0 else [])
    imaginary[..., edges] = 0
    real[..., edges] *= np.sqrt(2)
    weight[edges] = 1.0
    deviation = np.sqrt(2 * (weight * scale**2).sum()) / steps
    noise: Float[np.ndarray, "*n t"] = np.fft.irfft((real + 1j * imaginary) * scale, n=steps, axis=-1) / deviation
    return noise


def draw(
    generator: np.random.Generator,
    chance: Float[np.ndarray, "t a"],
    first: Bool[np.ndarray, " a"],
    count: int,
    repeat: float = 0.0,
) -> Int[np.ndarray, "s t"]:
    """Sequences whose steps are drawn from ``chance``, or, with the probability ``repeat``, repeat the step before.

    The first action is one that ``first`` allows, unless ``chance`` gives it no such one.
    """
    allowed = chance[0] * first
    rows = np.concatenate([(allowed if allowed.any() else np.asarray(first, float))[None], chance[1:]])
    bounds = rows.cumsum(axis=1)
    fresh: Int[np.ndarray, "s t"] = (generator.random((count, len(rows), 1)) * bounds[:, -1:] >= bounds).sum(axis=2)
    if not repeat:
        return fresh
    repeats = generator.random(fresh.shape) < repeat
    repeats[:, 0] = False
    source = np.maximum.accumulate(np.where(repeats, 0, np.arange(len(rows))), axis=1)
    return np.take_along_axis(fresh, source, axis=1)


def shifted(memory: Any) -> Any:
    """Sequences of the step before, one action on, with the last action repeated; the steps are the third axis."""
    return np.concatenate([memory[:, :, 1:], memory[:, :, -1:]], axis=2)


def carried_on(memory: Any) -> Plan:
    """The plan of the step before, one action on: nothing is predicted, so what it costs now is not known."""
    left = shifted(memory)
    unknown = np.full(left.shape[:2], np.nan)
    return Plan(action=left[:, 0, 0], candidates=left, costs=unknown, progress=unknown[:, :1], frames=0, memory=left)
