"""Where the coloured objects are in a picture: a lookup from quantised RGB to objects, then each object's centroid.

Scoring reads true and predicted frames with it, planning reads predicted ones; both see what the paper's
"object centres in the predicted frame and the ground truth frame" (section V-C) leaves to a detector by colour.
Things of one and the same colour cannot be told apart, so none of them is found.

A table of 32 x 32 x 32 colours says which object a pixel belongs to. Where light does not change the colours it
is the nearest of the objects' colours, if near enough; where it does, the nearest hue among pixels that are
saturated and bright enough to have one. An object is found when it has at least 1/1024 of the frame's pixels
(16 at 128 x 128, where objects have 150 to 650): a sliver of mixed colours along the border of two touching
objects stays below that. Its centre is the plain mean of its pixels, as the paper's; stray pixels do pull on it.

All pixels of all labels are summed at once: the table holds, instead of a label, a 1 in the label's own field of
a 63-bit word, so that one sum over the rows and one over the columns count every label (18,000 frames of
128 x 128 a second on one core).
"""

from __future__ import annotations

import colorsys
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
from jaxtyping import Bool, Float, Int, UInt8, UInt16
from torch import Tensor

from dmotion_bench.specs import EnvSpec, ObjectSpec

BITS: Final = 5
"""Of each colour channel that the table looks at."""

COLOR_DISTANCE: Final = 100.0
"""Farthest in RGB from an object's colour; less where two objects' colours are closer than twice that."""

HUE_DISTANCE: Final = 25 / 360
"""Farthest from an object's hue, of a full turn; less where two objects' hues are closer than twice that."""

LEAST_SATURATION: Final = 0.45
LEAST_VALUE: Final = 0.15
"""Below these a shaded pixel has no hue to speak of: the table, the arm, the background, deep shade."""

LEAST_AREA: Final = 1 / 1024
"""Of the frame's pixels that an object must have to be found."""

NOTHING: Final = 255
"""The label of pixels that belong to none of the things."""


@dataclass(frozen=True, kw_only=True)
class Positions:
    """The positions of the objects in some frames.

    Attributes:
        centre: (x, y) [px], pixel (0, 0)'s centre at (0, 0); NaN for an object that was not found.
        found: Whether enough of its colour is in the picture.
        pixels: How many pixels have its colour.
    """

    centre: Float[Tensor, "*b k 2"]
    found: Bool[Tensor, "*b k"]
    pixels: Int[Tensor, "*b k"]


class PositionFinder:
    """Finds the objects of an environment in batches of frames.

    Attributes:
        things: What is looked for: the objects in the order of ``EnvSpec.objects``, then the agents where they
            can be told by their colours.
    """

    def __init__(self, spec: EnvSpec) -> None:
        self.things: tuple[ObjectSpec, ...] = spec.objects + (spec.agents if spec.agent_has_color else ())
        labels = _by_hue(self.things) if spec.shaded else _by_color(self.things)
        self._labels = torch.from_numpy(labels.astype(np.uint8))
        self._field_bits = max(spec.height, spec.width).bit_length()
        self._fields = 63 // self._field_bits
        self._words = [
            torch.from_numpy(_one_hot_words(labels, first, self._fields, self._field_bits))
            for first in range(0, len(self.things), self._fields)
        ]
        self.least_pixels = max(1, round(spec.height * spec.width * LEAST_AREA))

    def find(self, frames: UInt8[Tensor, "*b h w 3"]) -> Positions:
        """The objects' places in each frame, on the frames' device."""
        return self._positions(*self._counts(frames.reshape(-1, *frames.shape[-3:])), frames.shape[:-3])

    def find_extents(self, frames: UInt8[Tensor, "b h w 3"]) -> tuple[Positions, Float[Tensor, "b k 2 2"]]:
        """The objects' places, and the first and the last column and row of each (the last axis) [px].

        Only rows and columns with two pixels count, so that a stray one does not. In a picture so small that one pixel
        is a thing, a thing that has two in no row or in no column extends over those with one. NaN for what was not
        found.
        """
        return self._with_extents(*self._counts(frames))

    def _with_extents(
        self, rows: Int[Tensor, "b k h"], columns: Int[Tensor, "b k w"]
    ) -> tuple[Positions, Float[Tensor, "b k 2 2"]]:
        found = self._positions(rows, columns, rows.shape[:1])
        extents = []
        for counts in (columns, rows):
            enough = counts >= 2
            if self.least_pixels == 1:
                enough |= (counts >= 1) & ~enough.any(-1, keepdim=True)
            there = enough.to(torch.uint8)
            first, last = there.argmax(-1), counts.shape[-1] - 1 - there.flip(-1).argmax(-1)
            extents.append(torch.stack([first, last], dim=-1).float())
        return found, torch.stack(extents, dim=-2).masked_fill(~found.found[..., None, None], torch.nan)

    def find_within(
        self, frames: UInt8[Tensor, "b h w 3"], low: Float[Tensor, "b k 2"], high: Float[Tensor, "b k 2"]
    ) -> tuple[Positions, Float[Tensor, "b k 2 2"]]:
        """As ``find_extents``, but of each object only what lies in a box of its own, for the first k things.

        Args:
            frames: To be looked at.
            low, high: The box's first and last (x, y) [px]; where they are NaN nothing is found.
        """
        things = torch.arange(low.shape[1], device=frames.device)
        side = torch.tensor([frames.shape[2], frames.shape[1]], device=frames.device)
        first = torch.minimum(low.nan_to_num(float(sum(frames.shape[1:3]))).ceil().long().clamp(min=0), side)
        last = torch.maximum(torch.minimum(high.nan_to_num(-1.0).floor().long() + 1, side), first)
        # windows of one size, each with its box in it, are cut out: sums over whole frames take five times as long
        size = (last - first).flatten(0, 1).amax(dim=0).clamp(min=1) if low.numel() else torch.ones_like(side)
        start = torch.minimum(first, side - size)
        across, down = (torch.arange(int(length), device=frames.device) for length in size)
        windows = self.labels(frames).unfold(1, len(down), 1).unfold(2, len(across), 1)
        row = torch.arange(len(frames), device=frames.device)[:, None].expand(start.shape[:2])
        mine = windows[row, start[..., 1], start[..., 0]] == things[:, None, None]
        columns, rows = start[..., 0, None] + across, start[..., 1, None] + down
        mine &= ((columns >= first[..., 0, None]) & (columns < last[..., 0, None]))[:, :, None]
        mine &= ((rows >= first[..., 1, None]) & (rows < last[..., 1, None]))[..., None]
        in_rows, in_columns = (first.new_zeros((*first.shape[:2], int(length))) for length in side.flip(0))
        in_rows.scatter_(2, rows, mine.sum(3))
        in_columns.scatter_(2, columns, mine.sum(2))
        return self._with_extents(in_rows, in_columns)

    def _positions(
        self, rows: Int[Tensor, "n k h"], columns: Int[Tensor, "n k w"], leading: tuple[int, ...]
    ) -> Positions:
        pixels = rows.sum(-1)
        along = [
            counts.double() @ torch.arange(counts.shape[-1], dtype=torch.float64, device=counts.device)
            for counts in (columns, rows)
        ]
        found = pixels >= self.least_pixels
        centre = torch.stack(along, dim=-1) / pixels.clamp(min=1).unsqueeze(-1)
        centre = centre.masked_fill(~found.unsqueeze(-1), torch.nan).float()
        return Positions(
            centre=centre.reshape(*leading, -1, 2),
            found=found.reshape(*leading, -1),
            pixels=pixels.reshape(*leading, -1),
        )

    def labels(self, frames: UInt8[Tensor, "n h w 3"]) -> UInt8[Tensor, "n h w"]:
        """Which of ``things`` each pixel belongs to, ``NOTHING`` for none."""
        return _looked_up(frames, self._labels)

    def _counts(self, frames: UInt8[Tensor, "n h w 3"]) -> tuple[Int[Tensor, "n k h"], Int[Tensor, "n k w"]]:
        """The number of pixels of each label in each row and in each column."""
        sums = [
            _sums_on_cpu(frames, word) if frames.device.type == "cpu" else _sums_on_device(frames, word)
            for word in self._words
        ]
        rows, columns = (self._unpack([pair[place] for pair in sums]) for place in (0, 1))
        return rows, columns

    def _unpack(self, words: list[Int[Tensor, "n s"]]) -> Int[Tensor, "n k s"]:
        fields = [
            (word >> (field * self._field_bits)) & (2**self._field_bits - 1)
            for word in words
            for field in range(self._fields)
        ]
        kept = fields[: len(self.things)]
        if not kept:
            raise ValueError("an environment without coloured things has no positions to find")
        return torch.stack(kept, dim=1)


def _sums_on_cpu(
    frames: UInt8[Tensor, "n h w 3"], word: Int[Tensor, " c"]
) -> tuple[Int[Tensor, "n h"], Int[Tensor, "n w"]]:
    """Numpy gathers four times as fast as torch on a CPU [measured], a few frames at a time stay in the cache."""
    pixels, table = frames.numpy(), word.numpy()
    rows = np.empty(pixels.shape[:2], np.int64)
    columns = np.empty((pixels.shape[0], pixels.shape[2]), np.int64)
    for start in range(0, len(pixels), 4):
        packed = table.take(_table_index(pixels[start : start + 4]))
        packed.sum(2, out=rows[start : start + 4])
        packed.sum(1, out=columns[start : start + 4])
    return torch.from_numpy(rows), torch.from_numpy(columns)


def _looked_up(frames: UInt8[Tensor, "n h w 3"], table: Tensor) -> Tensor:
    """Look each pixel's colour up in a table."""
    if frames.device.type != "cpu":
        red, green, blue = (frames >> (8 - BITS)).int().unbind(-1)
        return table.to(frames.device)[(red << (2 * BITS)) | (green << BITS) | blue]
    return torch.from_numpy(table.numpy().take(_table_index(frames.numpy())))


def _table_index(pixels: UInt8[np.ndarray, "n h w 3"]) -> UInt16[np.ndarray, "n h w"]:
    """Which of the table's colours each pixel has."""
    keep = 256 - 2 ** (8 - BITS)
    index: UInt16[np.ndarray, "n h w"] = (pixels[..., 0] & keep).astype(np.uint16) << (3 * BITS - 8)
    index |= (pixels[..., 1] & keep).astype(np.uint16) << (2 * BITS - 8)
    index |= pixels[..., 2] >> (8 - BITS)
    return index


def _sums_on_device(
    frames: UInt8[Tensor, "n h w 3"], word: Int[Tensor, " c"]
) -> tuple[Int[Tensor, "n h"], Int[Tensor, "n w"]]:
    packed = _looked_up(frames, word)
    return packed.sum(2), packed.sum(1)


def _one_hot_words(labels: Int[np.ndarray, " c"], first: int, fields: int, bits: int) -> Int[np.ndarray, " c"]:
    """For each colour a word with a 1 in the field of its label, if that is one of ``first ... first+fields-1``."""
    here = (labels >= first) & (labels < first + fields)
    shift = np.where(here, labels - first, 0).astype(np.int64) * bits
    words: Int[np.ndarray, " c"] = here.astype(np.int64) << shift
    return words


def _table_colors() -> Float[np.ndarray, "c 3"]:
    """The colour in the middle of each of the table's cells, 0-255."""
    levels = (np.arange(2**BITS) + 0.5) * 2 ** (8 - BITS)
    return np.stack(np.meshgrid(levels, levels, levels, indexing="ij"), axis=-1).reshape(-1, 3)


def _nearest(
    distance: Float[np.ndarray, "c k"], between: Float[np.ndarray, "k k"], farthest: float
) -> Int[np.ndarray, " c"]:
    """The nearest thing of each colour, -1 where none is near enough, and where that thing looks like another one."""
    if distance.shape[1] == 0:
        return np.full(len(distance), -1)
    alike = np.isclose(between, 0, atol=1e-9)
    apart = between[~alike]
    limit = min(farthest, float(apart.min()) / 2) if apart.size else farthest
    label: Int[np.ndarray, " c"] = distance.argmin(1)
    label[(distance.min(1) > limit) | (alike.sum(1) > 1)[label]] = -1
    return label


def _by_color(things: tuple[ObjectSpec, ...]) -> Int[np.ndarray, " c"]:
    wanted = np.asarray([thing.color for thing in things], np.float64).reshape(-1, 3)
    distance = np.linalg.norm(_table_colors()[:, None] - wanted, axis=-1)
    return _nearest(distance, np.linalg.norm(wanted[:, None] - wanted, axis=-1), COLOR_DISTANCE)


def _by_hue(things: tuple[ObjectSpec, ...]) -> Int[np.ndarray, " c"]:
    colors = _table_colors() / 255
    wanted = np.asarray([colorsys.rgb_to_hsv(*(c / 255 for c in thing.color))[0] for thing in things], np.float64)
    hue, saturation, value = np.asarray([colorsys.rgb_to_hsv(*color) for color in colors.tolist()]).T

    def turn(difference: Float[np.ndarray, "c k"]) -> Float[np.ndarray, "c k"]:
        away = np.abs(difference) % 1
        nearer: Float[np.ndarray, "c k"] = np.minimum(away, 1 - away)
        return nearer

    label = _nearest(turn(hue[:, None] - wanted), turn(wanted[:, None] - wanted), HUE_DISTANCE)
    label[(saturation < LEAST_SATURATION) | (value < LEAST_VALUE)] = -1
    return label
