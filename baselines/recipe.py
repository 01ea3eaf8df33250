"""The training recipe of the compact models: the same for all, chosen for DMotion on validation episodes."""

from __future__ import annotations

from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.specs import Preset


def compact_recipe(preset: Preset, passes: float = 1.0) -> TrainingConfig:
    """Muon with a linear schedule, half of each batch drawn by loss.

    Args:
        preset: How long DMotion would be trained.
        passes: Times as many epochs as DMotion's: all models get about its training time (docs/baselines.md), and what
            costs a third of it per triplet sees three times as many.
    """
    epochs = {Preset.TINY: 1, Preset.SMALL: 10, Preset.PAPER: 8}[preset]
    return TrainingConfig(
        epochs=epochs if preset is Preset.TINY else epochs * passes,
        learning_rate=3e-3,
        optimizer="muon",
        schedule="linear",
        clip_norm=0.0,
        channels_last=True,
        hard_share=0.5,
    )
