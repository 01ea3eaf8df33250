"""What is told of a recording from which a model learns little, although it is sound."""

from __future__ import annotations

from typing import Final

from dmotion_bench.actions import Discrete
from dmotion_bench.storage.dataset import Dataset

FEWEST_FRAMES: Final = 3
"""An episode with fewer has no triplet, the least that a model learns from."""


def has_triplets(dataset: Dataset) -> bool:
    """Whether an episode is long enough to learn from."""
    return int(dataset.lengths.max(initial=0)) >= FEWEST_FRAMES


def recording_advice(dataset: Dataset) -> list[str]:
    """Sentences about what no model can learn from a data set, and what helps; usually none.

    Args:
        dataset: A recording that is complete.
    """
    told = []
    if isinstance(actions := dataset.spec.actions, Discrete) and len(actions.names) == 1:
        told.append(
            f"the environment has a single action, {actions.names[0]!r}: no model can learn what an action does, and "
            "there is nothing to plan. Record an environment, or a wrapper of this one, with two actions at least."
        )
    if not has_triplets(dataset):
        told.append(
            f"no episode has more than {dataset.lengths.max(initial=0)} frames, and models learn from "
            f"{FEWEST_FRAMES} in a row: nothing can be trained on this data set. Record an environment whose episodes "
            "last two steps at least."
        )
    return told
