"""Frames in rows and columns, enlarged, with words above each: one picture of them, and a file for pictures."""

from __future__ import annotations

import contextlib
import functools
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

Frame = UInt8[np.ndarray, "h w 3"]


def captioned(
    titles: Sequence[str],
    rows: Sequence[tuple[str, Sequence[Frame | None]]],
    below: str,
    *,
    heading: str = "",
    notes: Sequence[str] = (),
) -> Image.Image:
    """From top to bottom: a title for each column, words and frames for each row, and words below them.

    Words that are too wide for their place take several lines.

    Args:
        titles: Of the columns.
        rows: The words and the frames of each, all of one size; None leaves a place empty.
        below: The last words.
        heading: Above everything; takes no room if empty.
        notes: A line below each column; takes no room if there are none.
    """
    height, width = next(frame.shape[:2] for _, frames in rows for frame in frames if frame is not None)
    scale = max(1, round(SIDE / width))
    wide, high = width * scale, height * scale
    across = [GAP + place * (wide + GAP) for place in range(len(titles))]
    right = across[-1] + wide + GAP
    written: list[tuple[int, int, list[str]]] = []  # left, top, lines
    pasted: list[tuple[int, int, Frame]] = []

    def write(columns: Sequence[tuple[int, str]], top: int, room: int) -> int:
        """Where the next thing begins, below texts that begin at the same height."""
        texts = [(left, _lines(words, room)) for left, words in columns]
        written.extend((left, top, lines) for left, lines in texts)
        return top + LINE * max(len(lines) for _, lines in texts)

    everything = right - 2 * GAP
    top = write([(GAP, heading)], 0, everything) if heading else 0
    top = write(list(zip(across, titles, strict=True)), top, wide)
    for words, frames in rows:
        top = write([(GAP, words)], top, everything)
        pasted += [(left, top, frame) for frame, left in zip(frames, across, strict=True) if frame is not None]
        top += high
    if notes:
        top = write(list(zip(across, notes, strict=True)), top, wide)
    bottom = write([(GAP, below)], top, everything)

    picture = Image.new("RGB", (right, bottom), BACKGROUND)
    draw = ImageDraw.Draw(picture)
    for left, top, lines in written:
        for number, line in enumerate(lines):
            draw.text((left, top + number * LINE + LINE // 2), line, font=_font(), fill=WORDS, anchor="lm")
    for left, top, frame in pasted:
        picture.paste(Image.fromarray(frame).resize((wide, high), Image.Resampling.NEAREST), (left, top))
    return picture


def _lines(words: str, room: int) -> list[str]:
    """The words in lines that fit into so many pixels; a word that is wider has a line of its own."""
    lines = [""]
    for word in words.split():
        longer = f"{lines[-1]} {word}".strip()
        if lines[-1] and _font().getlength(longer) > room:
            lines.append(word)
        else:
            lines[-1] = longer
    return lines


@functools.cache
def _font() -> Any:
    return ImageFont.load_default(TEXT)


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
        raise ViewerError(f"{str(path)!r} cannot be written: {error.strerror or error}; name another file.") from None
