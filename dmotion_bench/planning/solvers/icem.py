"""iCEM: the cross-entropy method with what Pinneri et al. 2020 add to it.

"Sample-efficient Cross-Entropy Method for Real-time Planning", CoRL 2020: correlated noise, elites that are kept from
iteration to iteration, and the best sequences of the step before, shifted by one, among the first candidates. For
discrete actions correlated noise becomes a probability to repeat the action before.
"""

from __future__ import annotations

from dataclasses import dataclass

from dmotion_bench.planning.solvers.cem import CrossEntropy


@dataclass(frozen=True, kw_only=True)
class ImprovedCrossEntropy(CrossEntropy):
    """iCEM; the fields are those of CEM."""

    action_repeat_prob: float = 0.6
    kept_elites: int = 5
