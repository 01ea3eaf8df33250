"""Single steps by latent actions: what a model that learned from video predicts by its own, and what they hold.

None of it depends on the label budget. So runs that share a training share these samples, as they share the training
(``learning/training/shared_pretraining.py``); only what their actions predict is their own.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Final, Protocol, runtime_checkable

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from jaxtyping import Float, Int, Shaped, UInt8
from torch import Tensor

from dmotion_bench.learning.action_to_latent import tables_of
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs.checkpoint import weights_hash
from dmotion_bench.scoring.identification import Identification, identify
from dmotion_bench.scoring.latent_models import LatentActionModel
from dmotion_bench.scoring.pixels import mean_squared_error
from dmotion_bench.scoring.prediction import MODEL, Execution, predicted_pixels
from dmotion_bench.scoring.samples import EACH, LATENT_COLUMNS, PROBE, SCHEMA, SampleRows
from dmotion_bench.scoring.transitions import HeldOut

_ROW: Final = ("episode", "step")


@runtime_checkable
class LatentBranchingModel(Protocol):
    """A model that computes only once what several latent actions at one state have in common."""

    def begin(self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"]) -> Any:
        """See ``ForwardModel``; so is ``frame``."""

    def branch_with_latent(self, state: Any, parent: Int[Tensor, " n"], latent: Float[Tensor, "n d"]) -> Any:
        """The states after latent actions, row i at the state of row ``parent[i]``."""

    def frame(self, state: Any) -> Float[Tensor, "n c h w"]: ...


def score_latent_actions(model: LatentActionModel, held_out: HeldOut, how: Execution) -> pa.Table:
    """The columns of single steps that latent actions decide, a row for each held-out triplet; the others are null."""
    found = identify(model, held_out, batch_size=how.batch_size, device=how.device)
    rows, done = SampleRows("prediction", MODEL), 0
    for batch in held_out.batches(how.batch_size, masks=False):
        stored = torch.from_numpy(batch.frames).to(how.device)
        here = slice(done, done + len(batch))
        about = {"episode": batch.episode, "step": batch.step, "ahead": np.ones(len(batch), np.int64)}
        previous, current = to_model(stored[:, 0]), to_model(stored[:, 1])
        rows.add(about | _by_latent(model, found, here, previous, current, stored[:, 2]))
        done += len(batch)
        how.progress("latent actions", done, len(held_out))
    return rows.table()


def with_latent_actions(steps: pa.Table, latent: pa.Table) -> pa.Table:
    """Single steps, with the columns that latent actions decide.

    Args:
        steps: The samples of ``score_steps``.
        latent: Those of ``score_latent_actions``, of the same triplets.
    """
    assert all(pc.all(pc.equal(steps[name], latent[name])).as_py() for name in _ROW), "the triplets are others"
    columns = [latent[name] if name in LATENT_COLUMNS else steps[name] for name in SCHEMA.names]
    return pa.Table.from_arrays(columns, schema=SCHEMA)


def learned_from_video(model: ForwardModel[Any]) -> dict[str, str]:
    """What decides a model's latent actions: its class, its configuration, and its weights without what labels taught.

    Labels teach which latent action an action is (``ActionToLatent``). Whatever else they teach counts among the
    weights: which motion is whose among several agents, and everything in fine-tuning.
    """
    taught = {
        one.data_ptr() for table in tables_of(model) for one in table.buffers()
    }  # a model may store them by other names
    weights = {name: one for name, one in model.state_dict().items() if one.data_ptr() not in taught}
    kind = type(model)
    return {
        "model": f"{kind.__module__}.{kind.__qualname__}",
        "config": repr(model.config),
        "weights": weights_hash(weights),
    }


def _by_latent(
    model: LatentActionModel,
    found: Identification,
    here: slice,
    previous: Float[Tensor, "b c h w"],
    current: Float[Tensor, "b c h w"],
    truth: UInt8[Tensor, "b h w 3"],
) -> dict[str, Shaped[np.ndarray, "b *k"]]:
    """What the model predicts when it is given a latent action instead of a named one, and what was found of these."""
    partner = found.partner[here]
    latents = [torch.from_numpy(found.motion[rows]).to(current.device) for rows in (here, partner)]
    own, other = _with_latents(model, previous, current, latents)
    change = mean_squared_error(own, other).cpu().numpy()
    each = {} if found.each is None else vars(found.each)
    codes = {} if found.codes is None else {"codes": found.codes[here]}
    if codes:
        codes["codebook_sizes"] = np.tile(found.codebook_sizes, (len(partner), 1))
    return {
        **codes,
        **{PROBE + name: columns[here] for name, columns in found.probes.items()},
        **{EACH + name: values[here].reshape(len(partner), -1) for name, values in each.items()},
        "agent_iou": found.agent_iou[here],
        "motion_shift_error": found.motion_shift_error[here],
        "motion_probe_accuracy": found.motion_probe_accuracy[here],
        "motion_probe_error": found.motion_probe_error[here],
        "motion": found.motion[here],
        "mse_true_motion": mean_squared_error(own, truth).cpu().numpy(),
        "motion_swap_change": np.where(partner >= 0, change, np.nan),
    }


def _with_latents(
    model: LatentActionModel,
    previous: Float[Tensor, "b c h w"],
    current: Float[Tensor, "b c h w"],
    latents: Sequence[Float[Tensor, "b d"]],
) -> list[UInt8[Tensor, "b h w 3"]]:
    """What a model predicts under some latent actions; what they have in common is computed once, if it can do so."""
    if not isinstance(model, LatentBranchingModel):
        drawn = [model.predict_with_latent(previous, current, latent) for latent in latents]
    else:
        parent = torch.arange(len(current), device=current.device).repeat(len(latents))
        after = model.branch_with_latent(model.begin(previous, current), parent, torch.cat(list(latents)))
        drawn = list(model.frame(after).chunk(len(latents)))
    return [predicted_pixels(model, frames, current.shape) for frames in drawn]
