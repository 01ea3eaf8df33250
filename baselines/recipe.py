"""How the compact models are trained: DMotion's recipe for every one of them, so that none is favoured by it."""

from __future__ import annotations

from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.specs import Preset


def compact_recipe(preset: Preset) -> TrainingConfig:
    """Muon with a linear schedule, half of each batch drawn by loss; the same number of triplets for all."""
    return TrainingConfig(
        epochs={Preset.TINY: 1, Preset.SMALL: 20, Preset.PAPER: 50}[preset],
        learning_rate=3e-3,
        optimizer="muon",
        schedule="linear",
        clip_norm=0.0,
        hard_share=0.5,
    )
