"""Scoring on video with unknown actions: how well a model explains the video by its own latent actions.

A model with a latent action (``LatentActionModel``) reads it off the true frames and draws the next frame with nothing
else of it: a few numbers are all that it is told of the future. So the figure is
``mse_true_motion`` alone, beside that of copying the last frame. It says how good the model could be with a perfect
table of actions, not that it has found the agent.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import pyarrow as pa
import torch

from dmotion_bench.errors import DatasetError, LabelsNotAvailable
from dmotion_bench.learning.data.triplets import SplitProtocol, TripletSet
from dmotion_bench.learning.images import images_of_triplets
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.scoring.latent_models import LatentActionModel
from dmotion_bench.scoring.pixels import mean_squared_error
from dmotion_bench.scoring.prediction import MODEL, Execution, predicted_pixels
from dmotion_bench.scoring.samples import SampleRows
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset

REMARK = (
    "not known; frames are drawn with the motion read off the true frames. To score what an action leads to, import "
    "the recording again with '--actions TOPIC'"
)


def explain_steps(
    model: ForwardModel[Any], dataset: Dataset, split: SplitName, protocol: SplitProtocol, how: Execution
) -> pa.Table:
    """Predict the next frame of every held-out triplet with the latent action of its true frames, beside copy-last.

    Raises:
        LabelsNotAvailable: The model has no latent action.
        DatasetError: The split is empty.
        ModelContractBroken: As ``predicted_pixels``.
    """
    if not isinstance(model, LatentActionModel):
        raise LabelsNotAvailable(
            f"the actions of {dataset.name!r} are not known, and this model predicts by actions alone; import the "
            "recording again with its actions ('dmbench data import FILE --actions TOPIC --out DIR') and train on that."
        )
    triplets = TripletSet.of_split(dataset, split, protocol)
    if not len(triplets):
        raise DatasetError(
            f"the {split} split of {dataset.name!r} has no triplet; cut the recording into more episodes with "
            "'dmbench data import' and a smaller '--frames-per-episode'."
        )
    rows = {name: SampleRows("prediction", name) for name in (MODEL, "copy_last")}
    for start in range(0, len(triplets), how.batch_size):
        part = np.arange(start, min(start + how.batch_size, len(triplets)))
        stored = torch.from_numpy(triplets.gather(part)).to(how.device)
        previous, current, following = images_of_triplets(stored)
        latent = model.latent_action(previous, current, following)
        drawn = predicted_pixels(model, model.predict_with_latent(previous, current, latent), current.shape)
        known = {
            "episode": triplets.episode[part],
            "step": triplets.step[part],
            "ahead": np.ones(len(part), np.int64),
        }
        errors = {
            MODEL: mean_squared_error(drawn, stored[:, 2]),
            "copy_last": mean_squared_error(stored[:, 1], stored[:, 2]),
        }
        for name, kept in rows.items():
            kept.add(known | {"mse_true_motion": errors[name].float().cpu().numpy()})
        how.progress("single steps", int(part[-1]) + 1, len(triplets))
    return pa.concat_tables([kept.table() for kept in rows.values()])
