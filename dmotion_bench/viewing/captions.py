"""Frames in rows and columns, enlarged, with words above each: one picture of them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from dmotion_bench.viewing.tracks import Color

SIDE: Final = 256
"""A frame is enlarged by a whole number to about this width [px]."""
GAP: Final = 6
TEXT: Final = 26
LINE: Final = 38
BACKGROUND: Final[Color] = (22, 22, 26)
WORDS: Final[Color] = (235, 235, 235)
FAINT: Final[Color] = (165, 165, 172)

Frame = UInt8[np.ndarray, "h w 3"]


def captioned(titles: Sequence[str], rows: Sequence[tuple[str, Sequence[Frame | None]]], below: str) -> Image.Image:
    """From top to bottom: a title for each column, words and frames for each row, and words below them.

    Args:
        titles: Of the columns.
        rows: The words and the frames of each; None leaves a place empty. The first row has a frame in each column.
        below: The last words.
    """
    (height, width), *_ = [frame.shape[:2] for frame in rows[0][1] if frame is not None]
    scale = max(1, round(SIDE / width))
    wide, high = width * scale, height * scale
    across = [GAP + place * (wide + GAP) for place in range(len(titles))]
    down = [LINE + place * (LINE + high) for place in range(len(rows) + 1)]
    picture = Image.new("RGB", (across[-1] + wide + GAP, down[-1] + LINE), BACKGROUND)
    draw, font = ImageDraw.Draw(picture), ImageFont.load_default(TEXT)

    def write(words: str, left: int, top: int, color: Color) -> None:
        draw.text((left, top + LINE // 2), words, font=font, fill=color, anchor="lm")

    for title, left in zip(titles, across, strict=True):
        write(title, left, 0, FAINT)
    for (words, frames), top in zip(rows, down, strict=False):
        write(words, GAP, top, WORDS)
        for frame, left in zip(frames, across, strict=True):
            if frame is not None:
                enlarged = Image.fromarray(frame).resize((wide, high), Image.Resampling.NEAREST)
                picture.paste(enlarged, (left, top + LINE))
    write(below, GAP, down[-1], WORDS)
    return picture
