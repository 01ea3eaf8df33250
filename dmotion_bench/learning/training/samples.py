"""Pictures of what a model predicts while it is being trained: ``samples/00001200.png`` in the run's folder.

One picture a validation, a column for each of a few transitions, and three rows: the frame before, the true next
frame, and the prediction. The transitions are ones whose action the run has paid for, so that no label is read for
the pictures: the demonstrations, for which a copy of the model is aligned with them; else labelled triplets of the
validation episodes. A run without any label has no pictures.
"""

from __future__ import annotations

import copy
import warnings
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from einops import rearrange
from jaxtyping import Float, Int, UInt8
from PIL import Image
from torch import Tensor

from dmotion_bench.errors import RunCorrupt
from dmotion_bench.learning.demonstrations import READ_AT_ONCE, Demonstrations
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ForwardModel, TripletBatch
from dmotion_bench.learning.runs.run import SAMPLES
from dmotion_bench.storage.atomic import atomic_file
from dmotion_bench.wording import shown

COLUMNS, ROWS = 4, 3
GAP, GREY = 3, 90
"""Width [px] and level of the lines between frames."""
MOST_PIXELS: Final = 2**24
LONGEST_REASON: Final = 120  # characters of what Pillow says


def sample_of_demonstrations(model: ForwardModel[Any], given: Demonstrations) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of predictions of a few demonstrations, by a copy of the model that is aligned with some of them."""
    aligned = copy.deepcopy(model).eval()
    # from all over them: they may stand in the order of their actions
    aligned.align(given if len(given) <= READ_AT_ONCE else given.subset(_evenly(len(given), READ_AT_ONCE)))
    drawn = given.subset(_evenly(len(given), COLUMNS))
    return _sheet(aligned, drawn.previous, drawn.current, drawn.next, drawn.action)


def sample_of_triplets(model: ForwardModel[Any], batch: TripletBatch) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of the model's predictions of a few labelled triplets."""
    assert batch.action is not None, "only phases with labels have their pictures made of triplets"
    few = _evenly(len(batch.action), COLUMNS)
    return _sheet(model, batch.previous[few], batch.current[few], batch.next[few], batch.action[few])


def write_sample(run: Path, step: int, picture: UInt8[np.ndarray, "h w 3"]) -> Path:
    """Write a picture to a run's folder."""
    path = run / SAMPLES / f"{step:08d}.png"
    path.parent.mkdir(exist_ok=True)
    with atomic_file(path) as file:
        Image.fromarray(picture).save(file, format="png")
    return path


def samples_of(run: Path) -> Mapping[int, Path]:
    """The pictures of a run by their steps, in order."""
    files = (path for path in (run / SAMPLES).glob("*.png") if path.is_file())  # a pipe would be waited for
    found = {int(path.stem): path for path in files if path.stem.isdecimal()}
    return dict(sorted(found.items()))


def largest_sample(height: int, width: int) -> int:
    """Pixels that a picture of ``write_sample`` can have, of a training on frames of this size."""
    return ROWS * (height + GAP) * COLUMNS * (width + GAP)


def read_sample(path: Path, most: int = MOST_PIXELS) -> UInt8[np.ndarray, "h w 3"]:
    """A picture of ``write_sample``.

    Args:
        path: The file.
        most: Pixels that it may have; more are not unpacked.

    Raises:
        RunCorrupt: It is damaged or larger.
    """
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", Image.DecompressionBombWarning)
            opened = Image.open(path, formats=["PNG"])
        with opened:
            if opened.width * opened.height > most:
                raise no_sample(path, f"it has {opened.width}x{opened.height} pixels")
            return np.asarray(opened.convert("RGB"))
    except (OSError, ValueError, SyntaxError, Image.DecompressionBombError) as error:
        raise no_sample(path, str(error)[:LONGEST_REASON]) from error


def no_sample(path: Path, why: str) -> RunCorrupt:
    """The error for a file that is no picture of ``write_sample``."""
    return RunCorrupt(f"{shown(str(path))} is no picture of a training: {why.rstrip('.')}; delete it.")


def _evenly(count: int, most: int) -> Int[Tensor, " n"]:
    """At most so many of so many places, spread evenly."""
    return torch.linspace(0, count - 1, min(count, most)).round().long()


def _sheet(
    model: ForwardModel[Any],
    previous: Float[Tensor, "n c h w"],
    current: Float[Tensor, "n c h w"],
    following: Float[Tensor, "n c h w"],
    action: Int[Tensor, " n"] | Float[Tensor, "n a"],
) -> UInt8[np.ndarray, "y x 3"]:
    predicted = model.predict(previous, current, action)
    rows = torch.stack([to_pixels(images.float()) for images in (current, following, predicted)]).cpu().numpy()
    framed = np.pad(rows, ((0, 0), (0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=GREY)
    sheet: UInt8[np.ndarray, "y x 3"] = rearrange(framed, "r n h w c -> (r h) (n w) c")
    return sheet
