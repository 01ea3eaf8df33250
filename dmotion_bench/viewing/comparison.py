"""The scene of several runs of one data set: all models side by side on the same episodes."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import LabelsNotAvailable, UsageError
from dmotion_bench.figure_words import figure_words
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.differences import behind, standing_words
from dmotion_bench.scoring.report import REPORT_FOLDER, Report, read_report, read_report_samples
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.viewing.chart import HEIGHT, WIDTH, log_chart
from dmotion_bench.viewing.dataset import labels_if_any, part_of
from dmotion_bench.viewing.imagination import GIVEN, Imagination, Prediction, can_imagine, imagine
from dmotion_bench.viewing.labels import ACTION_COLORS, log_events, log_legend, what_happens
from dmotion_bench.viewing.report import curves_of, episode_means, figure_text
from dmotion_bench.viewing.run import AMPLIFIED, COPIED, log_prediction
from dmotion_bench.viewing.scene import Scene, Tab, picture_view
from dmotion_bench.viewing.tracks import Color, log_curve, log_images, log_mark, log_rings
from dmotion_bench.wording import from_to, rounded

MOST = 10
"""Models that fit beside each other."""

WIDE = 3
"""Models whose four pictures stand in a square; of more they stand one below the other."""

COLORS: tuple[Color, ...] = (*ACTION_COLORS, (0, 114, 178), (200, 200, 200), (150, 110, 60), (170, 220, 120))
WORST: Color = (255, 70, 70)
ROOT = "/comparison"
COLUMNS = (
    "mse",
    "mse_push",
    "position_error",
    "miss_rate",
    "rollout_mse[15]",
    "planning_gain",
    "control_distance[100]",
)
ROWS = (
    ("one_step", "frame", "{}: one step"),
    ("one_step", "difference", f"error x{AMPLIFIED}: {{}}"),
    ("imagined", "frame", "imagined: {}"),
    ("imagined", "difference", f"error x{AMPLIFIED}: {{}}, imagined"),
)


def comparison_scene(
    runs: Sequence[Run], dataset: ReadableDataset, episodes: Sequence[int], why: Mapping[int, str] | None = None
) -> Scene:
    """One tab an episode with all models side by side, and one with their figures.

    Args:
        runs: Finished ones of this data set whose models draw frames.
        dataset: Theirs. Without labels every model must be one that separates the agent's motion.
        episodes: Numbers of episodes.
        why: What is said of an episode on its tab, such as ``"worst"``.

    Raises:
        UsageError: They cannot be shown beside each other.
        RunMissing: A training is not done.
        LabelsNotAvailable: The data set's labels are not there, and a model predicts by actions alone.
    """
    names = told_apart(runs)
    notes = why or {}
    reports = {
        name: (run.path, report)
        for name, run in names.items()
        if (report := read_report(run.path / REPORT_FOLDER)) is not None
    }
    tabs = [_tab(names, dataset, episode, notes.get(episode, "")) for episode in episodes]
    return Scene(
        name=f"{len(runs)} models on {dataset.name}",
        tabs=(*tabs, *((_figures(reports, names),) if reports else ())),
        step_ns=dataset.spec.step_ns,
        background=lambda recording: log_legend(recording, dataset.spec),
    )


def comparable(runs: Sequence[Run]) -> list[Run]:
    """The runs that can be compared: trained on the same data set as the first run, and predicting frames.

    Raises:
        UsageError: They are of several data sets, too many, or none draws frames.
    """
    other = next((run for run in runs if run.spec.fingerprint != runs[0].spec.fingerprint), None)
    if other is not None:
        raise UsageError(
            f"{runs[0].name!r} and {other.name!r} were trained on different data sets ({runs[0].spec.dataset} and "
            f"{other.spec.dataset}), so they have no episode in common; name runs of one data set."
        )
    drawing = [run for run in runs if run.model.needs_pixels]
    if not drawing:
        raise UsageError(f"{runs[0].name!r} predicts no frames, so there is nothing to compare.")
    if len(drawing) > MOST:
        raise UsageError(f"{len(drawing)} runs are too many to see beside each other; name at most {MOST}.")
    return drawing


def contrasting_episodes(runs: Sequence[Path]) -> dict[int, str]:
    """The worst and the best episode by the mean over the models, and the one where they differ most.

    Empty where a run has no report, or no episode is scored for all.
    """
    of_each = [episode_means(run) for run in runs]
    common = sorted(set.intersection(*(set(means) for means in of_each)))
    if not common:
        return {}
    mse = np.array([[means[episode] for episode in common] for means in of_each])
    apart = np.log(np.maximum(mse, 1e-3)).std(0)
    told: dict[int, str] = {}
    for word, place in (
        ("worst", mse.mean(0).argmax()),
        ("best", mse.mean(0).argmin()),
        ("differ most", apart.argmax()),
    ):
        words = (f"{word}, " if len(common) > 1 else "") + f"mean MSE {rounded(mse.mean(0)[place])}"
        told.setdefault(common[int(place)], words)
    return told


def told_apart(runs: Sequence[Run]) -> dict[str, Run]:
    """Short names of the runs: the model, and the labels, architecture and seed where these differ.

    Raises:
        UsageError: One is named twice.
    """
    if len({run.path.resolve() for run in runs}) < len(runs):
        raise UsageError("a run is named twice; name different runs.")
    parts = [(run.spec.model, run.spec.labels, run.spec.arch, f"seed {run.spec.seed}") for run in runs]
    telling = [place == 0 or len(set(column)) > 1 for place, column in enumerate(zip(*parts, strict=True))]
    names = [" ".join(part for part, tells in zip(own, telling, strict=True) if tells) for own in parts]
    if len(set(names)) < len(runs):
        names = [_beside_data_and_seed(run, telling[-1]) for run in runs]
    if len(set(names)) < len(runs):
        names = [str(run.path) for run in runs]
    return dict(zip(names, runs, strict=True))


def _beside_data_and_seed(run: Run, with_seed: bool) -> str:
    """A run's name without the parts that all runs share, such as ``dmotion epochs 3``."""
    name = run.name if with_seed else re.sub(r"-s\d+$", "", run.name)
    before, found, after = name.partition(run.spec.dataset)
    parts = (before, after) if found else (name,)
    return " ".join(part.strip("-").replace("_", " ") for part in parts if part.strip("-"))


def _tab(names: Mapping[str, Run], dataset: ReadableDataset, episode: int, note: str) -> Tab:
    root, title = f"/episode_{episode}", f"Episode {episode}" + (f" ({note})" if note else "")
    labels = labels_if_any(dataset, episode)
    frames = dataset.video(episode)
    odd = next((name for name, run in names.items() if not can_imagine(run.model, labels)), None)
    if odd is not None:
        raise LabelsNotAvailable(
            f"the actions of {dataset.name!r} are not known, and {odd!r} predicts by actions alone; leave it out, or "
            "look at it for itself: 'dmbench view RUN'."
        )
    seen = {name: imagine(run.model, frames, labels, dataset.spec) for name, run in names.items()}
    first = next(iter(seen.values()))

    def log(recording: rr.RecordingStream) -> None:
        log_images(recording, f"{root}/camera", frames)
        if first.places is not None:
            log_rings(recording, f"{root}/camera/places", first.places)
        for number, (name, one) in enumerate(seen.items()):
            for kind in ("one_step", "imagined"):
                log_prediction(recording, f"{root}/model_{number}/{kind}", one, getattr(one, kind))
                _log_errors(recording, root, kind, f"model_{number}", name, COLORS[number], getattr(one, kind))
        _log_errors(recording, root, "one_step", "copied", "frame before", COPIED, first.copied)
        for kind in ("one_step", "imagined"):
            _mark_worst(recording, f"{root}/mse_{kind}/worst", {name: getattr(one, kind) for name, one in seen.items()})
        if labels is not None:
            log_events(recording, root, dataset.spec, labels)
        text = _about(dataset, episode, note, seen)
        recording.log(f"{root}/about", rr.TextDocument(text, media_type="text/markdown"), static=True)

    return Tab(name=title, layout=_layout(title, root, dataset, seen), log=log)


def _layout(title: str, root: str, dataset: ReadableDataset, seen: Mapping[str, Imagination]) -> rrb.Container:
    width, height = dataset.spec.width, dataset.spec.height
    first = next(iter(seen.values()))
    columns = []
    for number, name in enumerate(seen):
        views = [
            picture_view(f"{root}/model_{number}/{kind}/{part}", words.format(name), width, height)
            for kind, part, words in ROWS
        ]
        columns.append(rrb.Grid(*views, grid_columns=2) if len(seen) <= WIDE else rrb.Vertical(*views))
    lanes = ("moved",) if dataset.spec.objects else ()
    events = [] if first.by_motion else [what_happens(root, dataset.spec, lanes, len(first.frames))]
    truth = rrb.Vertical(
        picture_view(f"{root}/camera", "What really happens", width, height),
        rrb.TextDocumentView(origin=f"{root}/about", name="What you see"),
        *events,
        row_shares=[1.2, 1.6, 1.2 if isinstance(dataset.spec.actions, Continuous) else 0.8][: 2 + len(events)],
    )
    plots = [
        rrb.TimeSeriesView(origin=f"{root}/mse_one_step", name="MSE, one step ahead", plot_legend=rrb.Corner2D.LeftTop),
        rrb.TimeSeriesView(
            origin=f"{root}/mse_imagined", name="MSE, imagined", plot_legend=rrb.PlotLegend(visible=False)
        ),
    ]
    if first.places is not None:
        plots.append(
            rrb.TimeSeriesView(
                origin=f"{root}/position_imagined",
                name="Position error, imagined [px]",
                plot_legend=rrb.PlotLegend(visible=False),
            )
        )
    share = max(2.0, min(len(seen), 5) / 1.2) / len(seen)
    return rrb.Vertical(
        rrb.Horizontal(truth, *columns, column_shares=[1.0, *[share] * len(columns)]),
        rrb.Horizontal(*plots),
        row_shares=[2.6, 1],
        name=title,
    )


def _log_errors(
    recording: rr.RecordingStream, root: str, kind: str, key: str, name: str, color: Color, prediction: Prediction
) -> None:
    at = range(GIVEN, GIVEN + len(prediction.mse))
    log_curve(recording, f"{root}/mse_{kind}/{key}", prediction.mse, name=name, color=color, at=at)
    if kind == "imagined" and prediction.position_error is not None:
        error = prediction.position_error
        log_curve(recording, f"{root}/position_{kind}/{key}", error, name=name, color=color, at=at)


def _mark_worst(recording: rr.RecordingStream, path: str, predictions: Mapping[str, Prediction]) -> None:
    name = max(predictions, key=lambda name: float(predictions[name].mse.max()))
    mse = predictions[name].mse
    frame = int(mse.argmax())
    log_mark(recording, path, GIVEN + frame, float(mse[frame]), name=f"worst: {name}", color=WORST)


def _about(dataset: ReadableDataset, episode: int, note: str, seen: Mapping[str, Imagination]) -> str:
    part = part_of(dataset, episode)
    means = {name: (float(one.one_step.mse.mean()), float(one.imagined.mse.mean())) for name, one in seen.items()}
    best = [min(means, key=lambda name: means[name][place]) for place in (0, 1)]
    lines = [
        f"**{dataset.name}, episode {episode}**, {part} split" + (f": **{note}**." if note else "."),
        "",
        "| mean MSE | one step | imagined |",
        "|---|---|---|",
    ]
    for name, values in means.items():
        cells = [
            f"**{rounded(value)}**" if name == best[place] else rounded(value) for place, value in enumerate(values)
        ]
        lines.append(f"| {name} | {' | '.join(cells)} |")
    by_motion = any(one.by_motion for one in seen.values())
    told = (
        "each is told the motion that it reads off the true frames"
        if by_motion
        else "the actions are the recorded ones"
    )
    lines += [
        "",
        "**One step**: from the two true frames before. **Imagined**: from the model's own frames after the first two; "
        f"{told}. **Rings**: where things are; **dots**: where the prediction has them. "
        "The red mark in a plot is the worst frame of all.",
    ]
    return "\n".join(lines)


def _figures(reports: Mapping[str, tuple[Path, Report]], names: Mapping[str, Run]) -> Tab:
    curves, colors = {}, {}
    for number, name in enumerate(names):
        if name in reports:
            found = curves_of(reports[name][1], "rollout_mse")
            for key, shown, color in (
                (reports[name][1].model, name, COLORS[number]),
                ("copy last", "copy last", COPIED),
            ):
                if key in found:
                    curves[shown], colors[shown] = found[key], color
    layout = rrb.Vertical(
        rrb.TextDocumentView(origin=f"{ROOT}/figures", name="Figures"),
        picture_view(f"{ROOT}/rollout", "MSE of an imagined frame (logarithmic)", round(WIDTH), round(HEIGHT)),
        row_shares=[1, 1.3],
        name="Figures",
    )

    def log(recording: rr.RecordingStream) -> None:
        text = rr.TextDocument(_table(reports), media_type="text/markdown")
        recording.log(f"{ROOT}/figures", text, static=True)
        log_chart(recording, f"{ROOT}/rollout", curves, colors, dict.fromkeys(curves, 1.5), "steps imagined")

    return Tab(name="Figures", layout=layout, log=log)


def _table(reports: Mapping[str, tuple[Path, Report]]) -> str:
    """A table of all models' figures, with the difference of each MSE from the best on the same triplets."""
    shown = [name for name in COLUMNS if any(name in report.figures for _, report in reports.values())]
    order = sorted(reports, key=lambda name: _mse(reports[name][1]))
    samples = {name: read_report_samples(reports[name][0] / REPORT_FOLDER, reports[name][1]) for name in order}
    best = samples[order[0]]
    lines = [
        f"| | {' | '.join(map(figure_words, shown))} | MSE above the best |",
        "|---|" + "---|" * (len(shown) + 1),
    ]
    for name in order:
        own, report = samples[name], reports[name][1]
        apart = "" if name != order[0] else "best"
        if report.frames != reports[order[0]][1].frames:
            apart = "other frames"
        elif name != order[0] and own is not None and best is not None and (found := behind(own, best)) is not None:
            apart = standing_words(found, f"**+{rounded(found.mean)}**", from_to(found.low, found.high))
        lines.append(f"| {name} | {' | '.join(figure_text(report.figures.get(key)) for key in shown)} | {apart} |")
    lines += ["", "Mean over the test episodes; differences are paired, with their 95% interval over episodes."]
    return "\n".join(lines)


def _mse(report: Report) -> float:
    figure = report.figures.get("mse")
    return float("inf") if figure is None or figure["mean"] is None else float(figure["mean"])
