"""The curves of a training, from ``metrics.jsonl``: a page of its own in the scene of a run."""

from __future__ import annotations

import json
import math
from collections import defaultdict
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.viewing.chart import HEIGHT, WIDTH, Curve, log_chart
from dmotion_bench.viewing.labels import ACTION_COLORS
from dmotion_bench.viewing.scene import Tab, picture_view
from dmotion_bench.viewing.tracks import Color, log_curve

STEP = "step"
"""The timeline that trainings run on."""

VALIDATION = "validation_"
NO_LOSSES = ("seconds", "triplets_per_s", "learning_rate")
ROOT = "/training"


def read_curves(metrics: Path) -> dict[str, Curve]:
    """Every figure of a training by its name; a row cut short by a kill is left out."""
    points: dict[str, list[tuple[int, float]]] = defaultdict(list)
    for line in metrics.read_text().splitlines() if metrics.is_file() else []:
        try:
            row = json.loads(line)
            step = int(row["step"])
        except (json.JSONDecodeError, KeyError, TypeError, ValueError):
            continue
        for name, value in row.items():
            if name != "step" and isinstance(value, int | float) and math.isfinite(value):
                points[name].append((step, float(value)))
    return {
        name: Curve(np.array([step for step, _ in rows]), np.array([value for _, value in rows]))
        for name, rows in points.items()
    }


def training_tab(curves: Mapping[str, Curve], text: str) -> Tab:
    """The page of a training.

    Args:
        curves: As ``read_curves`` gives them.
        text: What is to be said beside them, in Markdown.
    """
    layout = rrb.Horizontal(
        picture_view(f"{ROOT}/chart", "Losses (logarithmic)", round(WIDTH), round(HEIGHT)),
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

    return Tab(name="Training", layout=layout, log=log)


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
