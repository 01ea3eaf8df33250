"""Recorded episodes and what models imagine of them, one below the other, as an animated GIF or WebP.

A column is an episode. The first row shows the recorded frames; each row below shows what one model imagines: it is
given the first two frames and the actions, and feeds on its own predictions from then on. Where the actions are not
known, it is told the motion that it reads off the true frames, and its row says so.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np
from jaxtyping import UInt8
from PIL import Image

from dmotion_bench.errors import LabelsNotAvailable, UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.viewing.captions import captioned, picture_file
from dmotion_bench.viewing.dataset import labels_if_any, part_of
from dmotion_bench.viewing.imagination import GIVEN, can_imagine, imagine

STEPS: Final = 30
"""Imagined steps, if nothing else is asked for."""
FRAME_MS: Final = 250
LAST_MS: Final = 1500
"""How long the last frame stays before the animation begins again."""
LARGEST: Final[Mapping[str, int]] = {".webp": 2**14 - 1, ".gif": 2**16 - 1}
"""A picture's width and height that a format can say [px]."""


def animate(
    runs: Mapping[str, Run],
    dataset: ReadableDataset,
    episodes: Sequence[int],
    why: Mapping[int, str] | None = None,
    *,
    steps: int = STEPS,
) -> list[Image.Image]:
    """The pictures of an animation, in their order.

    Args:
        runs: Finished runs of models that draw frames, by the name that stands above their row.
        dataset: Theirs, or another that fits them.
        episodes: Numbers of episodes. One that is shorter than the others stays at its last frame, and a
            line below it says when it ended.
        why: What is said of an episode above its column, such as ``"worst"``.
        steps: Imagined steps, at most.

    Raises:
        UsageError: A model draws no frames.
        LabelsNotAvailable: The actions are not known, and a model predicts by actions alone.
        RunMissing: A training is not done.
    """
    if lacking := [name for name, run in runs.items() if not run.model.needs_pixels]:
        raise UsageError(f"{lacking[0]!r} draws no frames, so there is nothing to animate; name another run.")
    columns = [_column(runs, dataset, episode, (why or {}).get(episode, ""), steps) for episode in episodes]
    told = ", told the true motions" if any(column.by_motion for column in columns) else ""
    rows = ["real", *(f"imagined by {name}{told}" for name in runs)]
    return [_picture(columns, rows, time) for time in range(max(len(column.films[0]) for column in columns))]


@dataclass(frozen=True)
class _Column:
    """One episode of the animation.

    Attributes:
        title: Above it.
        films: The frames of each row, all rows equally long.
        by_motion: Whether a model was told the motions of the true frames, as the actions are not known.
    """

    title: str
    films: list[UInt8[np.ndarray, "t h w 3"]]
    by_motion: bool


def _column(runs: Mapping[str, Run], dataset: ReadableDataset, episode: int, note: str, steps: int) -> _Column:
    frames, labels = dataset.video(episode), labels_if_any(dataset, episode)
    films, by_motion = [frames[: GIVEN + steps]], False
    for name, run in runs.items():
        if not can_imagine(run.model, labels):
            raise LabelsNotAvailable(
                f"the actions of episode {episode} are not known, and {name!r} predicts by actions alone."
            )
        seen = imagine(run.model, frames, labels, dataset.spec)
        films.append(np.concatenate([frames[:GIVEN], seen.imagined.frames])[: GIVEN + steps])
        by_motion |= seen.by_motion
    said = [note.partition(",")[0]] * bool(note)
    trained_on = {run.spec.fingerprint for run in runs.values()}
    if dataset.fingerprint in trained_on and (part := part_of(dataset, episode)) != "test":
        said.append(part)
    return _Column(f"episode {episode}" + (f" ({', '.join(said)})" if said else ""), films, by_motion)


def _picture(columns: Sequence[_Column], rows: Sequence[str], time: int) -> Image.Image:
    """From top to bottom: a title for each episode, words and frames for each row, which episode ended, the step."""
    ahead, last = time + 1 - GIVEN, [len(column.films[0]) - 1 for column in columns]
    ended = [f"ended at step {end + 1 - GIVEN}" if end < time else "" for end in last]
    shown = [
        (words, [film[min(time, len(film) - 1)] for film in films])
        for words, films in zip(rows, zip(*(column.films for column in columns), strict=True), strict=True)
    ]
    return captioned(
        [column.title for column in columns],
        shown,
        f"step {ahead}" if ahead > 0 else f"given, {time + 1} of {GIVEN}",
        notes=ended if len(set(last)) > 1 else (),
    )


def write_animation(pictures: Sequence[Image.Image], path: Path) -> None:
    """Write an animation that repeats; the file's suffix chooses the format.

    Raises:
        UsageError: The pictures are larger than the format allows.
        ViewerError: It cannot be written.
        StorageFull: There is no space left for it.
    """
    most = LARGEST.get(path.suffix, math.inf)
    if max(pictures[0].size) > most:
        width, height = pictures[0].size
        raise UsageError(
            f"the pictures have {width:,} x {height:,} pixels, and a {path.suffix} has at most {most:,} on a side; "
            "name fewer episodes or fewer runs."
        )
    durations = [FRAME_MS] * (len(pictures) - 1) + [LAST_MS]
    shown = [one.quantize(256) for one in pictures] if path.suffix == ".gif" else list(pictures)
    how: dict[str, int] = {} if path.suffix == ".gif" else {"quality": 80}
    with picture_file(path) as file:
        shown[0].save(
            file,
            format=path.suffix.removeprefix("."),
            save_all=True,
            append_images=shown[1:],
            duration=durations,
            loop=0,
            **how,
        )
