"""Everything that is measured on a predicted frame and its true frame, by the columns of ``samples.parquet``."""

from __future__ import annotations

from jaxtyping import UInt8
from torch import Tensor

from dmotion_bench.positions import PositionFinder, Positions
from dmotion_bench.scoring.pixels import mean_squared_error, peak_signal_to_noise, structural_similarity
from dmotion_bench.scoring.position_errors import distances, first_things, position_errors
from dmotion_bench.specs import EnvSpec

OBJECTS_ONLY = "_objects"
"""Suffix of position figures over the objects without the agent, where the agent has a colour of its own."""


class FrameMeasures:
    """Measures predictions in one environment.

    Args:
        spec: Says what the finder looks for; without coloured things only pixels are compared.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self._objects = len(spec.objects)
        self._agent = spec.agent_has_color
        self._finder = PositionFinder(spec) if self._objects or self._agent else None

    def positions(self, frames: UInt8[Tensor, "b h w 3"]) -> Positions | None:
        """The positions of the objects; for a true frame they are computed once and used for many predictions."""
        return None if self._finder is None else self._finder.find(frames)

    def compare(
        self,
        predicted: UInt8[Tensor, "b h w 3"],
        truth: UInt8[Tensor, "b h w 3"],
        truth_positions: Positions | None,
        *,
        similarity: bool = True,
    ) -> dict[str, Tensor]:
        """A row of figures per frame, on the CPU.

        Args:
            predicted, truth: The frames.
            truth_positions: ``positions(truth)``.
            similarity: Whether to compute SSIM, which costs as much as all the rest ten times over.
        """
        mse = mean_squared_error(predicted, truth)
        figures = {"mse": mse, "psnr": peak_signal_to_noise(mse)}
        if similarity:
            figures["ssim"] = structural_similarity(predicted, truth)
        found = self.positions(predicted)
        if found is not None and truth_positions is not None:
            figures |= vars(position_errors(found, truth_positions))
            if self._agent and self._objects:
                without = (first_things(positions, self._objects) for positions in (found, truth_positions))
                figures |= {name + OBJECTS_ONLY: value for name, value in vars(position_errors(*without)).items()}
            figures["distance"] = distances(found, truth_positions)
            figures["found"], figures["found_truth"] = found.found, truth_positions.found
        return {name: values.cpu() for name, values in figures.items()}
