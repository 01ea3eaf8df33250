"""A run's report in the run's scene: its figures, and the most informative episodes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.figure_intervals import interval_words, mean_and_spread
from dmotion_bench.figure_words import figure_words
from dmotion_bench.scoring.report import (
    REPORT_FOLDER,
    FigureJson,
    Report,
    read_report,
    read_report_samples,
    why_no_interval,
)
from dmotion_bench.viewing.chart import HEIGHT, WIDTH, Curve, log_chart
from dmotion_bench.viewing.labels import plain
from dmotion_bench.viewing.scene import Tab, picture_view
from dmotion_bench.viewing.tracks import Color
from dmotion_bench.wording import rounded

ROOT = "/report"
COLORS: tuple[Color, ...] = ((230, 159, 0), (140, 140, 140), (86, 180, 233), (0, 158, 115), (204, 121, 167))
PREDICTED = (
    "mse",
    "mse_true_motion",
    "psnr",
    "ssim",
    "position_error_paper",
    "position_error",
    "miss_rate",
    "false_positive_rate",
    "agent_iou",
    "motion_shift_error",
    "motion_within_over_between",
)
PLANNED = ("planning_gain", "control_distance", "control_picture_distance", "control_success", "control_lost")
"""The figures of the report's two tables; of a distance, that after the last step."""
BESIDE_PREDICTED, BESIDE_PLANNED = ("paper", "copy_last"), ("oracle", "scripted", "random", "idle")
"""The references that stand beside them."""
AHEAD = re.compile(r"(\w+)\[(\d{1,4})\]")


def telling_episodes(run: Path, folder: Path | None = None) -> dict[int, str]:
    """The worst, the middle and the best episode by single-step MSE, each with a short description.

    Of two scored episodes they are the worst and the best; a single one has no word that compares it. They are those of
    the run's own report, or of the one in a folder.

    Empty where the run has no report, or its samples are gone.

    Raises:
        RunCorrupt: The report cannot be read.
    """
    means = episode_means(run, folder)
    order = sorted(means, key=lambda episode: -means[episode])
    told: dict[int, str] = {}
    for word, rank in (("worst", 0), ("best", -1), ("middle", len(order) // 2)) if order else ():
        told.setdefault(order[rank], (f"{word}, " if len(order) > 1 else "") + f"MSE {rounded(means[order[rank]])}")
    return {episode: told[episode] for episode in order if episode in told}


def episode_means(run: Path, folder: Path | None = None) -> dict[int, float]:
    """The MSE of single steps of each scored episode; empty where the run has no report, or its samples are gone.

    Where actions are not known it is the MSE with the true motion, all that is scored there.

    Raises:
        RunCorrupt: The report cannot be read.
    """
    folder = folder or run / REPORT_FOLDER
    report = read_report(folder)
    samples = None if report is None else read_report_samples(folder, report)
    if samples is None:
        return {}
    metric, predictor = (np.asarray(samples[name].to_pylist()) for name in ("metric", "predictor"))
    chosen = (metric == "prediction") & (predictor == "model")
    episode, mse = samples["episode"].to_numpy()[chosen], samples["mse"].to_numpy()[chosen]
    if not np.isfinite(mse).any():
        mse = samples["mse_true_motion"].to_numpy()[chosen]
    known = np.isfinite(mse)
    episode, mse = episode[known], mse[known]
    episodes, place = np.unique(episode, return_inverse=True)
    means = np.bincount(place, mse) / np.maximum(np.bincount(place), 1)
    return dict(zip(episodes.tolist(), means.tolist(), strict=True))


def report_tab(run: Path, folder: Path | None = None) -> Tab | None:
    """The page of a run's own report, or of the one in a folder; None where there is none.

    Raises:
        RunCorrupt: The report cannot be read.
    """
    report = read_report(folder or run / REPORT_FOLDER)
    if report is None:
        return None
    charts = {chart: curves for chart in _CHARTS if (curves := curves_of(report, chart.figure))}
    parts: list[rrb.View | rrb.Container] = [rrb.TextDocumentView(origin=f"{ROOT}/figures", name="Figures")]
    if charts:
        views = (picture_view(one.path, one.title, round(WIDTH), round(HEIGHT)) for one in charts)
        parts.append(rrb.Vertical(*views))
    layout = rrb.Horizontal(*parts, column_shares=[1, 1.4][: len(parts)], name="Report")

    def log(recording: rr.RecordingStream) -> None:
        text = rr.TextDocument(_figures(report), media_type="text/markdown")
        recording.log(f"{ROOT}/figures", text, static=True)
        for one, curves in charts.items():
            colors = {name: COLORS[number % len(COLORS)] for number, name in enumerate(curves)}
            widths = dict.fromkeys(curves, 1.5)
            log_chart(recording, one.path, curves, colors, widths, one.along, logarithmic=one.logarithmic)

    return Tab(name="Report", layout=layout, log=log)


@dataclass(frozen=True)
class _Chart:
    """A figure over steps.

    Attributes:
        figure: Its name, without the step.
        title, along: What the chart and its steps are called.
        logarithmic: Whether the figure's axis is.
    """

    figure: str
    title: str
    along: str
    logarithmic: bool = False

    @property
    def path(self) -> str:
        return f"{ROOT}/{self.figure}"


_CHARTS = (
    _Chart("rollout_mse", "MSE of an imagined frame (logarithmic)", "steps imagined", logarithmic=True),
    _Chart("control_distance", "Control: distance to the goal / at the start", "control step"),
    _Chart("control_picture_distance", "Control: difference from the goal image / at the start", "control step"),
)


def curves_of(report: Report, base: str) -> dict[str, Curve]:
    """A figure over its steps, of the run and of what knows nothing of learning; of control, also at the start."""
    of_all: dict[str, Mapping[str, FigureJson]] = {report.model: report.figures}
    of_all |= {plain(name): figures for name, figures in report.reference.items()}
    curves: dict[str, Curve] = {}
    for name, figures in of_all.items():
        known = {step: float(mean) for step, key in _steps(figures, base) if (mean := figures[key]["mean"]) is not None}
        if known:
            known = ({0: 1.0} if base.startswith("control_") else {}) | known
            curves[name] = Curve(np.array([*known]), np.array([*known.values()]))
    return curves


def _steps(figures: Mapping[str, FigureJson], base: str) -> list[tuple[int, str]]:
    """The steps of a figure with their names in a report, the first step first."""
    found = ((AHEAD.fullmatch(key), key) for key in figures)
    return sorted((int(match[2]), key) for match, key in found if match is not None and match[1] == base)


def _use(report: Report) -> str:
    return f", {report.labels['use']}" if "use" in report.labels else ""


def _figures(report: Report) -> str:
    own = "" if report.trained_on is None else f", trained on *{report.trained_on}*"
    lines = [
        f"**{report.run}**",
        "",
        f"*{report.dataset['name']}*{own}, {report.settings['split']} episodes, labels used: "
        f"**{report.labels['asked']} ({report.labels['total']}{_use(report)})**, protocol {report.protocol}.",
    ]
    if (column := report.settings.get("control_column")) is not None:
        lines += ["", f"Control by the frozen planner **{column}**."]
    for names, others in ((PREDICTED, BESIDE_PREDICTED), (PLANNED, BESIDE_PLANNED)):
        lines += _table(report, names, others)
    if PREDICTED[0] in report.figures or PREDICTED[1] in report.figures:
        lines += ["", "On the other tabs: the worst, the middle and the best episode by the MSE of single steps."]
    return "\n".join(lines)


def _table(report: Report, names: Sequence[str], others: Sequence[str]) -> list[str]:
    """A table of some figures with their intervals, beside the references that have any of them; none without."""
    shown = [key for name in names for key in _keys(report.figures, name)]
    if not shown:
        return []
    beside = [one for one in others if any(key in report.reference.get(one, {}) for key in shown)]
    rows = [["", "mean ± std", "95% interval", *map(plain, beside)], ["---"] * (3 + len(beside))]
    for key in shown:
        figure = report.figures[key]
        compared = [figure_text(report.reference[one].get(key)) for one in beside]
        rows.append([figure_words(key), mean_and_spread(key, figure), interval_words(key, figure), *compared])
    lines = ["", *(f"| {' | '.join(row)} |" for row in rows)]
    why = why_no_interval(report.figures[key] for key in shown)
    return lines if why is None else [*lines, "", f"95% interval: {why}."]


def _keys(figures: Mapping[str, FigureJson], name: str) -> list[str]:
    """A figure's name in a report, with its last step if it has steps; none if it is not there."""
    if name in figures:
        return [name]
    return [key for _, key in _steps(figures, name)[-1:]]


def figure_text(figure: FigureJson | None) -> str:
    """A figure's mean as text; empty if there is no such figure."""
    return "" if figure is None else rounded(figure["mean"])
