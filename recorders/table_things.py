"""What lies on the table of the pushing environments: coloured objects, and things that drift and touch nothing."""

from __future__ import annotations

import colorsys
from collections.abc import Iterable
from types import MappingProxyType

import numpy as np
from jaxtyping import Float

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import ObjectSpec

COLORS = MappingProxyType(
    {
        "red": (217, 38, 38),
        "green": (38, 173, 38),
        "blue": (51, 51, 230),
        "yellow": (230, 230, 38),
        "magenta": (217, 43, 217),
        "cyan": (38, 204, 204),
    }
)
"""The objects' colours (RGB), 60 degrees of hue apart."""


def colored_objects(count: int, shapes: str, known: Iterable[str]) -> tuple[ObjectSpec, ...]:
    """So many objects, of shapes named one after the other and separated by commas, repeated where too few.

    Raises:
        InvalidSetting: There are not so many colours.
        UnknownName: There is no such shape.
    """
    if not 1 <= count <= len(COLORS):
        raise InvalidSetting(f"objects={count!r} is not possible; it takes 1 to {len(COLORS)}.")
    names = [name.strip() for name in shapes.split(",")]
    for name in names:
        if name not in known:
            raise UnknownName("shape", name, known)
    chosen = [names[index % len(names)] for index in range(count)]
    return tuple(
        ObjectSpec(name=f"{color}_{shape}", shape=shape, color=COLORS[color])
        for color, shape in zip(COLORS, chosen, strict=False)
    )


def turned(color: tuple[int, int, int], degrees: float) -> tuple[float, float, float]:
    """RGB 0-255 with its hue turned, as RGB 0-1."""
    hue, lightness, saturation = colorsys.rgb_to_hls(*(channel / 255 for channel in color))
    return colorsys.hls_to_rgb((hue + degrees / 360) % 1.0, lightness, saturation)


class Drift:
    """Where things are that drift over a table, whatever the pusher does: straight on, and back at the edges.

    Args:
        count: How many.
        reach: How far from the table's middle they go, along x and y [m].
        speed: [m] a step.
    """

    def __init__(self, generator: np.random.Generator, count: int, *, reach: tuple[float, float], speed: float) -> None:
        starts, turns = generator.uniform(0, 1, (count, 2)), generator.uniform(-np.pi, np.pi, count)
        self._reach = np.asarray(reach)
        self._starts = starts * 2 * self._reach
        self._steps = speed * np.stack([np.cos(turns), np.sin(turns)], axis=-1)

    def places(self, moment: int) -> Float[np.ndarray, "d 2"]:
        """From the table's middle [m] after so many steps."""
        way = (self._starts + self._steps * moment) % (4 * self._reach)
        places: Float[np.ndarray, "d 2"] = self._reach - np.abs(way - 2 * self._reach)
        return places
