"""Whole episodes as Rerun's columns on the timeline ``frame``: one call an entity, not one a frame.

Places in a picture have pixel (0, 0)'s centre at (0, 0), as everywhere in dmbench; Rerun has it at (0.5, 0.5).
A thing whose place is NaN is not drawn at that frame. ``classes`` are mask values: the annotation context, logged
once, gives each its name and its own colour.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, UInt8

from dmotion_bench.viewing.scene import FRAME

TRAIL = 12
"""Frames that a trail reaches back."""

RING = 4.0
"""Radius of the ring around a thing [px]."""

Color = tuple[int, int, int]
BLACK, WHITE = (0, 0, 0), (255, 255, 255)
WORDS: Color = (120, 160, 215)
"""Of text in a picture: read as well in Rerun's light theme as in its dark one."""


def log_images(
    recording: rr.RecordingStream, path: str, images: UInt8[np.ndarray, "t h w *c"], *, first: int = 0
) -> None:
    """RGB or grey pictures of the frames ``first``, ``first + 1`` ..."""
    frames, height, width = images.shape[:3]
    layout = rr.components.ImageFormat(
        width=width, height=height, color_model="RGB" if images.ndim == 4 else "L", channel_datatype="U8"
    )
    recording.send_columns(
        path,
        indexes=_index(range(first, first + frames)),
        columns=rr.Image.columns(buffer=images.reshape(frames, -1), format=[layout] * frames),
    )


def log_classes(recording: rr.RecordingStream, path: str, classes: UInt8[np.ndarray, "t h w"]) -> None:
    """What each pixel shows."""
    frames, height, width = classes.shape
    layout = rr.components.ImageFormat(width=width, height=height, channel_datatype="U8")
    recording.send_columns(
        path,
        indexes=_index(range(frames)),
        columns=rr.SegmentationImage.columns(buffer=classes.reshape(frames, -1), format=[layout] * frames),
    )


def log_points(
    recording: rr.RecordingStream, path: str, places: Float[np.ndarray, "t k d"], classes: Sequence[int], radius: float
) -> None:
    """A named dot for each thing, in a picture (``d`` = 2 [px]) or in the world (``d`` = 3 [m])."""
    there = np.isfinite(places).all(-1)
    ids = np.broadcast_to(np.asarray(classes, np.uint16), there.shape)[there]
    radii = np.full(len(ids), radius, np.float32)
    if places.shape[-1] == 2:
        columns = rr.Points2D.columns(positions=_in_picture(places[there]), class_ids=ids, radii=radii)
    else:
        columns = rr.Points3D.columns(positions=places[there].astype(np.float32), class_ids=ids, radii=radii)
    recording.send_columns(path, indexes=_index(range(len(places))), columns=columns.partition(there.sum(1)))


def log_trails(
    recording: rr.RecordingStream, path: str, places: Float[np.ndarray, "t k d"], classes: Sequence[int], radius: float
) -> None:
    """Where each thing has been during the last frames; things that never move have no trail."""
    strips: list[Float[np.ndarray, "s d"]] = []
    ids: list[int] = []
    counts: list[int] = []
    for frame in range(len(places)):
        before = len(strips)
        recent = places[max(0, frame - TRAIL) : frame + 1]
        for thing, number in enumerate(classes):
            strip = recent[np.isfinite(recent[:, thing]).all(-1), thing]
            if np.isfinite(recent[-1, thing]).all() and len(strip) > 1 and np.ptp(strip, axis=0).max() > 0:
                strips.append(_in_picture(strip) if strip.shape[-1] == 2 else strip.astype(np.float32))
                ids.append(number)
        counts.append(len(strips) - before)
    kind = rr.LineStrips2D if places.shape[-1] == 2 else rr.LineStrips3D
    columns = kind.columns(strips=strips, class_ids=ids, radii=np.full(len(ids), radius, np.float32))
    recording.log(path, kind.from_fields(show_labels=False), static=True)
    recording.send_columns(path, indexes=_index(range(len(places))), columns=columns.partition(counts))


def log_rings(recording: rr.RecordingStream, path: str, places: Float[np.ndarray, "t k 2"], *, first: int = 0) -> None:
    """A ring around each thing, white upon black, so that it is seen on every colour."""
    there = np.isfinite(places).all(-1)
    counts = there.sum(1)
    black_first = np.concatenate([np.repeat([0.9, 0.4], count) for count in counts])
    centres = np.concatenate([np.tile(_in_picture(row[seen]), (2, 1)) for row, seen in zip(places, there, strict=True)])
    colors = np.where(black_first[:, None] > 0.5, [BLACK], [WHITE]).astype(np.uint8)
    columns = rr.Ellipses2D.columns(
        centers=centres,
        half_sizes=np.full((len(centres), 2), RING, np.float32),
        line_radii=black_first.astype(np.float32),
        colors=colors,
    )
    recording.send_columns(
        path, indexes=_index(range(first, first + len(places))), columns=columns.partition(2 * counts)
    )


def log_dots(recording: rr.RecordingStream, path: str, places: Float[np.ndarray, "t k 2"], *, first: int = 0) -> None:
    """A dot on each thing, white upon black."""
    there = np.isfinite(places).all(-1)
    counts = there.sum(1)
    radii = np.concatenate([np.repeat([1.7, 1.1], count) for count in counts])
    centres = np.concatenate([np.tile(_in_picture(row[seen]), (2, 1)) for row, seen in zip(places, there, strict=True)])
    colors = np.where(radii[:, None] > 1.5, [BLACK], [WHITE]).astype(np.uint8)
    columns = rr.Points2D.columns(positions=centres, radii=radii.astype(np.float32), colors=colors)
    recording.send_columns(
        path, indexes=_index(range(first, first + len(places))), columns=columns.partition(2 * counts)
    )


def log_arrows(
    recording: rr.RecordingStream,
    path: str,
    origins: Float[np.ndarray, "t 2"],
    vectors: Float[np.ndarray, "t 2"],
    color: Color,
    radius: float,
    draw_order: float,
) -> None:
    """An arrow a frame [px], with a black border."""
    recording.log(path, rr.Arrows2D.from_fields(draw_order=draw_order), static=True)
    there = np.isfinite(np.concatenate([origins, vectors], axis=1)).all(1)
    count = int(there.sum())
    columns = rr.Arrows2D.columns(
        origins=np.repeat(_in_picture(origins[there]), 2, axis=0),
        vectors=np.repeat(vectors[there].astype(np.float32), 2, axis=0),
        colors=np.tile(np.array([BLACK, color], np.uint8), (count, 1)),
        radii=np.tile(np.array([radius * 1.5, radius], np.float32), count),
    )
    recording.send_columns(path, indexes=_index(range(len(origins))), columns=columns.partition(2 * there))


def log_words(
    recording: rr.RecordingStream, path: str, places: Sequence[tuple[float, float]], words: Sequence[str]
) -> None:
    """Words in a picture, the same at every frame, each a little below its place [px]."""
    recording.log(path, rr.Points2D(places, labels=words, colors=[WORDS], radii=[0.01], show_labels=True), static=True)


def log_curve(
    recording: rr.RecordingStream,
    path: str,
    values: Float[np.ndarray, " t"],
    *,
    name: str,
    color: Color,
    at: Sequence[int] | Int[np.ndarray, " t"],
    timeline: str = FRAME,
    width: float = 2.0,
) -> None:
    """A line in a plot; where a value is NaN there is no point."""
    there = np.isfinite(values)
    recording.log(path, rr.SeriesLines(names=[name], colors=[color], widths=[width]), static=True)
    recording.send_columns(
        path,
        indexes=_index(np.asarray(at)[there], timeline),
        columns=rr.Scalars.columns(scalars=values[there].astype(np.float64)),
    )


def log_mark(recording: rr.RecordingStream, path: str, frame: int, value: float, *, name: str, color: Color) -> None:
    """A mark at one frame of a plot."""
    recording.log(
        path, rr.SeriesPoints(names=[name], colors=[color], markers=["diamond"], marker_sizes=[7.0]), static=True
    )
    recording.send_columns(path, indexes=_index([frame]), columns=rr.Scalars.columns(scalars=[value]))


def log_states(
    recording: rr.RecordingStream, path: str, states: Sequence[str | None], colors: Mapping[str, Color]
) -> None:
    """A lane of coloured stretches; None is a gap. Only changes are kept."""
    changes = [place for place, state in enumerate(states) if place == 0 or state != states[place - 1]]
    recording.log(
        path, rr.StateConfiguration(values=list(colors), labels=list(colors), colors=list(colors.values())), static=True
    )
    counts = [int(states[place] is not None) for place in changes]
    columns = rr.StateChange.columns(state=[state for place in changes if (state := states[place]) is not None])
    recording.send_columns(path, indexes=_index(changes), columns=columns.partition(counts))


def _index(frames: Sequence[int] | Int[np.ndarray, " t"], timeline: str = FRAME) -> list[rr.TimeColumn]:
    return [rr.TimeColumn(timeline, sequence=np.asarray(frames, np.int64))]


def _in_picture(places: Float[np.ndarray, "n 2"]) -> Float[np.ndarray, "n 2"]:
    return (places + 0.5).astype(np.float32)
