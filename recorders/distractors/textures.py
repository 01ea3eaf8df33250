"""Textures that a background is made of: shades 0-255 on a torus, so that they scroll without a seam.

Dead leaves (things in front of one another, sizes by a power law) and 1/f noise are the two classical models of the
statistics of natural pictures: Lee, Mumford and Huang, "Occlusion models for natural images", IJCV 2001; Field,
"Relations between the statistics of natural images and the response properties of cortical cells", JOSA A 1987.
Waves and cells have other statistics; they are for data that a model has not seen.

Everything is sums and products of whole numbers or of powers of two, so that every machine makes the same textures.
"""

from __future__ import annotations

import zlib
from collections.abc import Callable, Mapping
from functools import lru_cache
from types import MappingProxyType
from typing import Final

import numpy as np
from jaxtyping import Float, UInt8

TILE: Final = 192  # [px] along each side of the torus
MADE: Final = 8  # textures of each generator; an episode takes two of them, turned, mirrored and in its own colours
LEAVES: Final = 300
SMALLEST, LARGEST = 6, 40  # leaves' radii [px]
OCTAVES: Final = (3, 6, 12, 24, 48, 96)  # cells of the clouds' lattices along a side
POINTS: Final = 90  # of the cells
Shades = UInt8[np.ndarray, "n n"]


def leaves(generator: np.random.Generator) -> Shades:
    """Ellipses in front of one another; the number of those larger than r falls with 1 / r^2."""
    shades = np.zeros((TILE, TILE), np.uint8)
    share = generator.random(LEAVES)
    radii = 1 / np.sqrt(share / LARGEST**2 + (1 - share) / SMALLEST**2)
    for radius in radii.tolist():
        reach = int(radius) + 1
        line = np.arange(-reach, reach + 1)
        row, column = generator.integers(TILE, size=2).tolist()
        narrow, lean = generator.uniform(1, 2.5), generator.uniform(-1, 1)
        across = line[None] + lean * line[:, None]
        inside = across * across + narrow * (line * line)[:, None] <= radius * radius
        window = np.ix_((row + line) % TILE, (column + line) % TILE)
        shades[window] = np.where(inside, np.uint8(generator.integers(256)), shades[window])
    return shades


def clouds(generator: np.random.Generator) -> Shades:
    """Noise with as much variance in each octave, which in two dimensions is 1/f noise."""
    total = np.zeros((TILE, TILE))
    for cells in OCTAVES:
        total += _smooth(generator.integers(256, size=(cells, cells)).astype(np.float64))
    return _stretched(total)


def waves(generator: np.random.Generator) -> Shades:
    """Triangular waves of several directions and lengths, one over the other."""
    line = np.arange(TILE)
    total = np.zeros((TILE, TILE))
    for _ in range(4):
        along_x, along_y = generator.integers(-5, 6, size=2).tolist()
        phase = (along_x * line[None] + (along_y or 1) * line[:, None] + int(generator.integers(TILE))) % TILE
        total += np.minimum(phase, TILE - phase)
    return _stretched(total)


def cells(generator: np.random.Generator) -> Shades:
    """Each point of the plane has the shade of the nearest of some points."""
    line = np.arange(TILE)
    nearest, shades = np.full((TILE, TILE), np.iinfo(np.int64).max), np.zeros((TILE, TILE), np.uint8)
    for row, column, shade in generator.integers((TILE, TILE, 256), size=(POINTS, 3)).tolist():
        down, across = np.abs(line - row), np.abs(line - column)
        down, across = np.minimum(down, TILE - down), np.minimum(across, TILE - across)
        distance = (down * down)[:, None] + across * across
        closer = distance < nearest
        np.copyto(nearest, distance, where=closer)
        np.copyto(shades, np.uint8(shade), where=closer)
    return shades


GENERATORS: Final[Mapping[str, Callable[[np.random.Generator], Shades]]] = MappingProxyType(
    {"leaves": leaves, "clouds": clouds, "waves": waves, "cells": cells}
)


@lru_cache(maxsize=len(GENERATORS) * MADE)
def texture(kind: str, number: int) -> Shades:
    """One of the ``MADE`` textures of a generator; the same in every process."""
    return GENERATORS[kind](np.random.default_rng([zlib.crc32(kind.encode()), number]))


def _smooth(lattice: Float[np.ndarray, "c c"]) -> Float[np.ndarray, "n n"]:
    """The lattice's values with straight lines between them, on the torus."""
    for _ in range(2):  # along the rows, then along the columns
        step = TILE // len(lattice)
        share = np.arange(step)[None, :, None] / step
        between = lattice[:, None] * (1 - share) + np.roll(lattice, -1, axis=0)[:, None] * share
        lattice = between.reshape(TILE, -1).T
    return lattice


def _stretched(values: Float[np.ndarray, "n n"]) -> Shades:
    """From the least to the greatest value, as 0-255."""
    least, greatest = float(values.min()), float(values.max())
    shades: Shades = np.floor((values - least) * 255 / (greatest - least)).astype(np.uint8)
    return shades
