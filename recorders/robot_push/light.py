"""The lamp of the scene."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from jaxtyping import Float, UInt8

AMBIENT, DIFFUSE = 0.6, 0.5
LEVELS = 12
"""Steps between a surface that the lamp grazes and one that faces it: the arm's many facets compress a third better."""


@dataclass(frozen=True, kw_only=True)
class Light:
    """A lamp far away.

    Attributes:
        direction: Toward the lamp, of any length.
    """

    direction: tuple[float, float, float] = (0.3, 0.4, 1.2)

    @cached_property
    def _toward(self) -> Float[np.ndarray, "3"]:
        toward: Float[np.ndarray, "3"] = np.asarray(self.direction) / np.linalg.norm(self.direction)
        return toward

    def shade(self, colors: Float[np.ndarray, "#n 3"], normals: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
        """The colours (RGB, 0-255) of surfaces of these colours (RGB, 0-1) with these unit normals."""
        facing = np.rint(LEVELS * np.clip(normals @ self._toward, 0.0, None)) / LEVELS
        brightness = AMBIENT + DIFFUSE * facing
        lit: Float[np.ndarray, "n 3"] = np.clip(colors * brightness[..., None], 0.0, 1.0)
        shades: UInt8[np.ndarray, "n 3"] = np.rint(255 * lit).astype(np.uint8)
        return shades
