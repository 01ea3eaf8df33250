"""Clustering: unlabelled video says where the latent action lies that a demonstration names.

What a model reads off a single demonstration holds more than its action. Where the camera shakes, DMotion's motion
holds that shake, too, and every prediction of the action repeats it. But the video shows each action a thousand times,
and the latent actions that are read off it lie around one middle for each action. k-means that begins at the
demonstrations finds these middles, and the demonstrations say which is which: seeded k-means (Basu, Banerjee, Mooney:
Semi-supervised Clustering by Seeding, ICML 2002). No further label is read.
"""

from __future__ import annotations

from typing import Any, Final

import numpy as np
import torch
from einops import rearrange

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.action_to_latent import ActionToLatent
from dmotion_bench.learning.data.curriculum import TrainingData, video_sample
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import ForwardModel

VIDEO_TRIPLETS: Final = 1024
"""At most so many are looked at."""
AT_ONCE: Final = 64


def tables_of(model: ForwardModel[Any]) -> list[ActionToLatent]:
    """What a model's labels taught: a table, or one for each agent.

    Raises:
        UsageError: The model keeps it otherwise.
    """
    if not (tables := [module for module in model.modules() if isinstance(module, ActionToLatent)]):
        raise UsageError(
            f"{type(model).__qualname__} keeps its latent actions in no ActionToLatent, which '--set "
            "adaptation=clustered' would move; leave it out."
        )
    return tables


@torch.no_grad()
def cluster(model: ForwardModel[Any], data: TrainingData, device: torch.device) -> None:
    """Move the latent action of each demonstrated action to the middle of those around it in the video.

    Args:
        model: Aligned with its demonstrations, in evaluation mode. It has ``latent_action``: of several agents, the
            parts of ``tables_of`` one after the other.
        data: Whose video is read.
        device: Of the model.
    """
    reader: Any = model  # that it reads latent actions is asked before the training (runs/start.py)
    video, read = video_sample(data, VIDEO_TRIPLETS), []
    for first in range(0, len(video), AT_ONCE):
        stored = torch.from_numpy(video.gather(np.arange(first, min(first + AT_ONCE, len(video))))).to(device)
        frames = (to_model(one) for one in rearrange(stored, "b s h w c -> s b h w c"))
        read.append(reader.latent_action(*frames).float())
    tables = tables_of(model)
    for table, part in zip(tables, torch.cat(read).chunk(len(tables), dim=-1), strict=True):
        table.settle(part)
