"""Pictures of a few predictions: the same held-out single steps for every model of a data set.

Which steps is decided by the samples' rows, which are the data set's: two at which something is pushed and one at
which nothing is, spread evenly. Nobody picks the ones that look well.
"""

from __future__ import annotations

import base64
import io
import struct
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import torch
from jaxtyping import UInt8
from PIL import Image

from dmotion_bench.actions import ActionTaken, as_actions
from dmotion_bench.errors import EntryInvalid
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.data.label_request import DEMONSTRATIONS, LabelRequest
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.agents import known_actions
from dmotion_bench.scoring.prediction import predicting
from dmotion_bench.scoring.samples import column, vectors
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shortened

PUSHES: Final = 2
OTHERS: Final = 1
LARGEST_SIDE: Final = 512  # [px]
LONGEST_ACTION: Final = 200
"""Characters of what a picture says of its action."""
_SIGNATURE: Final = b"\x89PNG\r\n\x1a\n"


@dataclass(frozen=True, kw_only=True)
class Step:
    """A single step: the action taken at frame ``step`` leads to the frame that is predicted."""

    episode: int
    step: int
    action: ActionTaken
    pushed: bool


def choose_steps(samples: pa.Table) -> list[Step]:
    """The steps that are shown, pushes first; none where no single step was scored, or actions are not known."""
    rows = samples.filter(pc.and_(pc.equal(samples["predictor"], "model"), pc.equal(samples["metric"], "prediction")))
    episode, step = column(rows, "episode"), column(rows, "step")
    commands = vectors(rows, "command")
    taken = column(rows, "action") if commands is None else commands
    if not np.isfinite(taken).all():
        return []
    actions = as_actions(taken.astype(np.int64) if commands is None else taken)
    pushed = column(rows, "pushed").astype(bool)
    order = np.lexsort((step, episode))
    chosen: list[Step] = []
    for wanted, count in ((True, PUSHES), (False, OTHERS)):
        places = order[pushed[order] == wanted]
        if not len(places):
            continue
        spread = np.unique(((np.arange(count) + 0.5) / count * len(places)).astype(np.int64))
        chosen += [
            Step(episode=int(episode[row]), step=int(step[row]), action=actions[row], pushed=wanted)
            for row in places[spread].tolist()
        ]
    return chosen


def shows_pictures(labels: str) -> bool:
    """Whether runs of a label budget have pictures; each model has them for one budget only.

    Not again with several demonstrations, where only the table of actions differs from that of one, nor with a part of
    the labels; with the default number of transitions where actions are continuous.
    """
    budget = LabelRequest.parse(labels)
    if budget.kind == "count":
        return budget.amount == DEMONSTRATIONS
    return budget.amount <= 1 if budget.kind == "shots" else budget.kind == "none" or budget.amount == 1


def take_pictures(run: Run, dataset: Dataset, samples: pa.Table) -> list[dict[str, Any]]:
    """The model's predictions of the chosen steps, as an entry holds them.

    None of a model that draws no frames, nor of a budget whose pictures are not shown.
    """
    steps = choose_steps(samples) if shows_pictures(run.spec.labels) and run.model.needs_pixels else []
    if not steps:
        return []
    frames = np.stack([dataset.video(one.episode)[one.step - 1 : one.step + 2] for one in steps])
    images = to_model(torch.from_numpy(frames))
    spec = known_actions(dataset.spec)
    action = as_tensor(np.array([one.action for one in steps]))
    model = run.model.to("cpu").laid_out().eval()
    with using_threads(run.threads), predicting(torch.device("cpu")):
        predicted = to_pixels(model.predict(images[:, 0], images[:, 1], action)).numpy()
    return [
        {
            "episode": one.episode,
            "step": one.step,
            "action": _name(spec.describe(one.action)),
            "pushed": one.pushed,
            "current": to_png(frames[place, 1]),
            "truth": to_png(frames[place, 2]),
            "predicted": to_png(predicted[place]),
        }
        for place, one in enumerate(steps)
    ]


def _name(action: str) -> str:
    return action if len(action) <= LONGEST_ACTION else shortened(action, LONGEST_ACTION - 40)


def to_png(frame: UInt8[np.ndarray, "h w 3"]) -> str:
    """A frame as PNG in base64, nothing lost."""
    return _encoded(frame, "PNG", optimize=True)


def _encoded(frame: UInt8[np.ndarray, "h w 3"], form: str, **options: object) -> str:
    file = io.BytesIO()
    Image.fromarray(frame).save(file, form, **options)
    return base64.b64encode(file.getvalue()).decode()


def from_png(text: str) -> UInt8[np.ndarray, "h w 3"]:
    """Decode an untrusted PNG in base64 into a frame.

    Raises:
        EntryInvalid: It is none, or larger than a frame can be.
    """
    try:
        raw = base64.b64decode(text, validate=True)
        _check_head(raw)
        with Image.open(io.BytesIO(raw), formats=["PNG"]) as image:
            frame: UInt8[np.ndarray, "h w 3"] = np.asarray(image.convert("RGB"))
    except (ValueError, OSError, SyntaxError, EOFError, struct.error, zlib.error) as error:
        raise EntryInvalid(f"a picture of the entry cannot be read: {error}.") from None
    return frame


def _check_head(raw: bytes) -> None:
    """Check before decoding that a file begins like a PNG of a frame's size."""
    if raw[:8] != _SIGNATURE or raw[12:16] != b"IHDR":
        raise ValueError("it is no PNG")
    width, height = struct.unpack(">II", raw[16:24])
    if not (1 <= width <= LARGEST_SIDE and 1 <= height <= LARGEST_SIDE):
        raise ValueError(f"it is {width} x {height} pixels; a side has at most {LARGEST_SIDE}")


def shown(text: str) -> str:
    """A picture of an entry as the source of an ``<img>``, encoded again so that it holds nothing but pixels.

    Lossless WebP, a fifth smaller than PNG. Method 6 takes 16 times as long as 4 and makes no smaller files [measured].
    """
    return f"data:image/webp;base64,{_encoded(from_png(text), 'WEBP', lossless=True, quality=100, method=4)}"


def identity(picture: Mapping[str, Any]) -> tuple[int, int]:
    """Which step it shows: episode and step."""
    return int(picture["episode"]), int(picture["step"])
