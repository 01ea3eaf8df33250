"""``background``: a moving picture over everything that is neither agent nor object.

Two planes of a texture scroll over each other, the front one with holes, each at a speed of its own that sways: so
edges appear and vanish as in a video of a scene with depth. All colours are muted, because the position finder knows
objects by theirs. Instead of textures there may be the user's clips (``clips.py``), which are muted, too.

``background`` is the share of the picture behind agent and objects that the texture makes up: at 1 the world's own
background cannot be seen any more.
"""

from __future__ import annotations

import colorsys
import math
from typing import Final, Protocol

import numpy as np
from jaxtyping import Bool, Float, UInt8

from recorders.distractors.streams import Track
from recorders.distractors.textures import MADE, TILE, Shades, texture

FASTEST: Final = 3.0  # [px] a step that a plane scrolls
SWAY, SWAY_KEPT = 0.35, 0.9  # [px] a step: what is added to its speed at each, and how much of that stays
HOLES: Final = 150  # shades of the front plane below this are holes
MOST_SATURATED: Final = 0.33  # as HSV has it; the position finder takes no colour below .45 for an object's
DARKEST, BRIGHTEST = 110, 235  # of a colour's largest channel; darker ones are near the discs of planar_push
COLORS: Final = 12  # that a plane has

Offset = tuple[float, float, float, float]
"""Along x and y [px], then the sway of the speed along x and y."""


class Backdrop(Protocol):
    """What a background shows at a moment."""

    def lay(
        self, behind: UInt8[np.ndarray, "h w 3"], moment: int, shift: tuple[int, int]
    ) -> UInt8[np.ndarray, "h w 3"]:
        """It over the picture ``behind``; ``shift`` is the camera's [px]."""


class Blend:
    """Mixes two pictures by their shares, in 1/256.

    Args:
        share: Of the upper one.
    """

    def __init__(self, share: float) -> None:
        self._upper = round(256 * share)

    def faded(self, upper: UInt8[np.ndarray, "*s"]) -> UInt8[np.ndarray, "*s"]:
        """The upper picture's part in the sum."""
        total = upper * np.uint16(self._upper)
        total += np.uint16(128)
        total >>= 8
        return total.astype(np.uint8)

    def mixed(self, lower: UInt8[np.ndarray, "*s"], faded: UInt8[np.ndarray, "*s"]) -> UInt8[np.ndarray, "*s"]:
        """The two as one picture; the sum is at most 255, as the lower one's part is rounded down."""
        if self._upper == 256:
            return faded
        total = lower.astype(np.uint16)
        total *= np.uint16(256 - self._upper)
        total >>= 8
        mixed = total.astype(np.uint8)
        mixed += faded
        return mixed


def chosen(
    choice: UInt8[np.ndarray, "*s"], one: UInt8[np.ndarray, "*s"], other: UInt8[np.ndarray, "*s"]
) -> UInt8[np.ndarray, "*s"]:
    """``one`` where ``choice`` is 255, ``other`` where it is 0; ten times as fast as a choice by truth values."""
    differing: UInt8[np.ndarray, "*s"] = np.bitwise_xor(one, other)
    differing &= choice
    differing ^= other
    return differing


def choice_of(pixels: Bool[np.ndarray, "h w"]) -> UInt8[np.ndarray, "h w*3"]:
    """What ``chosen`` takes, for the three channels of each pixel in a row."""
    return np.repeat(np.negative(pixels.view(np.uint8)), 3, axis=1)


class Textures:
    """Two planes of one generator's textures.

    Args:
        generator: Of random numbers.
        kind: The generator of textures.
        size: Of the picture [px].
        share: How much of the background they make up.
    """

    def __init__(self, generator: np.random.Generator, kind: str, *, size: int, share: float) -> None:
        self._size, self._blend = size, Blend(share)
        numbers = generator.choice(MADE, size=2, replace=False).tolist()
        back, front = (_turned(texture(kind, number), generator) for number in numbers)
        smooth = kind in ("clouds", "waves")
        self._back, self._front = (self._plane(one, _palette(generator, smooth)) for one in (back, front))
        self._solid = _padded(choice_of(front >= HOLES), size)
        back_way, front_way = _scrolling(generator), _scrolling(generator)
        self._tracks = back_way, front_way, front_way

    def lay(
        self, behind: UInt8[np.ndarray, "h w 3"], moment: int, shift: tuple[int, int]
    ) -> UInt8[np.ndarray, "h w 3"]:
        """The planes as they stand at the moment, over ``behind``."""
        size = self._size
        back, front, solid = (
            plane[y : y + size, 3 * x : 3 * (x + size)]
            for plane, track in zip((self._back, self._front, self._solid), self._tracks, strict=True)
            for x, y in (self._corner(track.at(moment), shift),)
        )
        faded = chosen(solid, front, back)
        return self._blend.mixed(behind.reshape(size, -1), faded).reshape(size, size, 3)

    def moved(self, before: int, after: int) -> Float[np.ndarray, "4"]:
        """How far the back plane and the front plane move between two moments, as (x, y) each [px]."""
        places = np.array([[track.at(moment)[:2] for track in self._tracks[:2]] for moment in (before, after)])
        there, then = np.floor(places).reshape(2, -1)
        return np.asarray(there - then)  # the corner that is seen goes one way, the picture the other

    def _plane(self, shades: Shades, palette: UInt8[np.ndarray, "256 3"]) -> UInt8[np.ndarray, "n m"]:
        return _padded(self._blend.faded(palette).take(shades, axis=0).reshape(TILE, -1), self._size)

    @staticmethod
    def _corner(offset: Offset, shift: tuple[int, int]) -> tuple[int, int]:
        """The torus's pixel in the upper left of the picture; where the camera shifts it by +1, one less."""
        return (math.floor(offset[0]) - shift[0]) % TILE, (math.floor(offset[1]) - shift[1]) % TILE


def muted(colors: UInt8[np.ndarray, "*n 3"]) -> UInt8[np.ndarray, "*n 3"]:
    """Colours (RGB) of the same hues that no position finder takes for an object's: paler, and not dark."""
    largest = colors.max(axis=-1, keepdims=True).astype(np.uint16)
    bright = DARKEST + largest * (BRIGHTEST - DARKEST) // 255
    least = np.ceil(bright * (1 - MOST_SATURATED)).astype(np.uint16)
    # black has no hue: it becomes grey
    share = np.where(largest > 0, 256 * colors.astype(np.uint32) // np.maximum(largest, 1), 256)
    paler: UInt8[np.ndarray, "*n 3"] = (least + (bright - least) * share // 256).astype(np.uint8)
    return paler


def _palette(generator: np.random.Generator, smooth: bool) -> UInt8[np.ndarray, "256 3"]:
    """A colour for each shade: few, so that video compresses; neighbours alike if ``smooth``."""
    hues, strengths, brightness = (generator.random(COLORS).tolist() for _ in range(3))
    drawn = [
        [round(255 * channel) for channel in colorsys.hsv_to_rgb(*color)]
        for color in zip(hues, strengths, brightness, strict=True)
    ]
    colors = muted(np.array(drawn, np.uint8))
    if smooth:  # three of the colours, and steps between them
        place = np.arange(COLORS) * 2 / (COLORS - 1)
        stops = colors[:3].astype(np.float64)
        colors = np.stack([np.interp(place, np.arange(3), channel) for channel in stops.T], axis=-1).astype(np.uint8)
    palette: UInt8[np.ndarray, "256 3"] = colors[np.arange(256) * COLORS // 256]
    return palette


def _turned(shades: Shades, generator: np.random.Generator) -> Shades:
    turned: Shades = np.rot90(shades, int(generator.integers(4)))
    return turned.T if generator.random() < 0.5 else turned


def _padded(plane: UInt8[np.ndarray, "n n*3"], size: int) -> UInt8[np.ndarray, "m m*3"]:
    """The torus continued by one picture to the right and below, so that every part of it is one slice."""
    wide = np.concatenate([plane, plane[:, : 3 * size]], axis=1)
    return np.concatenate([wide, wide[:size]], axis=0)


def _scrolling(generator: np.random.Generator) -> Track[Offset]:
    angle, speed = generator.uniform(-math.pi, math.pi), generator.uniform(0.5, FASTEST)
    along_x, along_y = speed * math.cos(angle), speed * math.sin(angle)

    def after(offset: Offset) -> Offset:
        x, y, sway_x, sway_y = offset
        more_x, more_y = generator.normal(0, SWAY, 2).tolist()
        sway_x, sway_y = SWAY_KEPT * sway_x + more_x, SWAY_KEPT * sway_y + more_y
        return x + along_x + sway_x, y + along_y + sway_y, sway_x, sway_y

    x, y = generator.uniform(0, TILE, 2).tolist()
    return Track((x, y, 0.0, 0.0), after)
