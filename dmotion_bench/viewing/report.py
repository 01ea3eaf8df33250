"""A run's report in the run's scene: its figures, and the most informative episodes."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

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
COLORS: tuple[Color, ...] = ((230, 159, 0), (140, 140, 140), (86, 180, 233))
SHOWN = (
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
    "control_success",
)
AHEAD = re.compile(r"rollout_mse\[(\d{1,4})\]")


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
    curves = rollout_curves(report)
    layout = rrb.Horizontal(
        rrb.TextDocumentView(origin=f"{ROOT}/figures", name="Figures"),
        picture_view(f"{ROOT}/rollout", "MSE of an imagined frame (logarithmic)", round(WIDTH), round(HEIGHT)),
        column_shares=[1, 1.4],
        name="Report",
    )

    def log(recording: rr.RecordingStream) -> None:
        text = rr.TextDocument(_figures(report), media_type="text/markdown")
        recording.log(f"{ROOT}/figures", text, static=True)
        colors = {name: COLORS[number % len(COLORS)] for number, name in enumerate(curves)}
        log_chart(recording, f"{ROOT}/rollout", curves, colors, dict.fromkeys(curves, 1.5), "steps imagined")

    return Tab(name="Report", layout=layout, log=log)


def rollout_curves(report: Report) -> dict[str, Curve]:
    """MSE over the steps of a rollout, of the run and of what knows nothing of learning."""
    of_all: dict[str, Mapping[str, FigureJson]] = {report.model: report.figures}
    of_all |= {plain(name): figures for name, figures in report.reference.items()}
    curves: dict[str, Curve] = {}
    for name, figures in of_all.items():
        points = sorted(
            (int(found[1]), figure["mean"]) for key, figure in figures.items() if (found := AHEAD.fullmatch(key))
        )
        known = [(ahead, float(mean)) for ahead, mean in points if mean is not None]
        if known:
            curves[name] = Curve(np.array([ahead for ahead, _ in known]), np.array([mean for _, mean in known]))
    return curves


def _use(report: Report) -> str:
    return f", {report.labels['use']}" if "use" in report.labels else ""


def _figures(report: Report) -> str:
    own = "" if report.trained_on is None else f", trained on *{report.trained_on}*"
    beside = [name for name in ("paper", "copy_last") if name in report.reference]
    lines = [
        f"**{report.run}**",
        "",
        f"*{report.dataset['name']}*{own}, {report.settings['split']} episodes, labels used: "
        f"**{report.labels['asked']} ({report.labels['total']}{_use(report)})**, protocol {report.protocol}.",
        "",
        f"| | mean ± std | 95% interval | {' | '.join(map(plain, beside))} |",
        "|---|---|---|" + "---|" * len(beside),
    ]
    for name in SHOWN:
        if name in report.figures:
            figure = report.figures[name]
            others = " | ".join(figure_text(report.reference[other].get(name)) for other in beside)
            spread = f"{figure_text(figure)} ± {rounded(figure['std'])}"
            lines.append(f"| {figure_words(name)} | {spread} | {interval_text(figure)} | {others} |")
    if (why := why_no_interval(report.figures[name] for name in SHOWN if name in report.figures)) is not None:
        lines += ["", f"95% interval: {why}."]
    lines += ["", "On the other tabs: the worst, the middle and the best episode by the MSE of single steps."]
    return "\n".join(lines)


def figure_text(figure: FigureJson | None) -> str:
    """A figure's mean as text; empty if there is no such figure."""
    return "" if figure is None else rounded(figure["mean"])


def interval_text(figure: FigureJson) -> str:
    """A figure's interval as text."""
    return "" if figure["low"] is None else f"{rounded(figure['low'])} to {rounded(figure['high'])}"
