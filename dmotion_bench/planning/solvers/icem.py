"""iCEM: the cross-entropy method with what Pinneri et al. 2020 add to it.

"Sample-efficient Cross-Entropy Method for Real-time Planning", CoRL 2020: coloured noise, elites that are kept from
iteration to iteration, the best sequences of the step before, shifted by one, among the first candidates and as the
first mean, momentum of the distribution, and the mean itself among the last candidates. For discrete actions coloured
noise becomes a probability to repeat the action before. The number of samples does not fall from iteration to
iteration here.

``icem-recall`` is the same search in a model that is corrected by what was seen in the task (``experience.py``).
"""

from __future__ import annotations

from dataclasses import dataclass

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.learning.settings import only_for
from dmotion_bench.planning.dynamics.base import Dynamics
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.dynamics.recalled import RecalledDynamics
from dmotion_bench.planning.objectives.base import Evaluator
from dmotion_bench.planning.solvers.base import Plan, PlanContext
from dmotion_bench.planning.solvers.cem import CrossEntropy


@dataclass(frozen=True, kw_only=True)
class ImprovedCrossEntropy(CrossEntropy):
    """iCEM; the fields are those of CEM."""

    action_repeat_prob: float = only_for(0.6, Discrete)
    kept_elites: int = 5
    noise_exponent: float = only_for(2.0, Continuous)
    momentum: float = only_for(0.1, Continuous)


@dataclass(frozen=True, kw_only=True)
class RecallingCrossEntropy(ImprovedCrossEntropy):
    """iCEM that does not ask the model what it has seen: which image followed an action at an image of the task.

    With continuous actions, which never repeat, and with the true simulator it is iCEM.
    """

    def plan(self, dynamics: Dynamics, evaluator: Evaluator, context: PlanContext) -> Plan:
        """See ``CrossEntropy``."""
        known = context.experience if isinstance(dynamics.actions, Discrete) else None
        if known is not None and isinstance(dynamics, ModelDynamics):
            dynamics = RecalledDynamics(dynamics, known)
        return super().plan(dynamics, evaluator, context)
