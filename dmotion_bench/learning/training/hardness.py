"""How hard each triplet was when it was last trained on, by which a training takes some again (``hard_share``)."""

from __future__ import annotations

import logging
from collections.abc import Iterable

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.data.curriculum import Part
from dmotion_bench.learning.model import PER_TRIPLET, TrainingConfig

_log = logging.getLogger(__name__)
_UNKNOWN = np.zeros(0, np.float32)


class Hardness:
    """The latest loss of each triplet.

    Attributes:
        of_phases: By the phase's name, NaN before the first; without phases where none is remembered.
    """

    def __init__(self, parts: Iterable[Part], config: TrainingConfig) -> None:
        self.of_phases: dict[str, Float[np.ndarray, " n"]] = {
            part.phase.name: np.full(len(part.batches), np.nan, np.float32)
            for part in parts
            if config.hard_share or not config.window  # streamed triplets may be too many
        }

    def of(self, part: Part) -> Float[np.ndarray, " n"]:
        """The losses of a part's triplets; none where none is remembered."""
        return self.of_phases.get(part.phase.name, _UNKNOWN)

    def remember(
        self, part: Part, chosen: Int[np.ndarray, " b"], losses: Float[np.ndarray, " b"], *, model: str, step: int
    ) -> None:
        """Keep the losses of some triplets of a part.

        Args:
            part, chosen: Which ones.
            losses: Of each.
            model, step: What gave them, for the error.

        Raises:
            ModelContractBroken: One is below zero or not finite.
        """
        wrong = losses[~(np.isfinite(losses) & (losses >= 0))]
        if len(wrong):
            raise ModelContractBroken(
                f"{model}: losses(batch).per_triplet holds {wrong[0]} at step {step}; {PER_TRIPLET}, or the model is "
                "trained with '--set hard_share=0'."
            )
        self.of(part)[chosen] = losses

    def warn_of_none(self, model: str) -> None:
        """Say that nothing is drawn by losses, where no phase until the last one has told any."""
        if all(np.isnan(losses).all() for losses in self.of_phases.values()):
            _log.warning(
                "%s: losses(batch) gives no per_triplet, so hard_share draws nothing by it and changes nothing.", model
            )
