"""The scene of a data set: the video of some episodes and, where they are there, their labels."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.specs import EnvSpec, EpisodeLabels, SplitName
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.viewing.eye import eye_of_camera
from dmotion_bench.viewing.labels import log_labels, log_legend, places_known, what_happens
from dmotion_bench.viewing.scene import Scene, Tab, picture_view
from dmotion_bench.viewing.tracks import log_images

_APART = "kept apart (a training gets as many actions as its label budget allows, and nothing else)"
_KEYS = ("", "*Space* plays and pauses; drag a view to pan it, scroll to zoom, double-click to reset.")


def dataset_scene(dataset: ReadableDataset, episodes: Sequence[int]) -> Scene:
    """One tab an episode.

    Args:
        dataset: Its labels may be missing; then only the video is shown.
        episodes: Numbers of episodes.
    """
    return Scene(
        name=dataset.name,
        tabs=tuple(_tab(dataset, episode) for episode in episodes),
        step_ns=dataset.spec.step_ns,
        background=lambda recording: log_legend(recording, dataset.spec),
    )


def labels_if_any(dataset: ReadableDataset, episode: int) -> EpisodeLabels | None:
    """An episode's labels; None where there are none."""
    try:
        return dataset.labels(episode)
    except LabelsNotAvailable:
        return None


def part_of(dataset: ReadableDataset, episode: int) -> SplitName:
    """The split that an episode is in."""
    return next(part for part in SPLIT_NAMES if episode in dataset.split(part))


def _tab(dataset: ReadableDataset, episode: int) -> Tab:
    root = f"/episode_{episode}"
    frames, labels = dataset.video(episode), labels_if_any(dataset, episode)

    def log(recording: rr.RecordingStream) -> None:
        log_images(recording, f"{root}/camera", frames)
        if labels is not None:
            log_labels(recording, root, dataset.spec, labels)
        text = _explanation(dataset, episode, len(frames), labels)
        recording.log(f"{root}/about", rr.TextDocument(text, media_type="text/markdown"), static=True)

    return Tab(name=f"Episode {episode}", layout=_layout(dataset.spec, episode, labels), log=log)


def _layout(spec: EnvSpec, episode: int, labels: EpisodeLabels | None) -> rrb.Container:
    root = f"/episode_{episode}"
    about = rrb.TextDocumentView(origin=f"{root}/about", name="What you see")
    camera = picture_view(f"{root}/camera", "Camera", spec.width, spec.height)
    name = f"Episode {episode}"
    if labels is None:
        return rrb.Horizontal(camera, about, column_shares=[3, 1], name=name)
    if not places_known(labels):
        seen = rrb.Vertical(camera, what_happens(root, spec, (), len(labels.masks)), row_shares=[4, 1])
        return rrb.Horizontal(seen, about, column_shares=[3, 1], name=name)
    masks = picture_view(f"{root}/masks", "Which pixel shows what", spec.width, spec.height)
    world = rrb.Spatial3DView(origin=f"{root}/world", name="Where things are [m]", eye_controls=_eye(labels))
    happens = what_happens(root, spec, ("pushed/**",), len(labels.masks))
    return rrb.Horizontal(
        rrb.Vertical(rrb.Horizontal(camera, masks), happens, row_shares=[1.6, 1]),
        rrb.Vertical(world, about),
        column_shares=[2.4, 1],
        name=name,
    )


def _eye(labels: EpisodeLabels) -> rrb.EyeControls3D | None:
    states = (labels.objects, labels.agent)
    position = np.concatenate([each.position.reshape(-1, 3) for each in states])
    eye = eye_of_camera(position, np.concatenate([each.pixel.reshape(-1, 2) for each in states]))
    if eye is None:
        return None
    return rrb.EyeControls3D(position=eye.position, look_target=eye.target, eye_up=eye.up)


def _explanation(dataset: ReadableDataset, episode: int, frames: int, labels: EpisodeLabels | None) -> str:
    recipe, spec = dataset.recipe, dataset.spec
    seconds = frames * spec.step_ns / 1e9
    part = part_of(dataset, episode)
    lines = [
        f"**{dataset.name}, episode {episode}**",
        "",
        f"{frames} frames of {spec.width} x {spec.height} pixels, {seconds:.1f} s at {1e9 / spec.step_ns:g} frames/s. "
        f"One of {len(dataset)} episodes of `{recipe.environment}`, policy `{recipe.policy}`, "
        f"seed {recipe.seed}; in the **{part}** split.",
        "",
        "**Camera** is all that a model learns from.",
    ]
    if labels is None:
        return "\n".join([*lines, "", "This data set has no labels.", *_KEYS])
    if not places_known(labels):
        return "\n".join([*lines, f"The actions are *labels*, {_APART}; no others are known.", *_KEYS])
    lines += [
        f"Everything else is *labels*, {_APART}: the rings and trails (where things are and were), the masks, the "
        "places in metres, the actions.",
        "",
        "**What happens**: the action taken *at* a frame leads to the *next* one. A coloured stretch below it "
        "is a step in which that object is pushed; grey: it is gone for good.",
        "",
        f"{int(labels.pushed.sum())} of {len(labels.pushed)} steps push an object.",
    ]
    return "\n".join([*lines, *_KEYS])
