"""``movers`` and ``correlated``: things that move over the picture, before the background, behind agent and objects.

Movers turn at random and change their speed at every step, so the past does not tell where they go. Correlated ones
take the direction of the agent's action with the given probability, else a random one: a model that learns what its
actions do from the video alone finds them, too.

What leaves the picture on one side comes in on the other. Their colours are pale, and their hues are far from those
of all of the environment's things, so that no position finder takes them for one.
"""

from __future__ import annotations

import colorsys
import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, UInt8

from recorders.distractors.streams import Track

CORRELATED: Final = 3  # things that follow the agent's action
STEP: Final = 6.0  # [px] that these move at every step
SLOWEST, FASTEST = 1.0, 6.0  # [px] a step of the others
TURNS: Final = 0.4  # probability that one turns at a step
RADII: Final = (7, 8, 9, 10)  # [px]
MARGIN: Final = 12  # [px] beyond the picture before a thing comes in on the other side
PALE, BRIGHT = 0.36, (0.74, 0.84, 0.94)  # saturation, and the values that a colour may have
HUE_GAP: Final = 28  # [deg] at least from every hue of the environment's own
RIM: Final = (250, 250, 250)
FAMILIES: Final = (("ring", "plus"), ("diamond", "stripe"))
"""The shapes of each family of scenes."""

RGB = tuple[int, int, int]


@lru_cache(maxsize=8)
def mover_colors(own: tuple[RGB, ...]) -> tuple[RGB, ...]:
    """Colours that are none of the environment's own: pale, with hues at least ``HUE_GAP`` from all of theirs."""
    hues = []
    for color in own:
        hue, saturation, _ = colorsys.rgb_to_hsv(*(channel / 255 for channel in color))
        if saturation > PALE:
            hues.append(round(360 * hue))
    free = [hue for hue in range(0, 360, 2) if all(abs((hue - one + 180) % 360 - 180) >= HUE_GAP for one in hues)]
    chosen = free or [round(sum(hues) / len(hues))]
    return tuple(
        (round(255 * red), round(255 * green), round(255 * blue))
        for hue in chosen
        for red, green, blue in (colorsys.hsv_to_rgb(hue / 360, PALE, value) for value in BRIGHT)
    )


@dataclass(frozen=True, kw_only=True)
class Cutout:
    """What a mover looks like, with the channels of a row's pixels one after the other.

    Attributes:
        picture: RGB, 0-255.
        inside: Which of its pixels are its own.
    """

    picture: UInt8[np.ndarray, "n n*3"]
    inside: Bool[np.ndarray, "n n*3"]

    def lay(self, frame: UInt8[np.ndarray, "h w 3"], x: float, y: float) -> None:
        """Paint it with its middle at (x, y) [px]; what is outside is cut off."""
        side, (height, width, _) = len(self.inside), frame.shape
        left, top = round(x) - side // 2, round(y) - side // 2
        rows, columns = slice(max(0, -top), min(side, height - top)), slice(max(0, -left), min(side, width - left))
        if rows.start >= rows.stop or columns.start >= columns.stop:
            return
        there = frame.reshape(height, -1)[
            top + rows.start : top + rows.stop, 3 * (left + columns.start) : 3 * (left + columns.stop)
        ]
        own = (rows, slice(3 * columns.start, 3 * columns.stop))
        np.copyto(there, self.picture[own], where=self.inside[own])


@dataclass(frozen=True, kw_only=True)
class Looks:
    """What movers may look like.

    Attributes:
        size: Of the picture [px].
        shapes: Names of shapes.
        colors: RGB, 0-255.
    """

    size: int
    shapes: Sequence[str]
    colors: Sequence[RGB]

    @property
    def around(self) -> int:
        """The way from one side to the other and back to the first [px]."""
        return self.size + 2 * MARGIN

    def cutouts(self, generator: np.random.Generator, count: int) -> tuple[Cutout, ...]:
        """So many movers, each drawn at random."""
        drawn = []
        for _ in range(count):
            radius = RADII[int(generator.integers(len(RADII)))]
            shape = self.shapes[int(generator.integers(len(self.shapes)))]
            drawn.append(_cutout(shape, radius, self.colors[int(generator.integers(len(self.colors)))]))
        return tuple(drawn)


@lru_cache(maxsize=256)
def _cutout(shape: str, radius: int, color: RGB) -> Cutout:
    line = np.arange(-radius, radius + 1)
    x, y = np.abs(line)[None], np.abs(line)[:, None]

    def within(size: int) -> Bool[np.ndarray, "n n"]:
        inside: Bool[np.ndarray, "n n"]
        if shape == "ring":
            inside = (x * x + y * y <= size * size) & (4 * (x * x + y * y) >= (2 * radius - size - 1) ** 2)
        elif shape == "plus":
            inside = (np.minimum(x, y) <= size - (2 * radius) // 3) & (np.maximum(x, y) <= size)
        elif shape == "diamond":
            inside = x + y <= size
        else:
            inside = (x <= size) & (y <= size - radius // 2)
        return inside

    whole, fill = within(radius), within(radius - 1)
    picture = np.where(fill[..., None], np.array(color, np.uint8), np.array(RIM, np.uint8))
    return Cutout(picture=picture.reshape(len(whole), -1), inside=whole.repeat(3, axis=1))


Places = list[tuple[float, float]]
"""Middles (x, y) [px], counted from ``MARGIN`` left of and above the picture."""


class Movers:
    """Things that go their own ways.

    Args:
        generator: Of random numbers.
        count: How many.
        looks: What they may look like.
    """

    def __init__(self, generator: np.random.Generator, count: int, looks: Looks) -> None:
        self._cutouts, around = looks.cutouts(generator, count), looks.around
        self._around = around

        def after(state: tuple[Places, list[float]]) -> tuple[Places, list[float]]:
            turning, turned, speeds = generator.random((3, count)).tolist()
            places, ways = Places(), list[float]()
            for number, ((x, y), way) in enumerate(zip(*state, strict=True)):
                ways.append(2 * math.pi * turned[number] if turning[number] < TURNS else way)
                length = SLOWEST + (FASTEST - SLOWEST) * speeds[number]
                step_x, step_y = length * math.cos(ways[-1]), length * math.sin(ways[-1])
                places.append(((x + step_x) % around, (y + step_y) % around))
            return places, ways

        first = [(x, y) for x, y in generator.uniform(0, around, (count, 2)).tolist()]
        self._track = Track((first, generator.uniform(0, 2 * math.pi, count).tolist()), after)

    def lay(self, frame: UInt8[np.ndarray, "h w 3"], moment: int, shift: tuple[int, int]) -> None:
        """Paint them, moved by the camera's shift."""
        _lay(frame, self._cutouts, self._track.at(moment)[0], shift)

    def moved(self, before: int, after: int) -> Float[np.ndarray, "2"]:
        """How far they move between two moments in the mean, along x and y [px]."""
        there, then = (np.asarray(self._track.at(moment)[0]) for moment in (before, after))
        half = self._around / 2  # one that leaves on one side comes in on the other
        return np.asarray(((then - there + half) % self._around - half).mean(0))


class Followers:
    """Things that take the direction of the agent's action with a probability, else a random one.

    Where they are depends on the actions, so ``places`` is a state that can be put back.

    Args:
        generator: Of random numbers.
        probability: Of following.
        looks: What they may look like.

    Attributes:
        places: Where they are.
    """

    def __init__(self, generator: np.random.Generator, probability: float, looks: Looks) -> None:
        self._cutouts, self._probability, self._around = looks.cutouts(generator, CORRELATED), probability, looks.around
        self.places: Places = [(x, y) for x, y in generator.uniform(0, self._around, (CORRELATED, 2)).tolist()]

        def drawn(_: object) -> list[list[float]]:
            numbers: list[list[float]] = generator.random((CORRELATED, 2)).tolist()
            return numbers

        self._numbers = Track(drawn(None), drawn)

    def step(self, moment: int, heading: Sequence[float], headings: Sequence[Sequence[float]] | None) -> None:
        """Move.

        Args:
            moment: Of the step's end.
            heading: Where the agent's action points in the picture (x, y), of length 1; (0, 0): nowhere, so all of
                them go at random.
            headings: The directions that one is drawn from at random; None for all there are.
        """
        places = Places()
        for (x, y), (following, other) in zip(self.places, self._numbers.at(moment), strict=True):
            if following < self._probability and any(heading):
                along_x, along_y = heading
            elif headings is None:
                along_x, along_y = math.cos(2 * math.pi * other), math.sin(2 * math.pi * other)
            else:
                along_x, along_y = headings[int(other * len(headings))]
            places.append(((x + STEP * along_x) % self._around, (y + STEP * along_y) % self._around))
        self.places = places

    def lay(self, frame: UInt8[np.ndarray, "h w 3"], shift: tuple[int, int]) -> None:
        """Paint them, moved by the camera's shift."""
        _lay(frame, self._cutouts, self.places, shift)


def _lay(frame: UInt8[np.ndarray, "h w 3"], cutouts: Sequence[Cutout], places: Places, shift: tuple[int, int]) -> None:
    for cutout, (x, y) in zip(cutouts, places, strict=True):
        cutout.lay(frame, x - MARGIN + shift[0], y - MARGIN + shift[1])
