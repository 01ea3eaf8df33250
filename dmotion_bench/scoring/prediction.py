"""Predictions of single steps and of rollouts, by models and by references, measured frame by frame.

A rollout begins with the true frames (x_{t-1}, x_t), follows the recorded actions, and feeds on what it predicted.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.scoring.frame_measures import FrameMeasures
from dmotion_bench.scoring.identification import Identification, LatentActionModel, identify
from dmotion_bench.scoring.inverse import InverseModel, inverse_figures
from dmotion_bench.scoring.latent_ranking import Ranks, rank_rollouts
from dmotion_bench.scoring.pixels import mean_squared_error
from dmotion_bench.scoring.references import REFERENCES
from dmotion_bench.scoring.samples import EACH, PROBE, SampleRows, action_column
from dmotion_bench.scoring.transitions import HeldOut, RolloutBatch, TransitionBatch

MODEL = "model"


@runtime_checkable
class LatentBranchingModel(Protocol):
    """A model that computes only once what several latent actions at one state have in common."""

    def begin(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> Any:
        """See ``ForwardModel``; so is ``frame``."""

    def branch_with_latent(self, state: Any, parent: Int[Tensor, " n"], latent: Float[Tensor, "n d"]) -> Any:
        """The states after latent actions, row i at the state of row ``parent[i]``."""

    def frame(self, state: Any) -> Float[Tensor, "n c h w"]: ...


Precision = Literal["float32", "bf16"]
Progress = Callable[[str, int, int], None]
"""Told what is being done, how much of it is done, and how much there is."""


def silent(what: str, done: int, total: int) -> None:
    """Report no progress."""


@dataclass(frozen=True, kw_only=True)
class Execution:
    """How scoring is carried out; it changes figures by rounding at most.

    Attributes:
        batch_size: Triplets predicted at once.
        device: Where.
        progress: Told how far it is.
    """

    batch_size: int = 64
    device: torch.device = field(default_factory=lambda: torch.device("cpu"))
    progress: Progress = silent


@contextlib.contextmanager
def predicting(device: torch.device, precision: Precision = "float32") -> Iterator[None]:
    """Turn off gradients and TF32, which rounds float32 to 10 bits; ``bf16`` turns on autocast, which is faster."""
    convolutions = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
    rounded = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
    products = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.inference_mode(), convolutions, rounded:
            yield
    finally:
        torch.set_float32_matmul_precision(products)


def score_steps(model: ForwardModel[Any], held_out: HeldOut, how: Execution) -> pa.Table:
    """Score the predicted next frame of every held-out triplet, and the identification of latent-action models."""
    measures, rows, done = FrameMeasures(held_out.dataset.spec), SampleRows("prediction", MODEL), 0
    latent = model if isinstance(model, LatentActionModel) else None
    found = identify(latent, held_out, batch_size=how.batch_size, device=how.device) if latent else None
    for batch in held_out.batches(how.batch_size):
        stored = torch.from_numpy(batch.frames).to(how.device)
        previous, current = to_model(stored[:, 0]), to_model(stored[:, 1])
        action = as_tensor(batch.action, how.device)
        predicted = _pixels(model, model.predict(previous, current, action), current.shape)
        truth = stored[:, 2]
        columns = measures.compare(predicted, truth, measures.positions(truth))
        if latent is not None and found is not None:
            here = slice(done, done + len(batch))
            columns |= _by_latent(latent, found, here, previous, current, truth)
        if isinstance(model, InverseModel):
            named = model.infer_action(previous, current, to_model(truth))
            columns |= inverse_figures(named, action, held_out.dataset.spec.actions)
        rows.add(_described(batch) | _numpy(columns))
        done += len(batch)
        how.progress("single steps", done, len(held_out))
    return rows.table()


def score_rollouts(model: ForwardModel[Any], held_out: HeldOut, how: Execution, *, horizon: int) -> pa.Table:
    """Score rollouts of ``horizon`` steps from up to four starts in each held-out episode, and their ranks."""

    def predict(batch: RolloutBatch) -> UInt8[Tensor, "b t h w 3"]:
        previous, current = (
            to_model(torch.from_numpy(frames).to(how.device)) for frames in (batch.previous, batch.current)
        )
        actions = as_tensor(batch.actions, how.device)
        frames = model.rollout(previous, current, actions)
        return _pixels(model, frames, (len(current), actions.shape[1], *current.shape[1:]))

    size = _rollouts_at_once(how, horizon)
    ranked = rank_rollouts(model, held_out, horizon=horizon, batch_size=size, device=how.device)
    return _rolled_out(MODEL, predict, held_out, how, horizon, ranked)


def score_reference_steps(held_out: HeldOut, how: Execution) -> pa.Table:
    """The references' single steps: the same triplets, the same measures.

    Where no mask ever shows the agent, as in imported recordings, moving it alone is no reference.
    """
    measures, done, agent_is_known = FrameMeasures(held_out.dataset.spec), 0, False
    rows = {name: SampleRows("prediction", name) for name in REFERENCES}
    for batch in held_out.batches(how.batch_size):
        truth = torch.from_numpy(batch.frames[:, 2]).to(how.device)
        positions = measures.positions(truth)
        agent_is_known |= bool(batch.agent.any())
        for name, reference in REFERENCES.items():
            predicted = torch.from_numpy(reference(batch)).to(how.device)
            rows[name].add(_described(batch) | _numpy(measures.compare(predicted, truth, positions)))
        done += len(batch)
        how.progress("references", done, len(held_out))
    return pa.concat_tables([kept.table() for name, kept in rows.items() if name != "agent_moves" or agent_is_known])


def score_reference_rollouts(held_out: HeldOut, how: Execution, *, horizon: int) -> pa.Table:
    """Score a rollout that copies the last frame. The reference that moves only the agent exists for one step only."""

    def predict(batch: RolloutBatch) -> UInt8[Tensor, "b t h w 3"]:
        return torch.from_numpy(batch.current).to(how.device)[:, None].expand(-1, horizon, -1, -1, -1)

    return _rolled_out("copy_last", predict, held_out, how, horizon)


def _rolled_out(
    predictor: str,
    predict: Callable[[RolloutBatch], UInt8[Tensor, "b t h w 3"]],
    held_out: HeldOut,
    how: Execution,
    horizon: int,
    ranked: Ranks | None = None,
) -> pa.Table:
    measures, rows, done = FrameMeasures(held_out.dataset.spec), SampleRows("rollout", predictor), 0
    total = held_out.count_rollouts(horizon)
    for batch in held_out.rollouts(horizon, _rollouts_at_once(how, horizon)):
        predicted, truth = predict(batch), torch.from_numpy(batch.future).to(how.device)
        for ahead in range(horizon):
            positions = measures.positions(truth[:, ahead])
            columns = measures.compare(predicted[:, ahead], truth[:, ahead], positions, similarity=False)
            described = {
                "episode": batch.episode,
                "step": batch.start + ahead,
                "ahead": np.full(len(batch.start), ahead + 1),
                "pushed": batch.pushed[:, ahead],
            } | action_column(batch.actions[:, ahead])
            if ranked is not None:
                here = slice(done, done + len(batch.start))
                described["hit_at_1"] = ranked.hit_at_1[here, ahead]
                described["reciprocal_rank"] = ranked.reciprocal_rank[here, ahead]
            rows.add(described | _numpy(columns))
        done += len(batch.start)
        how.progress(f"rollouts of {predictor}", done, total)
    return rows.table()


def _rollouts_at_once(how: Execution, horizon: int) -> int:
    return max(1, how.batch_size // horizon)


def _by_latent(
    model: LatentActionModel,
    found: Identification,
    here: slice,
    previous: Float[Tensor, "b c h w"],
    current: Float[Tensor, "b c h w"],
    truth: UInt8[Tensor, "b h w 3"],
) -> dict[str, Tensor]:
    """What the model predicts when it is given a latent action instead of a named one."""
    partner = found.partner[here]
    latents = (torch.from_numpy(found.motion[rows]).to(current.device) for rows in (here, partner))
    own, other = _with_latents(model, previous, current, list(latents))
    change = mean_squared_error(own, other).cpu()
    each = {} if found.each is None else vars(found.each)
    codes = {} if found.codes is None else {"codes": torch.from_numpy(found.codes[here])}
    if codes:
        codes["codebook_sizes"] = torch.tensor(found.codebook_sizes).expand(len(partner), -1)
    return {
        **codes,
        **{PROBE + name: torch.from_numpy(columns[here]) for name, columns in found.probes.items()},
        **{EACH + name: torch.from_numpy(values[here]).flatten(1) for name, values in each.items()},
        "agent_iou": torch.from_numpy(found.agent_iou[here]),
        "motion_shift_error": torch.from_numpy(found.motion_shift_error[here]),
        "motion_probe_accuracy": torch.from_numpy(found.motion_probe_accuracy[here]),
        "motion_probe_error": torch.from_numpy(found.motion_probe_error[here]),
        "motion": torch.from_numpy(found.motion[here]),
        "mse_true_motion": mean_squared_error(own, truth).cpu(),
        "motion_swap_change": change.where(torch.from_numpy(partner >= 0), torch.nan),
    }


def _with_latents(
    model: LatentActionModel,
    previous: Float[Tensor, "b c h w"],
    current: Float[Tensor, "b c h w"],
    latents: Sequence[Float[Tensor, "b d"]],
) -> list[UInt8[Tensor, "b h w 3"]]:
    """What a model predicts under some latent actions; what they have in common is computed once, if it can do so."""
    if not isinstance(model, LatentBranchingModel):
        return [to_pixels(model.predict_with_latent(previous, current, latent)) for latent in latents]
    parent = torch.arange(len(current), device=current.device).repeat(len(latents))
    after = model.branch_with_latent(model.begin(previous, current), parent, torch.cat(list(latents)))
    return list(to_pixels(model.frame(after)).chunk(len(latents)))


def _pixels(
    model: ForwardModel[Any], images: Float[Tensor, "*b c h w"], shape: tuple[int, ...]
) -> UInt8[Tensor, "*b h w c"]:
    """What a model predicted, as whole pixel values.

    Raises:
        ModelContractBroken: It has another shape, or numbers that are none.
    """
    kind = type(model).__name__
    if tuple(images.shape) != tuple(shape):
        raise ModelContractBroken(
            f"{kind} predicted frames of shape {tuple(images.shape)}; the contract asks for {tuple(shape)}."
        )
    if not bool(torch.isfinite(images).all()):
        raise ModelContractBroken(f"{kind} predicted frames that hold NaN or infinity; its training diverged.")
    return to_pixels(images)


def _described(batch: TransitionBatch) -> dict[str, Shaped[np.ndarray, "b *a"]]:
    return action_column(batch.action) | {
        "episode": batch.episode,
        "step": batch.step,
        "ahead": np.ones(len(batch), np.int64),
        "pushed": batch.pushed,
    }


def _numpy(columns: Mapping[str, Tensor]) -> dict[str, Any]:
    return {
        name: (values if values.dtype == torch.bool else values.float()).cpu().numpy()
        for name, values in columns.items()
    }
