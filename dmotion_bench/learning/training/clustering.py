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

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.action_to_latent import tables_of
from dmotion_bench.learning.data.batches import uploaded
from dmotion_bench.learning.data.curriculum import TrainingData, video_sample
from dmotion_bench.learning.images import images_of_triplets
from dmotion_bench.learning.model import ForwardModel

VIDEO_TRIPLETS: Final = 1024
"""At most so many are looked at."""
AT_ONCE: Final = 64


def require_clusters(model: ForwardModel[Any]) -> None:
    """Refuse a model whose latent actions could not be clustered.

    Raises:
        UsageError: It reads none off frames, or keeps what labels taught it in no ``ActionToLatent``.
    """
    if not hasattr(model, "latent_action") or not tables_of(model):
        raise UsageError(
            f"{type(model).__qualname__} has no latent_action, or keeps latent actions in no ActionToLatent, and "
            "'--set adaptation=clustered' needs both; leave it out."
        )


@torch.no_grad()
def cluster(model: ForwardModel[Any], data: TrainingData, device: torch.device) -> None:
    """Move the latent action of each demonstrated action to the middle of those around it in the video.

    Args:
        model: Aligned with its demonstrations, in evaluation mode. Of several agents its ``latent_action`` has the
            parts of ``tables_of`` one after the other.
        data: Whose video is read.
        device: Of the model.
    """
    reader: Any = model  # it has latent_action: require_clusters
    video, read = video_sample(data, VIDEO_TRIPLETS), []
    for rows in np.split(np.arange(len(video)), range(AT_ONCE, len(video), AT_ONCE)):
        images = images_of_triplets(uploaded(video.gather(rows), device))
        read.append(reader.latent_action(*images).float())
    tables = tables_of(model)
    for table, part in zip(tables, torch.cat(read).chunk(len(tables), dim=-1), strict=True):
        table.settle(part)
