"""How Grid World draws its cells, in both versions.

Version 1 draws on the 128 x 128 pixels themselves: a cell spans whole pixels, and a pixel belongs to a shape if its
centre does. Version 2 draws as the paper's published code does: on 500 x 500 pixels, cell by cell, of which
128 x 128 are kept (nearest neighbour). A shape spans 101 pixels there, so it reaches one pixel into the next cell;
where a kept pixel lies on that border, the cell that is drawn later hides the earlier one's pixels.

The published code leaves the shapes to Pillow. The rules here are those of Pillow 6, the version of its time: later
ones draw circles with other borders. A test holds them against frames that the paper's authors published.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from itertools import pairwise
from types import MappingProxyType
from typing import Final, Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.specs import MASK_AGENT, MASK_FIRST_OBJECT, ObjectSpec
from recorders.grid_rules import CELLS

Version = Literal[1, 2]
SIZE: Final = 128  # [px]
_CANVAS: Final = 500  # [px], what version 2 draws on
_CELL: Final = _CANVAS // CELLS  # [px] of the canvas
_KEPT: Final = (2 * np.arange(SIZE) + 1) * _CANVAS // (2 * SIZE)
"""The pixel of the canvas that the centre of each pixel of a frame falls into: 1, 5, 9 ... 498."""
_EDGES: Final = tuple(round(cell * SIZE / CELLS) for cell in range(CELLS + 1))
_BORDERS: Final = tuple(_CELL * cell for cell in range(CELLS + 1))

SPANS: Final[Mapping[Version, tuple[slice, ...]]] = MappingProxyType(
    {
        1: tuple(slice(first, end) for first, end in pairwise(_EDGES)),
        2: tuple(
            slice(int(np.searchsorted(_KEPT, first)), int(np.searchsorted(_KEPT, last, "right")))
            for first, last in pairwise(_BORDERS)
        ),
    }
)
"""The pixels of a frame that a shape in a cell may cover. In version 2 pixel 102 belongs to cell 3 and to cell 4."""


class Drawn(NamedTuple):
    """What a sequence of moments looks like.

    Attributes:
        frames: RGB, 0-255.
        masks: 0 background, 1 + k thing k.
        centers: Mean (x, y) of the pixels that show a thing [px]; NaN for one that is gone.
        visible: Share of a thing's pixels that nothing hides; 0 for one that is gone.
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    masks: UInt8[np.ndarray, "t h w"]
    centers: Float[np.ndarray, "t n 2"]
    visible: Float[np.ndarray, "t n"]


def draw(
    looks: Sequence[ObjectSpec], cells: Int[np.ndarray, "t n 2"], there: Bool[np.ndarray, "t n"], version: Version
) -> Drawn:
    """Agents and objects at a sequence of moments.

    Args:
        looks: Of the agent, of the objects, then of the other agents.
        cells: (column, row) of each. No two things that are there share a cell.
        there: Which of them there are.
        version: Of the drawing.
    """
    frames = np.zeros((len(cells), SIZE, SIZE, 3), np.uint8)
    masks = np.zeros((len(cells), SIZE, SIZE), np.uint8)
    centers, visible = np.full((*there.shape, 2), np.nan), there.astype(np.float64)
    tiles = [_tiles(look, thing, version) for thing, look in enumerate(looks)]
    order = np.argsort(cells[..., 1] * CELLS + cells[..., 0], axis=-1)  # as the published code visits its cells
    for moment, things in enumerate(order.tolist()):
        places = cells[moment].tolist()
        laid = [(thing, tiles[thing][tuple(places[thing])]) for thing in things if there[moment, thing]]
        for thing, tile in laid:
            np.copyto(frames[moment, tile.rows, tile.columns], tile.picture, where=tile.laid[..., None])
            np.copyto(masks[moment, tile.rows, tile.columns], tile.mask, where=tile.laid)
            centers[moment, thing] = tile.center
        for thing, tile in laid:
            if tile.may_be_hidden:
                shown = masks[moment, tile.rows, tile.columns] == _mask_value(thing)
                centers[moment, thing] = _center(tile.rows, tile.columns, shown)
                visible[moment, thing] = shown.sum() / tile.stamp.sum()
    return Drawn(frames, masks, centers, visible)


@dataclass(frozen=True)
class _Tile:
    """What one thing looks like in one cell.

    Attributes:
        rows, columns: Of the frame.
        stamp: Which of these pixels the thing covers.
        picture, mask: What it puts there.
        laid: Which of these pixels are replaced: all, or the stamp alone where some belong to another cell, too.
        center: Mean (x, y) of the pixels that it covers [px].
        may_be_hidden: Whether a thing in the next cell can cover some of them.
    """

    rows: slice
    columns: slice
    stamp: Bool[np.ndarray, "h w"]
    picture: UInt8[np.ndarray, "h w 3"]
    mask: UInt8[np.ndarray, "h w"]
    laid: Bool[np.ndarray, "*hw"]
    center: tuple[float, float]
    may_be_hidden: bool


@cache
def _tiles(look: ObjectSpec, thing: int, version: Version) -> dict[tuple[int, int], _Tile]:
    """What a thing looks like in each cell; thing 0 is the agent, thing 1 + k object k."""
    spans, tiles = SPANS[version], {}
    shares = [one.stop > after.start for one, after in pairwise(spans)]
    with_next, with_former = [*shares, False], [False, *shares]
    for column in range(CELLS):
        for row in range(CELLS):
            stamp = (_stamp_of_frame if version == 1 else _stamp_of_canvas)(look.shape, column, row)
            alone = not any(side[cell] for side in (with_next, with_former) for cell in (column, row))
            tiles[column, row] = _Tile(
                rows=spans[row],
                columns=spans[column],
                stamp=stamp,
                picture=stamp[..., None] * np.array(look.color, np.uint8),
                mask=stamp.astype(np.uint8) * _mask_value(thing),
                laid=np.ones(1, np.bool_) if alone else stamp,
                center=_center(spans[row], spans[column], stamp),
                may_be_hidden=with_next[column] or with_next[row],
            )
    return tiles


def _mask_value(thing: int) -> int:
    return MASK_AGENT if thing == 0 else MASK_FIRST_OBJECT + thing - 1  # other agents: see EnvSpec.agent_masks


def _center(rows: slice, columns: slice, shown: Bool[np.ndarray, "h w"]) -> tuple[float, float]:
    ys, xs = np.nonzero(shown)
    return columns.start + float(xs.mean()), rows.start + float(ys.mean())


def _stamp_of_frame(shape: str, column: int, row: int) -> Bool[np.ndarray, "h w"]:
    """Version 1: the pixels of a cell whose centre lies in the shape."""
    height, width = _EDGES[row + 1] - _EDGES[row], _EDGES[column + 1] - _EDGES[column]
    y, x = ((np.arange(height) + 0.5) / height)[:, None], ((np.arange(width) + 0.5) / width)[None]
    if shape == "circle":
        inside = (x - 0.5) ** 2 + (y - 0.5) ** 2 <= 0.25
    elif shape == "triangle":
        inside = np.abs(x - 0.5) <= y / 2
    else:
        inside = np.ones((height, width), np.bool_)
    return inside


def _stamp_of_canvas(shape: str, column: int, row: int) -> Bool[np.ndarray, "h w"]:
    """Version 2: the kept ones of the 101 x 101 canvas pixels that the shape is drawn on."""
    x = (_KEPT[SPANS[2][column]] - _BORDERS[column])[None]
    y = (_KEPT[SPANS[2][row]] - _BORDERS[row])[:, None]
    from_middle = np.abs(x - _CELL // 2)
    if shape == "circle":
        inside = from_middle <= _circle_half_widths()[np.abs(y - _CELL // 2)]
    elif shape == "triangle":
        inside = from_middle <= y // 2
    else:
        inside = np.ones((len(y), x.size), np.bool_)
    return inside


def _circle_half_widths() -> Int[np.ndarray, " r"]:
    """How far a circle reaches to each side of its middle, by the distance from its middle row [px of the canvas].

    Pillow 6 draws the polygon whose corners lie on the circle at each whole degree, rounded to pixels. A row goes to
    where the polygon's side crosses it; half a pixel is rounded inwards.
    """
    radius, angle = _CELL // 2, np.deg2rad(np.arange(91))
    across, down = np.floor(radius * np.cos(angle) + 0.5), np.floor(radius * np.sin(angle) + 0.5)
    corner_rows, outermost = np.unique(down, return_index=True)
    reach = np.interp(np.arange(radius + 1), corner_rows, across[outermost])
    half_widths: Int[np.ndarray, " r"] = np.ceil(reach - 0.5).astype(np.int64)
    return half_widths
