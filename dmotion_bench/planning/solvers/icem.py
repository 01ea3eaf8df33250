"""iCEM: the cross-entropy method with what Pinneri et al. 2020 add to it.

"Sample-efficient Cross-Entropy Method for Real-time Planning", CoRL 2020: coloured noise, elites that are kept from
iteration to iteration, the best sequences of the step before, shifted by one, among the first candidates and as the
first mean, momentum of the distribution, and the mean itself among the last candidates. For discrete actions coloured
noise becomes a probability to repeat the action before. The number of samples does not fall from iteration to
iteration here.
"""

from __future__ import annotations

from dataclasses import dataclass

from dmotion_bench.planning.solvers.cem import CrossEntropy


@dataclass(frozen=True, kw_only=True)
class ImprovedCrossEntropy(CrossEntropy):
    """iCEM; the fields are those of CEM."""

    action_repeat_prob: float = 0.6
    kept_elites: int = 5
    noise_exponent: float = 2.0
    momentum: float = 0.1
