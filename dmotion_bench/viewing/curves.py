"""The curves of a training, from ``metrics.jsonl``: a page of its own in the scene of a run."""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import UInt8

from dmotion_bench.learning.training.metrics_log import read_rows
from dmotion_bench.learning.training.samples import MOST_PIXELS, no_sample, read_sample
from dmotion_bench.viewing.chart import HEIGHT, WIDTH, Curve, log_chart
from dmotion_bench.viewing.labels import ACTION_COLORS
from dmotion_bench.viewing.scene import Tab, picture_view
from dmotion_bench.viewing.tracks import Color, log_curve, log_words

STEP = "step"
"""The timeline that trainings run on."""

VALIDATION = "validation_"
NO_LOSSES = ("seconds", "triplets_per_s", "learning_rate")
ROOT = "/training"
SAMPLES = 5
"""Pictures of predictions that stand side by side; more of them from the beginning, when most changes."""

CAPTION, SPACE = 40, 12
"""Room below and between the pictures [px]."""


def read_curves(metrics: Path) -> dict[str, Curve]:
    """The figures of a training by name; an incomplete last row is left out."""
    points: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for step, row in read_rows(metrics):
        for name, value in row.items():
            if math.isfinite(value):
                points[name].append((step, value))
    return {
        name: Curve(np.array([step for step, _ in rows]), np.array([value for _, value in rows]))
        for name, rows in points.items()
    }


def training_tab(
    curves: Mapping[str, Curve], text: str, samples: Mapping[int, Path] | None = None, most: int = MOST_PIXELS
) -> Tab:
    """The page of a training.

    Args:
        curves: As ``read_curves`` gives them.
        text: What is to be said beside them, in Markdown.
        samples: As ``samples_of`` gives them.
        most: Pixels that each may have.

    Raises:
        RunCorrupt: One is damaged, larger, or not as large as the others.
    """
    chart: rrb.Container | rrb.View = picture_view(f"{ROOT}/chart", "Losses (logarithmic)", round(WIDTH), round(HEIGHT))
    shown = _spread(samples or {})
    sheets = list[UInt8[np.ndarray, "h w 3"]]()
    for path in shown.values():
        sheets.append(read_sample(path, most))
        if sheets[-1].shape != sheets[0].shape:
            raise no_sample(path, "it is not as large as the others")
    if sheets:
        height, width = sheets[0].shape[0] + CAPTION, len(sheets) * (sheets[0].shape[1] + SPACE)
        strip = picture_view(f"{ROOT}/samples", "Predictions through the training", width, height)
        chart = rrb.Vertical(chart, strip, row_shares=[1.6, 1])
    layout = rrb.Horizontal(
        chart,
        rrb.Tabs(
            rrb.TextDocumentView(origin=f"{ROOT}/about", name="What you see"),
            rrb.TimeSeriesView(origin=f"{ROOT}/losses", name="Losses"),
            rrb.TimeSeriesView(origin=f"{ROOT}/learning_rate", name="Learning rate"),
            rrb.TimeSeriesView(origin=f"{ROOT}/triplets_per_s", name="Triplets/s"),
            active_tab=0,
        ),
        column_shares=[2, 1],
        name="Training",
    )

    def log(recording: rr.RecordingStream) -> None:
        losses = {name: curve for name, curve in curves.items() if name not in NO_LOSSES}
        colors = _colors(losses)
        for name, curve in curves.items():
            path = f"{ROOT}/{name}" if name in NO_LOSSES else f"{ROOT}/losses/{name}"
            color, width = colors.get(name, ACTION_COLORS[0]), _width(name)
            log_curve(
                recording, path, curve.value, name=_words(name), color=color, at=curve.step, timeline=STEP, width=width
            )
        log_chart(
            recording,
            f"{ROOT}/chart",
            {_words(name): curve for name, curve in losses.items()},
            {_words(name): color for name, color in colors.items()},
            {_words(name): _width(name) / 2 for name in losses},
            "training step",
        )
        recording.log(f"{ROOT}/about", rr.TextDocument(text, media_type="text/markdown"), static=True)
        if sheets:
            recording.log(f"{ROOT}/samples", rr.Image(_strip(sheets)), static=True)
            middles = [(place + 0.5) * (sheets[0].shape[1] + SPACE) for place in range(len(sheets))]
            words = [f"step {step}" for step in shown]
            places = [(middle, sheets[0].shape[0] - 8.0) for middle in middles]
            log_words(recording, f"{ROOT}/samples/steps", places, words)

    return Tab(name="Training", layout=layout, log=log)


def _spread(samples: Mapping[int, Path]) -> dict[int, Path]:
    """A few of the images, evenly spread from the first to the last."""
    steps = list(samples)
    if not steps:
        return {}
    chosen = np.unique(np.geomspace(1, len(steps), min(len(steps), SAMPLES)).round().astype(int) - 1)
    return {steps[place]: samples[steps[place]] for place in chosen}


def _strip(sheets: list[UInt8[np.ndarray, "h w 3"]]) -> UInt8[np.ndarray, "y x 3"]:
    """The pictures side by side, with room for a line of words below."""
    padded = [np.pad(sheet, ((0, CAPTION), (0, SPACE), (0, 0)), constant_values=30) for sheet in sheets]
    strip: UInt8[np.ndarray, "y x 3"] = np.concatenate(padded, axis=1)
    return strip


def _colors(losses: Mapping[str, Curve]) -> dict[str, Color]:
    """The same colour for a loss in training (dimmed) and validation."""
    terms = list(dict.fromkeys(name.removeprefix(VALIDATION) for name in losses))
    colors: dict[str, Color] = {}
    for name in losses:
        red, green, blue = ACTION_COLORS[terms.index(name.removeprefix(VALIDATION)) % len(ACTION_COLORS)]
        seen = name.startswith(VALIDATION)
        colors[name] = (red, green, blue) if seen else (red * 6 // 10, green * 6 // 10, blue * 6 // 10)
    return colors


def _width(name: str) -> float:
    return 3.0 if name.startswith(VALIDATION) else 1.5


def _words(name: str) -> str:
    """``validation_loss`` as ``loss, validation``."""
    if name.startswith(VALIDATION):
        return f"{_words(name.removeprefix(VALIDATION))}, validation"
    return name.replace("_", " ")
