"""Whether a trained model predicts each triplet by itself, and the same each time; else its figures are of chance.

The contract asks for both (``testing/prediction.py``). A training that begins with a breach only warns, and a model can
break it by what it has learned, so it is looked at again where figures are made of it.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.storage.readable import ReadableDataset

IMAGES: Final = 3
"""Pairs of frames that a model is tried on."""

FEWEST_FRAMES: Final = 3
"""Of an episode that has a triplet."""

SAME: Final = 1e-3
"""As far as the contract lets predictions of one image differ from one batch to another."""

AT_RANDOM: Final = "predict differs from one call to the next with the same arguments, so its figures are of one draw"
TOGETHER: Final = (
    "predict gives a frame that depends on the other frames of the batch, so its figures depend on the size of batches"
)


def unsound_prediction(model: ForwardModel[Any], dataset: ReadableDataset) -> str | None:
    """In which way a model's predictions break the contract, in words; None if they keep it.

    Args:
        model: As it was trained; it is left in evaluation mode.
        dataset: With labels. The first frames of its first episode that has a triplet are tried, with the actions that
            were taken.
    """
    if dataset.spec.actions is None or not model.needs_pixels:
        return None
    long_enough = np.flatnonzero(dataset.rows.lengths >= FEWEST_FRAMES)
    if not len(long_enough):
        return None
    episode = int(long_enough[0])
    model.eval()
    device = next(iter(model.state_dict().values())).device
    frames = to_model(torch.from_numpy(dataset.video(episode)[: IMAGES + 2].copy())).to(device)
    previous, current, count = frames[:-2], frames[1:-1], len(frames) - 2
    actions = as_tensor(dataset.states(episode).actions[1 : count + 1]).to(device)

    def predicted(chosen: slice) -> Float[Tensor, "n c h w"]:
        return model.predict(previous[chosen], current[chosen], actions[chosen])

    with torch.inference_mode():
        return _breach(predicted, count)


def _breach(predicted: Callable[[slice], Tensor], count: int) -> str | None:
    together = predicted(slice(None))
    if not torch.equal(together, predicted(slice(None))):
        return AT_RANDOM
    alone = torch.cat([predicted(slice(place, place + 1)) for place in range(count)])
    return None if torch.allclose(together, alone, atol=SAME) else TOGETHER
