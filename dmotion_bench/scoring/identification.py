"""Whether a model that learned without actions identified the agent and its motion.

A low loss alone does not show it: two numbers can carry the action whatever the map holds. So a model with a latent
action (``LatentActionModel``: DMotion's phi^0, the z of CLASP, LAPO and their like), a map of the agent
(``AgentModel``: DMotion's m^0) or a motion in pixels (``ShiftModel``) is asked for every test triplet what it has;
phi^0 below stands for any latent action:

- ``agent_iou``: |m^0| of the current frame, resized to the frame (bilinear) and cut by Otsu's threshold (1979, 256
  levels between its own least and greatest value), against the agent's true mask: intersection over union. The
  threshold is each frame's own: nothing is fitted, and a constant factor on the map changes nothing.
- ``motion_within_over_between``: variance of phi^0 within an action over its variance between actions. Zero means a
  table of actions loses nothing.
- ``motion_shift_error``: how far the shift that phi^0 stands for is from the agent's true one [px]; asked of models
  that know their unit (``ShiftModel``).
- ``motion_probe_accuracy``: how often a linear probe (discriminant analysis: nearest mean of an action, in units
  of the pooled covariance) reads the action from phi^0. It is fitted on every other episode and asked on the rest,
  then the other way round, so no episode is in its own fit.
- ``motion_probe_error``: the same for continuous actions: squared error of a ridge regression from phi^0 to the
  action, normalised to [-1, 1], averaged over its numbers. Zero means that phi^0 holds the action.
- ``mse_true_motion``: MSE with the true triplet's phi^0 instead of the table's: what the table costs.
- ``motion_swap_change``: mean squared change of the prediction, in squared pixel values, when phi^0 is another
  triplet's, of another action: near zero when the model ignores it.

- ``probe_linear[F]``, ``probe_mlp[F]``, and ``_shuffled`` of both: what probes read of each true factor F from phi^0,
  such as the action or how the background moves, and what they read of shuffled values (``probes.py``,
  ``true_factors.py``).
- ``codebook_perplexity[k]`` and ``codebook_used[k]``: of models whose latent action is made of codes
  (``CodebookModel``), the exponential of the entropy with which codes of codebook k are chosen, and the share of its
  codes that are chosen at all.

A variance within an action and the accuracy of a probe are not defined for continuous actions, and are left out there.

In a world of several agents ``agent_iou`` is of all of them together (the union of the thresholded maps against the
union of the masks), and ``motion_shift_error`` is the mean over the agents. Beside them stand four figures of each
agent k, ``agent_iou[k]``, ``motion_shift_error[k]``, ``motion_probe_accuracy[k]`` and
``motion_within_over_between[k]``, where an action is what agent k does. A model with a map and a motion for each agent
(``AgentsModel``) is asked for those of agent k; those of a model that has one of each stand against every agent.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.nn.functional as F
from jaxtyping import Bool, Float, Int, Shaped, UInt8
from torch import Tensor

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.action_to_latent import ridge
from dmotion_bench.learning.images import images_of_triplets
from dmotion_bench.scoring.latent_models import (
    AgentModel,
    AgentsModel,
    CodebookModel,
    LatentActionModel,
    ShiftModel,
    codes_fault,
)
from dmotion_bench.scoring.probes import LEAST_VARIANCE, probe
from dmotion_bench.scoring.statistics import EpisodeBootstrap, Estimate
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.scoring.true_factors import true_factors

LEVELS = 256  # of Otsu's histogram
ROUNDING = 1e-12
"""A variance between actions below this share of the whole is rounding, as where one action alone is taken."""


@dataclass(frozen=True, kw_only=True)
class EachAgent:
    """The identification figures of each held-out triplet and agent; NaN where there is no value.

    Attributes:
        action: What each agent does.
        motion: Its part of phi^0, or all of it if the model has one motion.
        agent_iou, motion_shift_error, motion_probe_accuracy: As above.
    """

    action: Int[np.ndarray, "n k"]
    motion: Float[np.ndarray, "n k e"]
    agent_iou: Float[np.ndarray, "n k"]
    motion_shift_error: Float[np.ndarray, "n k"]
    motion_probe_accuracy: Float[np.ndarray, "n k"]


@dataclass(frozen=True, kw_only=True)
class Identification:
    """The identification figures of each held-out triplet; NaN where a triplet has no value.

    Attributes:
        motion: phi^0 of each true triplet.
        agent_iou, motion_shift_error, motion_probe_accuracy, motion_probe_error: As above, of each triplet.
        partner: A triplet of another action, to swap phi^0 with; -1 where there is none.
        probes: Of each true factor, what ``probe`` gives.
        codes: The codes that phi^0 is made of, one codebook's after the other's; None if it is not.
        codebook_sizes: Codes in each codebook.
        each: Of each agent, where there are several, their actions are joint ones, and the model has one motion or as
            many as there are agents.
    """

    motion: Float[np.ndarray, "n d"]
    agent_iou: Float[np.ndarray, " n"]
    motion_shift_error: Float[np.ndarray, " n"]
    motion_probe_accuracy: Float[np.ndarray, " n"]
    motion_probe_error: Float[np.ndarray, " n"]
    partner: Int[np.ndarray, " n"]
    probes: Mapping[str, Float[np.ndarray, "n 6"]]
    codes: Int[np.ndarray, "n m"] | None = None
    codebook_sizes: tuple[int, ...] = ()
    each: EachAgent | None = None


def identify(model: LatentActionModel, held_out: HeldOut, *, batch_size: int, device: torch.device) -> Identification:
    """Ask a model about every held-out triplet, in the order of ``held_out.batches``.

    Raises:
        ModelContractBroken: A latent action, a map of an agent or a shift holds NaN or infinity; or its codes cannot
            be.
    """
    motions, together, overlaps, shift_errors, actions, episodes, steps = [], [], [], [], [], [], []
    codes = list[Tensor]()
    for batch in held_out.batches(batch_size):
        stored = torch.from_numpy(batch.frames).to(device)
        previous, current, following = images_of_triplets(stored)
        motion = model.latent_action(previous, current, following)
        _require_numbers(model, "latent actions", motion)
        agents = torch.from_numpy(batch.agents[:, 0]).to(device)
        whole, each = _overlaps(model, current, agents, batch.shifts.shape[1])
        together.append(whole.cpu())
        overlaps.append(each.cpu())
        shift_errors.append(_shift_errors(model, motion, torch.from_numpy(batch.shifts).to(device)).float().cpu())
        motions.append(motion.float().cpu())
        actions.append(batch.action)
        episodes.append(batch.episode)
        steps.append(batch.step)
        if isinstance(model, CodebookModel):
            chosen = model.chosen_codes(previous, current, following)
            if fault := codes_fault(chosen, model.codebook_sizes, len(batch)):
                raise ModelContractBroken(f"{type(model).__name__}.chosen_codes gave {fault}.")
            codes.append(chosen.flatten(1).cpu())
    motion_table, action, episode = torch.cat(motions).numpy(), np.concatenate(actions), np.concatenate(episodes)
    spec, undefined = held_out.dataset.spec.actions, np.full(len(action), np.nan)
    if isinstance(spec, Continuous):
        right, missed = undefined, probe_error(motion_table, spec.normalise(action), episode)
        partner = far_partners(len(action))
    else:
        right, missed = probe_accuracy(motion_table, action, episode), undefined
        partner = swap_partners(action)
    overlap, shift_error = torch.cat(overlaps).numpy(), torch.cat(shift_errors).numpy()
    return Identification(
        motion=motion_table,
        agent_iou=torch.cat(together).numpy(),
        motion_shift_error=shift_error.mean(axis=1),
        motion_probe_accuracy=right,
        motion_probe_error=missed,
        partner=partner,
        probes=probe(motion_table, true_factors(held_out.dataset, episode, np.concatenate(steps), action), episode),
        codes=torch.cat(codes).numpy() if codes else None,
        codebook_sizes=model.codebook_sizes if isinstance(model, CodebookModel) else (),
        each=_each_agent(model, spec, torch.cat(motions), action, episode, overlap, shift_error),
    )


def _overlaps(
    model: LatentActionModel, current: Float[Tensor, "b c h w"], agents: UInt8[Tensor, "b h w"], count: int
) -> tuple[Float[Tensor, " b"], Float[Tensor, "b k"]]:
    """Of all agents together, and of each; NaN where the model does not say where they are."""
    if isinstance(model, AgentsModel):
        maps = model.agent_maps(current)
    elif isinstance(model, AgentModel):
        maps = model.agent_map(current)[:, None]
    else:
        return torch.full((len(current),), torch.nan), torch.full((len(current), count), torch.nan)
    _require_numbers(model, "maps of agents", maps)
    shown = torch.stack([above_otsu(resized(one, agents.shape[1:])) for one in maps.unbind(1)], dim=1)
    whole = overlap_of(shown.any(1), agents > 0)
    if shown.shape[1] not in (1, count):
        return whole, torch.full((len(current), count), torch.nan)
    shown = shown.expand(-1, count, -1, -1)
    return whole, torch.stack([overlap_of(shown[:, number], agents == number + 1) for number in range(count)], dim=1)


def _require_numbers(model: object, name: str, values: Tensor) -> None:
    if not bool(torch.isfinite(values).all()):
        raise ModelContractBroken(f"the {name} of {type(model).__name__} hold NaN or infinity; its training diverged.")


def motions_of(model: LatentActionModel, motion: Float[Tensor, "b d"]) -> Float[Tensor, "b k e"]:
    """The agents' parts of latent actions; all of them is one part of a model that knows one agent."""
    return model.agent_motions(motion) if isinstance(model, AgentsModel) else motion[:, None]


def _shift_errors(
    model: LatentActionModel, motion: Float[Tensor, "b d"], shifts: Float[Tensor, "b k 2"]
) -> Float[Tensor, "b k"]:
    parts = motions_of(model, motion)
    if not isinstance(model, ShiftModel) or parts.shape[1] not in (1, shifts.shape[1]):
        return torch.full(shifts.shape[:2], torch.nan)
    found = torch.stack([model.pixel_shift(part) for part in parts.unbind(1)], dim=1)
    _require_numbers(model, "shifts in pixels", found)
    error: Tensor = torch.linalg.vector_norm(found - shifts, dim=-1)
    return error


def _each_agent(
    model: LatentActionModel,
    spec: ActionSpec | None,
    motion: Float[Tensor, "n d"],
    action: Shaped[np.ndarray, "n *a"],
    episode: Int[np.ndarray, " n"],
    overlap: Float[np.ndarray, "n k"],
    shift_error: Float[np.ndarray, "n k"],
) -> EachAgent | None:
    count = overlap.shape[1]
    if count == 1 or not isinstance(spec, Discrete) or len(spec.parts) != count:
        return None
    parts = motions_of(model, motion).numpy()
    if parts.shape[1] not in (1, count):
        return None
    parts = np.broadcast_to(parts, (len(parts), count, parts.shape[2])).copy()
    done = spec.divided(action)
    right = [probe_accuracy(parts[:, number], done[:, number], episode) for number in range(count)]
    return EachAgent(
        action=done,
        motion=parts,
        agent_iou=overlap,
        motion_shift_error=shift_error,
        motion_probe_accuracy=np.stack(right, axis=1),
    )


def resized(maps: Float[Tensor, "b y x"], size: Sequence[int]) -> Float[Tensor, "b h w"]:
    """The size of maps' values, at the pixels of the frame."""
    return F.interpolate(maps.abs().float()[:, None], list(size), mode="bilinear", align_corners=False)[:, 0]


def overlap_of(shown: Bool[Tensor, "b h w"], masks: Bool[Tensor, "b h w"]) -> Float[Tensor, " b"]:
    """Intersection over union of what maps show and the agent's masks; NaN where the agent is not in the picture."""
    overlap = (shown & masks).flatten(1).sum(1) / (shown | masks).flatten(1).sum(1)
    return overlap.where(masks.flatten(1).any(1), torch.nan)


def above_otsu(values: Float[Tensor, "b h w"]) -> Bool[Tensor, "b h w"]:
    """Which values lie above the threshold that separates two groups best (Otsu 1979): none in a flat image."""
    flat = values.flatten(1)
    low, high = flat.amin(1, keepdim=True), flat.amax(1, keepdim=True)
    level = ((flat - low) / (high - low).clamp(min=1e-12) * (LEVELS - 1)).round_().long()
    counts = torch.zeros(len(flat), LEVELS, dtype=torch.float64, device=flat.device)
    counts.scatter_add_(1, level, torch.ones_like(level, dtype=torch.float64))
    share = (counts / flat.shape[1]).cumsum(1)
    mean = (counts / flat.shape[1] * torch.arange(LEVELS, device=flat.device)).cumsum(1)
    between = (mean[:, -1:] * share - mean).square() / (share * (1 - share)).clamp(min=1e-12)
    threshold = between.argmax(1, keepdim=True)
    return (level > threshold).reshape(values.shape)


def probe_accuracy(
    motion: Float[np.ndarray, "n d"], action: Int[np.ndarray, " n"], episode: Shaped[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """1 where the linear probe reads a triplet's action, 0 where not; NaN where there was nothing to fit it on."""
    fold = np.unique(episode, return_inverse=True)[1] % 2
    right = np.full(len(action), np.nan)
    for asked in (0, 1):
        fitted, held = fold != asked, fold == asked
        if fitted.any() and held.any():
            right[held] = _nearest_mean(motion[fitted], action[fitted], motion[held]) == action[held]
    return right


def probe_error(
    motion: Float[np.ndarray, "n d"], action: Float[np.ndarray, "n a"], episode: Shaped[np.ndarray, " n"]
) -> Float[np.ndarray, " n"]:
    """Mean squared error with which a ridge regression reads each triplet's action; NaN if nothing could be fitted."""
    fold = np.unique(episode, return_inverse=True)[1] % 2
    error = np.full(len(action), np.nan)
    scale = motion.std(0, dtype=np.float64)
    inputs = torch.from_numpy(motion / np.where(scale > 0, scale, 1)).double()
    wanted = torch.from_numpy(np.asarray(action, np.float64))
    for asked in (0, 1):
        fitted, held = torch.from_numpy(fold != asked), torch.from_numpy(fold == asked)
        if fitted.any() and held.any():
            found = ridge(inputs[fitted], wanted[fitted])
            read = found[0] + inputs[held] @ found[1:]
            error[held.numpy()] = (read - wanted[held]).square().mean(1).numpy()
    return error


def far_partners(count: int) -> Int[np.ndarray, " n"]:
    """For each triplet the one half the list away; -1 if there is no other."""
    if count < 2:
        return np.full(count, -1)
    partners: Int[np.ndarray, " n"] = (np.arange(count) + count // 2) % count
    return partners


def _nearest_mean(
    motion: Float[np.ndarray, "n d"], action: Int[np.ndarray, " n"], asked: Float[np.ndarray, "m d"]
) -> Int[np.ndarray, " m"]:
    scale = motion.std(0, dtype=np.float64)
    motion, asked = (values / np.where(scale > 0, scale, 1) for values in (motion, asked))
    known = np.unique(action)
    means = np.stack([motion[action == one].mean(0) for one in known])
    residual = motion - means[np.searchsorted(known, action)]
    covariance = residual.T @ residual / len(residual)
    inverse = np.linalg.inv(covariance + LEAST_VARIANCE * np.eye(len(covariance)))
    score = asked @ inverse @ means.T - 0.5 * np.einsum("kd,de,ke->k", means, inverse, means)
    chosen: Int[np.ndarray, " m"] = known[score.argmax(1)]
    return chosen


def swap_partners(action: Int[np.ndarray, " n"]) -> Int[np.ndarray, " n"]:
    """For each triplet the next one, in their order and round to the first again, that has another action."""
    count = len(action)
    twice = np.concatenate([action, action])
    changes = np.flatnonzero(twice[1:] != twice[:-1]) + 1
    if not len(changes):
        return np.full(count, -1)
    partner: Int[np.ndarray, " n"] = changes[np.searchsorted(changes, np.arange(count), side="right")] % count
    return partner


def motion_within_over_between(
    motion: Float[np.ndarray, "n d"], action: Int[np.ndarray, " n"], bootstrap: EpisodeBootstrap
) -> Estimate | None:
    """Variance of phi^0 within an action over its variance between actions, summed over phi^0's numbers.

    The figure is the mean over triplets of |phi - mean of its action|^2 / variance between, and std that of these
    values; the interval is of the whole ratio. None where the actions' means do not differ, or there is one action.
    """
    known, index = np.unique(action, return_inverse=True)
    of_action = np.eye(len(known))[index]
    count = of_action.sum(0)
    vectors = motion.astype(np.float64) - motion.mean(0, dtype=np.float64)
    means = of_action.T @ vectors / count[:, None]
    between = float((count @ means**2).sum() / len(vectors))
    if between <= ROUNDING * float((vectors**2).sum() / len(vectors)):
        return None
    ratio = ((vectors - means[index]) ** 2).sum(1) / between
    size = vectors.shape[1]
    by_episode = bootstrap.totals_by(vectors, index, len(known))
    totals = [bootstrap.totals(of_action), by_episode.reshape(len(by_episode), -1), bootstrap.totals(vectors**2)]

    def statistic(sums: Float[np.ndarray, "r m"]) -> Float[np.ndarray, " r"]:
        counts, vector_sums, squares = np.split(sums, [len(known), len(known) * (1 + size)], axis=1)
        everything = counts.sum(1, keepdims=True)
        by_action = vector_sums.reshape(len(sums), len(known), size)
        explained = np.nansum(by_action**2 / counts[:, :, None], axis=1) / everything
        total = squares / everything
        across = (explained - (by_action.sum(1) / everything) ** 2).sum(1)
        across[across <= ROUNDING * total.sum(1)] = np.nan
        return np.asarray((total - explained).sum(1) / across)

    low, high = bootstrap.interval(np.concatenate(totals, axis=1), statistic)
    return Estimate(
        mean=float(ratio.mean()),
        std=float(ratio.std()),
        low=low,
        high=high,
        n=len(ratio),
        episodes=bootstrap.present(np.ones(len(ratio), np.bool_)),
    )


def codebook_use(codes: Int[np.ndarray, "n m"], size: int) -> dict[str, Estimate]:
    """How many codes of a codebook are in use: by the entropy of their shares, and as the share that is chosen at all.

    Without intervals: episodes that are drawn anew can only lose codes.
    """
    counts = np.bincount(codes.reshape(-1), minlength=size)
    shares = counts[counts > 0] / counts.sum()
    values = {
        "codebook_perplexity": float(np.exp(-(shares * np.log(shares)).sum())),
        "codebook_used": float((counts > 0).mean()),
    }
    return {name: Estimate(mean=one, std=0.0, low=None, high=None, n=len(codes)) for name, one in values.items()}
