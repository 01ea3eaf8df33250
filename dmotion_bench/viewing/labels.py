"""Rerun views of an episode's labels: tracks in the image and in the world, masks, and lanes of events."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import Bool, Float, UInt8

from dmotion_bench.actions import Continuous, require_discrete
from dmotion_bench.specs import MASK_BACKGROUND, MASK_FIRST_OBJECT, EnvSpec, EpisodeLabels
from dmotion_bench.viewing.scene import FRAME
from dmotion_bench.viewing.tracks import Color, log_classes, log_points, log_rings, log_states, log_trails

ACTION_COLORS: tuple[Color, ...] = (
    (86, 180, 233),
    (230, 159, 0),
    (0, 158, 115),
    (204, 121, 167),
    (240, 228, 66),
    (213, 94, 0),
)
"""Okabe and Ito's palette, told apart by colour-blind people too; taken in turn."""

GONE: Color = (90, 90, 90)
SEVERAL: Color = (150, 150, 150)
BACKGROUND: Color = (30, 30, 34)
LOWEST_NAME, LOWER_END = 0.93, 0.06
"""Shares of the picture's height: how low the name of a thing may stand, and what counts as its lower end."""

LEAST_BRIGHTNESS = 110
"""Of a thing's brightest channel, 0-255, so that it is seen before the background and in Rerun's dark views."""


def plain(name: str) -> str:
    """A name in plain words: ``red_circle`` as ``red circle``."""
    return name.replace("_", " ")


def brightened(color: Color) -> Color:
    """A colour as it is, a dark one lifted toward white as far as ``LEAST_BRIGHTNESS``."""
    red, green, blue = (channel + max(0, LEAST_BRIGHTNESS - max(color)) for channel in color)
    return red, green, blue


def classes_of(spec: EnvSpec) -> list[int]:
    """The mask values of the objects, then of the agents."""
    return [MASK_FIRST_OBJECT + number for number in range(len(spec.objects))] + list(spec.agent_masks)


def log_legend(recording: rr.RecordingStream, spec: EnvSpec) -> None:
    """Name and colour every mask value, for masks, dots and trails alike."""
    things = sorted(zip(classes_of(spec), (*spec.objects, *spec.agents), strict=True), key=lambda one: one[0])
    known = [(MASK_BACKGROUND, "background", BACKGROUND)]
    known += [(number, plain(thing.name), brightened(thing.color)) for number, thing in things]
    recording.log("/", rr.AnnotationContext(known), static=True)


def places_known(labels: EpisodeLabels) -> bool:
    """Whether positions are known; an imported recording may have actions only."""
    states = (labels.objects, labels.agent)
    return bool(labels.masks.any()) or any(bool(np.isfinite(each.position).any()) for each in states)


def log_labels(recording: rr.RecordingStream, root: str, spec: EnvSpec, labels: EpisodeLabels) -> None:
    """All labels of an episode under the entity ``root``."""
    if not places_known(labels):
        log_events(recording, root, spec, labels)
        return
    classes = classes_of(spec)
    pixel = np.concatenate([labels.objects.pixel, labels.agent.pixel], axis=1)
    position = np.concatenate([labels.objects.position, labels.agent.position], axis=1)
    log_rings(recording, f"{root}/camera/places", pixel)
    log_trails(recording, f"{root}/camera/trails", pixel, classes, 0.5)
    log_classes(recording, f"{root}/masks", labels.masks)
    log_points(recording, f"{root}/masks/names", _below(labels.masks, classes), classes, 0.3)
    size = _extent(position)
    log_points(recording, f"{root}/world/things", position, classes, size / 40)
    log_trails(recording, f"{root}/world/trails", position, classes, size / 150)
    log_events(recording, root, spec, labels)


def log_events(recording: rr.RecordingStream, root: str, spec: EnvSpec, labels: EpisodeLabels) -> None:
    """A lane of the actions or curves of their numbers, and a lane for each object: when it is pushed or gone."""
    if isinstance(spec.actions, Continuous):
        log_numbers(recording, f"{root}/action", spec.actions, labels.actions)
    else:
        names = [plain(action) for action in require_discrete(spec.actions, "the lane of actions").names]
        taken: list[str | None] = [names[action] for action in labels.actions.tolist()]
        colors = {name: ACTION_COLORS[number % len(ACTION_COLORS)] for number, name in enumerate(names)}
        log_states(recording, f"{root}/action", [*taken, None], colors)
    moved, gone = pushes(spec, labels)
    for number, it in enumerate(spec.objects):
        lane: list[str | None] = []
        for frame in range(len(gone)):
            pushed = frame < len(moved) and moved[frame, number]
            lane.append("pushed" if pushed else "gone" if gone[frame, number] else None)
        log_states(recording, f"{root}/pushed/{it.name}", lane, {"pushed": it.color, "gone": GONE})
    if not spec.objects:
        return  # nothing is known of what moves
    together = [_named(spec, row) for row in moved]
    shades = {name: SEVERAL for name in together if name} | {plain(it.name): it.color for it in spec.objects}
    log_states(recording, f"{root}/moved", [*together, None], shades)


def log_numbers(
    recording: rr.RecordingStream, path: str, actions: Continuous, values: Float[np.ndarray, "s a"]
) -> None:
    """A curve for each number of a continuous action, in its units, under its own name."""
    when = rr.TimeColumn(FRAME, sequence=np.arange(len(values)))
    for place, (name, unit) in enumerate(zip(actions.names, actions.units, strict=True)):
        curve = f"{path}/{place}"
        legend = f"{plain(name)} [{unit}]" if unit else plain(name)
        color = ACTION_COLORS[place % len(ACTION_COLORS)]
        recording.log(curve, rr.SeriesLines(names=[legend], colors=[color]), static=True)
        recording.send_columns(curve, indexes=[when], columns=rr.Scalars.columns(scalars=values[:, place]))


def action_curves(root: str) -> rrb.TimeSeriesView:
    """The plot of what ``log_numbers`` has logged for an episode."""
    return rrb.TimeSeriesView(origin=f"{root}/action", name="Actions")


def events_view(root: str, lanes: Sequence[str], frames: int) -> rrb.StateTimelineView:
    """The lanes of an episode, from its first frame to its last."""
    whole = rr.TimeRangeBoundary.absolute
    return rrb.StateTimelineView(
        origin=root,
        contents=[f"$origin/{lane}" for lane in lanes],
        name="What happens",
        time_view=rrb.TimeAxis(view_range=rr.TimeRange(start=whole(seq=0), end=whole(seq=frames - 1))),
    )


def what_happens(root: str, spec: EnvSpec, lanes: Sequence[str], frames: int) -> rrb.View | rrb.Container:
    """The actions of an episode and some lanes of ``log_events``: continuous actions as curves, above the lanes."""
    if not isinstance(spec.actions, Continuous):
        return events_view(root, ("action", *lanes), frames)
    if not lanes:
        return action_curves(root)
    return rrb.Vertical(action_curves(root), events_view(root, lanes, frames))


def _named(spec: EnvSpec, moved: Bool[np.ndarray, " k"]) -> str | None:
    """The objects that are moved in a step; None where none is."""
    return " + ".join(plain(it.name) for it, now in zip(spec.objects, moved, strict=True) if now) or None


def pushes(spec: EnvSpec, labels: EpisodeLabels) -> tuple[Bool[np.ndarray, "s k"], Bool[np.ndarray, "t k"]]:
    """Which objects are moved between frame i and i+1, and which are no longer there at frame i."""
    position = labels.objects.position
    gone = ~np.isfinite(position).all(-1)
    distance = np.linalg.norm(np.diff(position, axis=0), axis=-1)
    vanishes = gone[1:] & ~gone[:-1]
    with np.errstate(invalid="ignore"):
        return (distance > spec.push_threshold) | vanishes, gone


def _below(masks: UInt8[np.ndarray, "t h w"], classes: list[int]) -> Float[np.ndarray, "t k 2"]:
    """The middle of each thing's lower end [px], where its name is written; NaN while it is not seen.

    The end and not the whole of it: the middle of an arm that reaches in at a slant is beside its hand. Not so low
    that the name would be outside the picture.
    """
    lowest, end = masks.shape[1] * LOWEST_NAME, max(1, round(masks.shape[1] * LOWER_END))
    places = np.full((len(masks), len(classes), 2), np.nan)
    for number, value in enumerate(classes):
        for frame, mask in enumerate(masks == value):
            if mask.any():
                bottom = int(np.flatnonzero(mask.any(1))[-1])
                columns = np.flatnonzero(mask[max(0, bottom + 1 - end) : bottom + 1].any(0))
                places[frame, number] = (columns[0] + columns[-1]) / 2, min(bottom, lowest)
    return places


def _extent(position: np.ndarray) -> float:
    """How large the world is [m], at least a little."""
    finite = position[np.isfinite(position).all(-1)]
    return max(float(np.ptp(finite, axis=0).max()), 1e-3) if len(finite) else 1.0
