"""Predictions of single steps and of rollouts, by models and by references, measured frame by frame.

A rollout begins with the true frames (x_{t-1}, x_t), follows the recorded actions, and feeds on what it predicted.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
import pyarrow as pa
import torch
from jaxtyping import Float, Shaped, UInt8
from torch import Tensor

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.boundary import recorded_actions
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.scoring.frame_measures import FrameMeasures
from dmotion_bench.scoring.inverse import InverseModel, inverse_figures
from dmotion_bench.scoring.latent_ranking import Ranks, rank_rollouts
from dmotion_bench.scoring.references import REFERENCES
from dmotion_bench.scoring.samples import STATE_PROBE, SampleRows, action_column
from dmotion_bench.scoring.state_probes import probe_states
from dmotion_bench.scoring.transitions import HeldOut, RolloutBatch, TransitionBatch

MODEL = "model"


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
    """Turn off gradients and TF32, which rounds float32 to 10 bits; ``bf16`` turns on autocast, which is faster.

    Actions are taken as they were recorded, also beyond the bounds of the training.
    """
    convolutions = torch.backends.cudnn.flags(enabled=True, benchmark=False, deterministic=True, allow_tf32=False)
    rounded = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
    products = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        with torch.inference_mode(), convolutions, rounded, recorded_actions():
            yield
    finally:
        torch.set_float32_matmul_precision(products)


def score_steps(model: ForwardModel[Any], held_out: HeldOut, how: Execution) -> pa.Table:
    """Score the predicted next frame of every held-out triplet; for latent actions see ``latent_samples.py``."""
    measures, rows, done = FrameMeasures(held_out.dataset.spec), SampleRows("prediction", MODEL), 0
    probed = probe_states(model, held_out, batch_size=how.batch_size, device=how.device)
    for batch in held_out.batches(how.batch_size, masks=False):
        stored = torch.from_numpy(batch.frames).to(how.device)
        previous, current = to_model(stored[:, 0]), to_model(stored[:, 1])
        action = as_tensor(batch.action, how.device)
        predicted = predicted_pixels(model, model.predict(previous, current, action), current.shape)
        truth = stored[:, 2]
        columns = measures.compare(predicted, truth, measures.positions(truth))
        if isinstance(model, InverseModel):
            named = model.infer_action(previous, current, to_model(truth))
            columns |= inverse_figures(named, action, held_out.dataset.spec.actions)
        here = {STATE_PROBE + name: values[done : done + len(batch)] for name, values in probed.items()}
        rows.add(_described(batch) | here | _numpy(columns))
        done += len(batch)
        how.progress("single steps", done, len(held_out))
    return rows.table()


def score_rollouts(model: ForwardModel[Any], held_out: HeldOut, how: Execution, *, horizon: int) -> pa.Table:
    """Score rollouts of ``horizon`` steps from up to four starts in each held-out episode, and their ranks.

    A model that draws no frames (``needs_pixels``) has the ranks alone.
    """

    def predict(batch: RolloutBatch) -> UInt8[Tensor, "b t h w 3"]:
        previous, current = (
            to_model(torch.from_numpy(frames).to(how.device)) for frames in (batch.previous, batch.current)
        )
        actions = as_tensor(batch.actions, how.device)
        frames = model.rollout(previous, current, actions)
        return predicted_pixels(model, frames, (len(current), actions.shape[1], *current.shape[1:]))

    size = _rollouts_at_once(how, horizon)
    ranked = rank_rollouts(model, held_out, horizon=horizon, batch_size=size, device=how.device)
    return _rolled_out(MODEL, predict if model.needs_pixels else None, held_out, how, horizon, ranked)


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
    predict: Callable[[RolloutBatch], UInt8[Tensor, "b t h w 3"]] | None,
    held_out: HeldOut,
    how: Execution,
    horizon: int,
    ranked: Ranks | None = None,
) -> pa.Table:
    measures, rows, done = FrameMeasures(held_out.dataset.spec), SampleRows("rollout", predictor), 0
    total = held_out.count_rollouts(horizon)
    for batch in held_out.rollouts(horizon, _rollouts_at_once(how, horizon)):
        compared = predict and (predict(batch), torch.from_numpy(batch.future).to(how.device))
        for ahead in range(horizon):
            columns = {}
            if compared is not None:
                predicted, truth = (frames[:, ahead] for frames in compared)
                columns = measures.compare(predicted, truth, measures.positions(truth), similarity=False)
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


def predicted_pixels(
    model: object, images: Float[Tensor, "*b c h w"], shape: tuple[int, ...]
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
