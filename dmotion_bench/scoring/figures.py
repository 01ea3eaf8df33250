"""From samples to the figures of a report, by their fixed names."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Float

from dmotion_bench.scoring.frame_measures import OBJECTS_ONLY
from dmotion_bench.scoring.identification import codebook_use, motion_within_over_between
from dmotion_bench.scoring.probes import probe_scores
from dmotion_bench.scoring.samples import (
    CONTROL,
    EACH,
    EACH_FIGURES,
    FIGURE_COLUMNS,
    GAIN,
    IDENTIFICATION_COLUMNS,
    PICTURE_CONTROL,
    PROBE,
    RANK_COLUMNS,
    STATE_PROBE,
    STATE_PROBED,
    column,
    vectors,
)
from dmotion_bench.scoring.statistics import FEWEST_EPISODES, RESAMPLES, EpisodeBootstrap, Estimate
from dmotion_bench.scoring.true_factors import FACTORS

PUSH = "_push"
ROLLOUT_COLUMNS = ("mse", "position_error", "position_error_paper", "miss_rate", *RANK_COLUMNS)
SUCCESS = 0.2
"""Normalised distance at the end of a control task that counts as solved."""

THRESHOLDS = (0.1, 0.2, 0.5)

SHARES: Final = frozenset(
    {
        "miss_rate",
        "false_positive_rate",
        "agent_iou",
        "motion_probe_accuracy",
        "inverse_accuracy",
        "hit_at_1",
        "reciprocal_rank",
        "control_success",
    }
)
"""Figures whose samples lie between 0 and 1, by ``base_of`` their names: where all are alike, no draw differs."""

Figures = dict[str, Estimate]
Bootstraps = Callable[[Any], EpisodeBootstrap]
"""From the episodes of some samples to their bootstrap."""


def figures_of(
    samples: pa.Table, predictor: str, *, resamples: int = RESAMPLES, fewest: int = FEWEST_EPISODES
) -> Figures:
    """Every figure that can be computed from a predictor's samples; figures without any value are left out.

    Args:
        samples: Of any predictors.
        predictor: Whose figures.
        resamples: How many draws an interval takes.
        fewest: Episodes that an interval takes.
    """
    bootstrap = partial(EpisodeBootstrap, resamples=resamples, fewest=fewest)
    mine = _where(samples, "predictor", predictor)
    single, rollout, controlled = (_where(mine, "metric", metric) for metric in ("prediction", "rollout", CONTROL))
    found = _single_steps(single, bootstrap) if len(single) else {}
    found |= _rollouts(rollout, bootstrap)
    found |= _gain(_where(mine, "metric", GAIN), bootstrap)
    found |= _control_by_pictures(_where(mine, "metric", PICTURE_CONTROL), bootstrap)
    found |= _control(controlled, bootstrap)
    return {name: one.within(0, 1) if base_of(name) in SHARES else one for name, one in found.items()}


def base_of(figure: str) -> str:
    """What a figure is a mean of, by its fixed name: without how far ahead, of which agent, and over which steps."""
    return figure.removeprefix("rollout_").partition("[")[0].removesuffix(PUSH).removesuffix(OBJECTS_ONLY)


def _where(samples: pa.Table, name: str, value: str) -> pa.Table:
    # a mask, not an expression: those run in a thread pool that costs more than all the figures together
    return samples.filter(pc.equal(samples[name], value))


def _single_steps(single: pa.Table, over_episodes: Bootstraps) -> Figures:
    bootstrap = over_episodes(column(single, "episode"))
    pushed = column(single, "pushed").astype(bool)
    found: Figures = {}
    for suffix, counted in (("", np.ones(len(single), bool)), (PUSH, pushed)):
        for name in FIGURE_COLUMNS:
            if suffix and name in IDENTIFICATION_COLUMNS:
                continue
            if (estimate := bootstrap.mean(np.where(counted, column(single, name), np.nan))) is not None:
                found[name + suffix] = estimate
    motion = vectors(single, "motion")
    if motion is not None and not single["action"].null_count:
        ratio = motion_within_over_between(motion, column(single, "action"), bootstrap)
        if ratio is not None:
            found["motion_within_over_between"] = ratio
    found |= _each_agent(single, bootstrap) | _probes(single, bootstrap) | _state_probes(single, bootstrap)
    return found | _codebooks(single)


def _probes(single: pa.Table, bootstrap: EpisodeBootstrap) -> Figures:
    """What each probe and each control reads of each true factor."""
    found: Figures = {}
    for factor in FACTORS:
        columns = vectors(single, PROBE + factor)
        if columns is not None:
            scores = probe_scores(columns.astype(np.float64), bootstrap)
            is_share = factor == "action" and not single["action"].null_count  # of names that are read right
            found |= {
                f"{PROBE}{name}[{factor}]": estimate.within(0, 1) if is_share else estimate
                for name, estimate in scores.items()
            }
    return found


def _state_probes(single: pa.Table, bootstrap: EpisodeBootstrap) -> Figures:
    """How much a probe of the model's state reads of where things are."""
    found: Figures = {}
    for name in STATE_PROBED:
        columns = vectors(single, STATE_PROBE + name)
        if columns is not None:
            whole, error = columns.astype(np.float64).T
            if (score := bootstrap.explained(error, whole)) is not None:
                found[f"{STATE_PROBE.rstrip('_')}[{name}]"] = score
    return found


def _codebooks(single: pa.Table) -> Figures:
    """How each codebook's codes are used."""
    codes, sizes = vectors(single, "codes"), vectors(single, "codebook_sizes")
    if codes is None or sizes is None:
        return {}
    found: Figures = {}
    for number, (of_one, size) in enumerate(zip(np.split(codes, sizes.shape[1], axis=1), sizes[0], strict=True)):
        found |= {f"{name}[{number}]": estimate for name, estimate in codebook_use(of_one, int(size)).items()}
    return found


def _each_agent(single: pa.Table, bootstrap: EpisodeBootstrap) -> Figures:
    """The identification figures of each of several agents, by the agent's number."""
    found: Figures = {}
    for name in EACH_FIGURES:
        values = vectors(single, EACH + name)
        for agent, of_agent in enumerate(() if values is None else values.T):
            if (estimate := bootstrap.mean(of_agent)) is not None:
                found[f"{name}[{agent}]"] = estimate
    action, motion = vectors(single, f"{EACH}action"), vectors(single, f"{EACH}motion")
    if action is not None and motion is not None:
        parts = motion.reshape(len(motion), action.shape[1], -1)
        for agent in range(action.shape[1]):
            ratio = motion_within_over_between(parts[:, agent], action[:, agent], bootstrap)
            if ratio is not None:
                found[f"motion_within_over_between[{agent}]"] = ratio
    return found


def _rollouts(rollout: pa.Table, over_episodes: Bootstraps) -> Figures:
    found: Figures = {}
    ahead, episode = column(rollout, "ahead"), column(rollout, "episode")
    for name in ROLLOUT_COLUMNS:
        values = column(rollout, name)
        for step in np.unique(ahead).tolist():
            at = ahead == step
            bootstrap = over_episodes(episode[at])
            if (estimate := bootstrap.mean(values[at])) is not None:
                found[f"rollout_{name}[{step}]"] = estimate
    return found


def is_solved(distance: Float[np.ndarray, " n"], limit: float = SUCCESS) -> Float[np.ndarray, " n"]:
    """1 for each task that ends within a distance, else 0; compared in the precision in which distances are stored."""
    return (distance.astype(np.float32) <= np.float32(limit)).astype(np.float64)


def _control(samples: pa.Table, over_episodes: Bootstraps) -> Figures:
    """The mean distance over tasks after each step, and the shares of tasks that end near the goal."""
    if not len(samples):
        return {}
    ahead, episode = column(samples, "ahead"), column(samples, "episode")
    distance = column(samples, "control_distance").astype(np.float64)
    final = ahead == ahead.max()
    bootstrap = over_episodes(episode[final])  # rows of a moment: the same tasks
    steps = range(1, int(ahead.max()) + 1)
    values = {f"control_distance[{step}]": distance[ahead == step] for step in steps}
    values["control_success"] = is_solved(distance[final])
    for limit in THRESHOLDS:
        values[f"control_success[{limit}]"] = is_solved(distance[final], limit)
    values["control_lost"] = column(samples, "control_lost")[final].astype(np.float64)
    estimates = {name: bootstrap.mean(one) for name, one in values.items()}
    return {name: estimate for name, estimate in estimates.items() if estimate is not None}


def _control_by_pictures(samples: pa.Table, over_episodes: Bootstraps) -> Figures:
    """The mean difference from the goal image over tasks after each step: it says nothing about tasks that are solved.

    Pictures may differ a lot where little is wrong, and little where much is.
    """
    if not len(samples):
        return {}
    ahead, distance = column(samples, "ahead"), column(samples, "control_distance").astype(np.float64)
    bootstrap = over_episodes(column(samples, "episode")[ahead == ahead.max()])
    estimates = {
        f"control_picture_distance[{step}]": bootstrap.mean(distance[ahead == step])
        for step in range(1, int(ahead.max()) + 1)
    }
    return {name: estimate for name, estimate in estimates.items() if estimate is not None}


def _gain(samples: pa.Table, over_episodes: Bootstraps) -> Figures:
    """The share of what could be gained at some moments that was."""
    if not len(samples):
        return {}
    bootstrap = over_episodes(column(samples, "episode"))
    gain, best = (column(samples, name).astype(np.float64) for name in ("gain", "best_gain"))
    estimate = bootstrap.ratio(gain, best)
    return {} if estimate is None else {"planning_gain": estimate}
