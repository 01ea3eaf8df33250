"""The scene of a run: its model's predictions of held-out episodes, and the curves of its training."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Float, UInt8

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.training.samples import largest_sample, samples_of
from dmotion_bench.scoring.transfer import report_folder
from dmotion_bench.specs import EpisodeLabels
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.viewing.curves import read_curves, training_tab
from dmotion_bench.viewing.dataset import labels_if_any, part_of
from dmotion_bench.viewing.imagination import GIVEN, Imagination, Prediction, can_imagine, imagine
from dmotion_bench.viewing.labels import log_events, log_legend, what_happens
from dmotion_bench.viewing.maps import brightest, tile_corners, tiles
from dmotion_bench.viewing.report import report_tab
from dmotion_bench.viewing.scene import Scene, Tab, picture_view
from dmotion_bench.viewing.tracks import (
    Color,
    log_arrows,
    log_curve,
    log_dots,
    log_images,
    log_rings,
    log_words,
)
from dmotion_bench.wording import rounded

AMPLIFIED = 4
"""How much the difference between a prediction and the truth is magnified."""

ONE_STEP: Color = (86, 180, 233)
IMAGINED: Color = (230, 159, 0)
COPIED: Color = (140, 140, 140)
SEEN_MOTION: Color = (255, 220, 0)
TRUE_MOTION: Color = (255, 255, 255)


def run_scene(
    run: Run,
    dataset: ReadableDataset,
    episodes: Sequence[int],
    why: Mapping[int, str] | None = None,
    report: Path | None = None,
) -> Scene:
    """One tab an episode, one for the report if there is one, and one for the training.

    Args:
        run: A finished one.
        dataset: Its own, or another that fits it. Without labels a model that separates the agent's motion follows
            what it sees; of another model there is the video to see, and the training.
        episodes: Numbers of episodes.
        why: What is said of an episode on its tab, such as ``"worst"``.
        report: The folder of the report; None: the one on the data set's test episodes.

    Raises:
        RunMissing: The training is not done.
    """
    notes = why or {}
    tabs = [_tab(run, dataset, episode, notes.get(episode, "")) for episode in episodes]
    figures = report_tab(run.path, report or report_folder(run.path, run.spec.fingerprint, dataset))
    most = largest_sample(run.spec.height, run.spec.width)
    training = training_tab(read_curves(run.metrics), _of_training(run), samples_of(run.path), most)
    return Scene(
        name=run.name,
        tabs=(*tabs, *((figures,) if figures else ()), training),
        step_ns=dataset.spec.step_ns,
        background=lambda recording: log_legend(recording, dataset.spec),
    )


def _tab(run: Run, dataset: ReadableDataset, episode: int, note: str) -> Tab:
    root, name = f"/episode_{episode}", f"Episode {episode}" + (f" ({note})" if note else "")
    labels = labels_if_any(dataset, episode)
    if not run.model.needs_pixels or not can_imagine(run.model, labels):
        return _video_alone(run, dataset, episode, name)
    seen = imagine(run.model, dataset.video(episode), labels, dataset.spec)

    def log(recording: rr.RecordingStream) -> None:
        _log_truth(recording, root, seen, labels)
        log_prediction(recording, f"{root}/one_step", seen, seen.one_step)
        log_prediction(recording, f"{root}/imagined", seen, seen.imagined)
        _log_errors(recording, root, seen)
        _log_maps(recording, root, seen)
        if labels is not None:
            log_events(recording, root, dataset.spec, labels)
        text = _of_episode(run, dataset, episode, seen)
        recording.log(f"{root}/about", rr.TextDocument(text, media_type="text/markdown"), static=True)

    return Tab(name=name, layout=_layout(name, root, dataset, seen), log=log)


def _video_alone(run: Run, dataset: ReadableDataset, episode: int, name: str) -> Tab:
    """The scene of a model that draws no frames, or knows no actions of the episodes to predict by: the video alone."""
    root = f"/episode_{episode}"
    why = (
        "The actions of this recording are not known, and this model predicts by actions alone: here is the video. "
        "How the training went is on the last tab. Import the recording again with its actions (*--actions TOPIC*) "
        "to see predictions."
        if run.model.needs_pixels
        else "This model draws no frames: here is the video. How the training went is on the last tab."
    )
    text = f"**{run.name}**\n\n{_headline(run, dataset, episode)}\n\n{why}"

    def log(recording: rr.RecordingStream) -> None:
        log_images(recording, f"{root}/camera", dataset.video(episode))
        recording.log(f"{root}/about", rr.TextDocument(text, media_type="text/markdown"), static=True)

    camera = picture_view(f"{root}/camera", "What really happens", dataset.spec.width, dataset.spec.height)
    about = rrb.TextDocumentView(origin=f"{root}/about", name="What you see")
    return Tab(name=name, layout=rrb.Horizontal(camera, about, column_shares=[2.2, 1], name=name), log=log)


def _layout(name: str, root: str, dataset: ReadableDataset, seen: Imagination) -> rrb.Container:
    width, height = dataset.spec.width, dataset.spec.height

    def picture(path: str, title: str) -> rrb.Spatial2DView:
        return picture_view(f"{root}/{path}", title, width, height)

    lanes = ("moved",) if dataset.spec.objects else ()
    events = None if seen.by_motion else what_happens(root, dataset.spec, lanes, len(seen.frames))
    beside_imagined: rrb.Container | rrb.View | None = events
    if seen.maps is not None:
        sheet_height, sheet_width = tiles(seen.maps[:1], brightest(seen.maps[:1])).shape[1:]
        beside_imagined = rrb.Vertical(
            picture_view(f"{root}/maps", "Feature maps of this frame", sheet_width, sheet_height),
            picture_view(f"{root}/moved_maps", "The same, each moved by its motion", sheet_width, sheet_height),
        )
    plots: list[rrb.View | rrb.Container] = [_plot(f"{root}/mse", "MSE of each frame [0-255 squared]")]
    if seen.places is not None:
        plots.append(_plot(f"{root}/position_error", "Position error of each frame [px]"))
    if seen.maps is not None and events is not None:
        plots.append(events)
    return rrb.Horizontal(
        rrb.Grid(
            picture("camera", "What really happens"),
            picture("one_step/frame", "Predicted one step ahead"),
            picture("one_step/difference", f"Its error, {AMPLIFIED} times"),
            beside_imagined or rrb.TextDocumentView(origin=f"{root}/about", name="What you see"),
            picture("imagined/frame", "Imagined from frame 2 on"),
            picture("imagined/difference", f"Its error, {AMPLIFIED} times"),
            grid_columns=3,
        ),
        rrb.Vertical(
            rrb.TextDocumentView(origin=f"{root}/about", name="What you see"),
            *plots,
            row_shares=[1.8, *(1.0 for _ in plots[:-1]), 0.8],
        ),
        column_shares=[2.2, 1],
        name=name,
    )


def _plot(origin: str, name: str) -> rrb.TimeSeriesView:
    return rrb.TimeSeriesView(origin=origin, name=name, plot_legend=rrb.Corner2D.LeftTop)


def _log_truth(recording: rr.RecordingStream, root: str, seen: Imagination, labels: EpisodeLabels | None) -> None:
    log_images(recording, f"{root}/camera", seen.frames)
    if seen.places is not None:
        log_rings(recording, f"{root}/camera/places", seen.places)
    if seen.shift is not None and labels is not None:
        for number, (place, shift) in enumerate(zip(labels.agent.pixel.swapaxes(0, 1), seen.shift, strict=False)):
            if not np.isfinite(place).any():
                continue  # nobody knows where the agent is
            own = f"{root}/camera/agent_{number}" if number else f"{root}/camera"
            log_arrows(recording, f"{own}/true_motion", place[:-1], np.diff(place, axis=0), TRUE_MOTION, 1.2, 40)
            log_arrows(recording, f"{own}/motion_seen", place[:-1], shift, SEEN_MOTION, 0.7, 50)


def log_prediction(recording: rr.RecordingStream, path: str, seen: Imagination, prediction: Prediction) -> None:
    """Log predicted frames; the given frames stand before them, with a black difference."""
    given = seen.frames[:GIVEN]
    log_images(recording, f"{path}/frame", np.concatenate([given, prediction.frames]))
    errors = difference(prediction.frames, seen.frames[GIVEN:])
    log_images(recording, f"{path}/difference", np.concatenate([np.zeros_like(given), errors]))
    if seen.places is not None and prediction.places is not None:
        log_rings(recording, f"{path}/frame/true_places", seen.places)
        log_dots(recording, f"{path}/frame/places", prediction.places, first=GIVEN)


def difference(
    predicted: UInt8[np.ndarray, "t h w 3"], truth: UInt8[np.ndarray, "t h w 3"]
) -> UInt8[np.ndarray, "t h w 3"]:
    """The magnified absolute error of each channel; black means correct."""
    apart = np.abs(predicted.astype(np.int16) - truth) * AMPLIFIED
    limited: UInt8[np.ndarray, "t h w 3"] = np.minimum(apart, 255).astype(np.uint8)
    return limited


def _log_errors(recording: rr.RecordingStream, root: str, seen: Imagination) -> None:
    at = range(GIVEN, len(seen.frames))
    kinds = (("one_step", "one step", ONE_STEP), ("imagined", "imagined", IMAGINED), ("copied", "frame before", COPIED))
    for key, name, color in kinds:
        prediction: Prediction = getattr(seen, key)
        log_curve(recording, f"{root}/mse/{key}", prediction.mse, name=name, color=color, at=at)
        if prediction.position_error is not None:
            log_curve(
                recording, f"{root}/position_error/{key}", prediction.position_error, name=name, color=color, at=at
            )


def _log_maps(recording: rr.RecordingStream, root: str, seen: Imagination) -> None:
    if seen.maps is None or seen.moved is None:
        return
    white = brightest(seen.maps, seen.moved)
    for path, maps in ((f"{root}/maps", seen.maps), (f"{root}/moved_maps", seen.moved)):
        log_images(recording, path, tiles(maps, white))
        corners = tile_corners(maps.shape[1], *maps.shape[2:])
        names = ["0, the agent's", *map(str, range(1, len(corners)))]
        middles = [(left + maps.shape[3] / 2, top) for top, left in corners]
        log_words(recording, f"{path}/names", middles, names)


def _headline(run: Run, dataset: ReadableDataset, episode: int) -> str:
    spec = run.spec
    part = part_of(dataset, episode)
    elsewhere = dataset.fingerprint != spec.fingerprint
    trained = f"trained on *{spec.dataset}*, shown on *{dataset.name}*" if elsewhere else f"on *{spec.dataset}*"
    seen_before = "" if part == "test" or elsewhere else ": *not held out*"
    return (
        f"**{spec.model}** ({spec.arch}) {trained}, labels: **{_labels_used(run)}**, seed {spec.seed}. "
        f"Episode {episode}, {part} split{seen_before}."
    )


def _of_episode(run: Run, dataset: ReadableDataset, episode: int, seen: Imagination) -> str:
    told = (
        "The actions of this recording are not known: the model is told the motion that it reads off the true frames"
        if seen.by_motion
        else "The actions are the recorded ones"
    )
    by = "the motion" if seen.by_motion else "the action"
    lines = [
        f"**{run.name}**",
        "",
        _headline(run, dataset, episode),
        "",
        *_means(seen),
        "",
        f"**Predicted one step ahead**: from the two true frames before it and {by}.",
        "",
        f"**Imagined**: from the model's own frames; only the first two are given. {told}.",
    ]
    if seen.places is not None:
        lines += ["", "**Rings**: where things really are. **Dots**: where the prediction has them."]
    if seen.shift is not None and not seen.by_motion:
        lines += ["", "**Arrows**: the agent's true motion (white) and the one that the model sees (yellow)."]
    if seen.maps is not None:
        lines += [
            "",
            "**Feature maps**: the absolute values of each map, on one scale before and after the motion. Map 0 should "
            "show the agent alone, and after the motion where the agent is next.",
        ]
    lines += ["", f"*frame before* repeats the last frame; a model should do better. `{dataset.spec.id}`."]
    return "\n".join(lines)


def _means(seen: Imagination) -> list[str]:
    """A table of the episode's means; of positions where they are known."""
    kinds = (("one step", seen.one_step), ("imagined", seen.imagined), ("frame before", seen.copied))
    if seen.places is None:
        return [
            "| mean of this episode | MSE |",
            "|---|---|",
            *(f"| {name} | {_mean(one.mse)} |" for name, one in kinds),
        ]
    rows = (
        f"| {name} | {_mean(one.mse)} | {_mean(one.position_error)} | {_mean(one.missed, 100)} % |"
        for name, one in kinds
    )
    return ["| mean of this episode | MSE | position error | missed |", "|---|---|---|---|", *rows]


_ABOUT_SAMPLES: Final = (
    "Below it are a few transitions that the run has labels of: the frame before, the true next frame, and what was "
    "predicted at that time.",
    "",
)


def _of_training(run: Run) -> str:
    result = run.result or {}
    lines = ["**Training**", "", "| | |", "|---|---|"]
    facts = {
        "model": f"{run.spec.model} ({run.spec.arch}), {result.get('parameters', 0) / 1e6:.2f} M parameters",
        "data set": run.spec.dataset,
        "labels used": _labels_used(run),
        "steps": result.get("steps"),
        "seconds": result.get("seconds"),
        "triplets/s": result.get("triplets_per_s"),
        "best validation loss": f"{result.get('validation_loss', float('nan')):.4g} at step {result.get('best_step')}",
        "device": result.get("device"),
    }
    lines += [f"| {name} | {value} |" for name, value in facts.items()]
    lines += [
        "",
        "The chart shows every loss, dimmed in training and bright in validation.",
        "",
        *_ABOUT_SAMPLES * bool(samples_of(run.path)),
        "The plots on the tabs above can be read off and zoomed. They run over another timeline and are empty until "
        "you click **frame** at the bottom left and choose **step**; choose *frame* again for the episodes.",
    ]
    return "\n".join(lines)


def _labels_used(run: Run) -> str:
    total = (run.result or {}).get("labels_total")
    return run.spec.labels if total is None else f"{run.spec.labels} ({total} labels)"


def _mean(values: Float[np.ndarray, " s"] | None, factor: float = 1.0) -> str:
    if values is None or not np.isfinite(values).any():
        return "-"
    return rounded(float(np.nanmean(values)) * factor)
