"""Frames in rows and columns, enlarged, with words above each: one picture of them, and a file for pictures."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import IO, Any, Final

import numpy as np
from jaxtyping import UInt8
from PIL import Image, ImageDraw, ImageFont

from dmotion_bench.errors import ViewerError
from dmotion_bench.storage.atomic import atomic_file
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
        rows: The words and the frames of each, all of one size; None leaves a place empty.
        below: The last words.
    """
    height, width = next(frame.shape[:2] for _, frames in rows for frame in frames if frame is not None)
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


@contextlib.contextmanager
def picture_file(path: Path) -> Iterator[IO[Any]]:
    """A file for a picture, complete or absent.

    Raises:
        ViewerError: It cannot be written.
        StorageFull: There is no space left for it.
    """
    try:
        with atomic_file(path) as file:
            yield file
    except OSError as error:
        raise ViewerError(f"{str(path)!r} cannot be written: {error.strerror}; name another file.") from None
