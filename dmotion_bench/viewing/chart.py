"""A chart drawn with lines in a picture view.

Rerun's plots follow the timeline that is being played; this one is seen whatever that is, and Rerun 0.41 has no
logarithmic axis.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import rerun as rr
from jaxtyping import Float, Int, Real

from dmotion_bench.viewing.tracks import WORDS, Color
from dmotion_bench.wording import rounded

WIDTH, HEIGHT = 1000.0, 600.0
MARGIN_LEFT, MARGIN_RIGHT, MARGIN_TOP, MARGIN_BOTTOM = 90.0, 230.0, 30.0, 60.0
LINE_HEIGHT = 26.0
AXIS: Color = WORDS
GRID: Color = (110, 110, 115)


@dataclass(frozen=True)
class Curve:
    """One figure over steps."""

    step: Int[np.ndarray, " n"]
    value: Float[np.ndarray, " n"]


def log_chart(
    recording: rr.RecordingStream,
    path: str,
    curves: Mapping[str, Curve],
    colors: Mapping[str, Color],
    widths: Mapping[str, float],
    across_name: str,
    *,
    logarithmic: bool = True,
) -> None:
    """Draw curves by their names.

    Args:
        recording, path: Where to.
        curves: What; on a logarithmic axis values that are not above zero have no place and are left out.
        colors, widths: Of each curve.
        across_name: What the steps are.
        logarithmic: Whether the values' axis is; else it begins at zero, or at the lowest value below.
    """
    shown = _known(curves, logarithmic=logarithmic)
    if not shown:
        return
    last = max(int(curve.step.max()) for curve in shown.values())
    low, high = _range(shown, logarithmic=logarithmic)

    def across(step: Real[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        return MARGIN_LEFT + (WIDTH - MARGIN_LEFT - MARGIN_RIGHT) * step / max(last, 1)

    def down(value: Float[np.ndarray, " n"]) -> Float[np.ndarray, " n"]:
        share: Float[np.ndarray, " n"] = ((np.log10(value) if logarithmic else value) - low) / (high - low)
        return HEIGHT - MARGIN_BOTTOM - (HEIGHT - MARGIN_TOP - MARGIN_BOTTOM) * share

    steps, values = _round_steps(last), _round_values(low, high) if logarithmic else _even_values(low, high)
    right, bottom = WIDTH - MARGIN_RIGHT, HEIGHT - MARGIN_BOTTOM
    grid = [[(x, MARGIN_TOP), (x, bottom)] for x in across(steps)]
    grid += [[(MARGIN_LEFT, y), (right, y)] for y in down(values)]
    recording.log(f"{path}/grid", rr.LineStrips2D(grid, colors=[GRID], radii=[0.5]), static=True)
    marks = [(x, bottom + 6) for x in across(steps)] + [(MARGIN_LEFT - 42, y - 12) for y in down(values)]
    words = [f"{int(step)}" for step in steps] + [f"{value:g}" for value in values]
    _write(recording, f"{path}/axes", [*marks, ((MARGIN_LEFT + right) / 2, bottom + 30)], [*words, across_name], AXIS)
    ends = {name: float(down(curve.value[-1:])[0]) for name, curve in shown.items()}
    for name, height in _apart(ends).items():
        curve = shown[name]
        line = np.stack([across(curve.step), down(curve.value)], axis=1)
        entity = f"{path}/{rr.escape_entity_path_part(name)}"
        recording.log(
            entity, rr.LineStrips2D([line], colors=[colors[name]], radii=[widths[name]], draw_order=10.0), static=True
        )
        text = f"{name}: {rounded(curve.value[-1])}"
        _write(recording, f"{entity}/name", [(right + MARGIN_RIGHT / 2, height - 12)], [text], colors[name])


def _known(curves: Mapping[str, Curve], *, logarithmic: bool) -> dict[str, Curve]:
    """The curves' values that have a place on the axis; no curve without any."""
    known = {}
    for name, curve in curves.items():
        here = curve.value > 0 if logarithmic else np.isfinite(curve.value)
        if here.any():
            known[name] = Curve(curve.step[here], curve.value[here])
    return known


def _range(curves: Mapping[str, Curve], *, logarithmic: bool) -> tuple[float, float]:
    """The lowest and the highest place on the axis, as powers of ten on a logarithmic one; never the same."""
    low = min(float(curve.value.min()) for curve in curves.values())
    high = max(float(curve.value.max()) for curve in curves.values())
    if not logarithmic:
        low = min(low, 0.0)
        return low, high if high > low else low + 1.0
    low, high = math.log10(low), math.log10(high)
    return (low - 0.05, high + 0.05) if high - low < 0.1 else (low, high)


def _write(
    recording: rr.RecordingStream, path: str, places: list[tuple[float, float]], words: list[str], color: Color
) -> None:
    """Write words, each centred a little below its position."""
    recording.log(path, rr.Points2D(places, labels=words, colors=[color], radii=[0.01], show_labels=True), static=True)


def _round_steps(last: int) -> Float[np.ndarray, " n"]:
    """About five round numbers from zero to the last step."""
    return np.arange(0, last + 1, max(1, round(_round_width(max(last, 1) / 5)))).astype(float)


def _even_values(low: float, high: float) -> Float[np.ndarray, " n"]:
    """About four round numbers, evenly apart."""
    width = _round_width((high - low) / 4)
    values: Float[np.ndarray, " n"] = np.arange(math.ceil(low / width), math.floor(high / width) + 1) * width
    return values


def _round_width(rough: float) -> float:
    """The next of 1, 2, 5 and their multiples by powers of ten."""
    unit = 10.0 ** math.floor(math.log10(rough))
    return next(unit * factor for factor in (1, 2, 5, 10) if unit * factor >= rough)


def _round_values(low: float, high: float) -> Float[np.ndarray, " n"]:
    """Powers of ten, and where they are few, their doubles and quintuples."""
    decades = range(math.floor(low), math.ceil(high) + 1)
    factors = (1, 2, 5) if high - low < 3 else (1,)
    values = [factor * 10.0**decade for decade in decades for factor in factors]
    inside = [value for value in values if low <= math.log10(value) <= high]
    return np.array(inside or [10**low, 10**high])


def _apart(heights: Mapping[str, float]) -> dict[str, float]:
    """The heights of lines of text, moved down where two lines would overlap."""
    placed: dict[str, float] = {}
    for name, height in sorted(heights.items(), key=lambda item: item[1]):
        placed[name] = max(height, max(placed.values(), default=-math.inf) + LINE_HEIGHT)
    return placed
