"""The data of a training: its triplets, phase by phase, and the labels that its budget gives."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Int
from torch import Tensor

from dmotion_bench.learning.data.batches import (
    Batches,
    DemonstrationBatches,
    FramesOnDevice,
    LabelsBeside,
    TripletBatches,
)
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.stored_demonstrations import shown_to_models
from dmotion_bench.learning.data.streamed import StreamedBatches, StreamedTriplets
from dmotion_bench.learning.data.streamed_order import StreamedOrder
from dmotion_bench.learning.data.triplets import BatchOrder, TripletSet, steps_of
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.model import Phase, TrainingConfig
from dmotion_bench.specs import Supervision

VALIDATION_TRIPLETS = 1024
Source = Callable[[Phase, int, int], tuple[Batches, BatchOrder | StreamedOrder]]
"""The batches of a phase and their order, by batch size and seed."""


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """The data that a run learns from.

    Attributes:
        train, validation: Triplets whose frames may be seen; streamed are both or neither.
        budget: The door to the labels.
    """

    train: TripletSet | StreamedTriplets
    validation: TripletSet | StreamedTriplets
    budget: LabelBudget


@dataclass(frozen=True, kw_only=True)
class Part:
    """A phase with its place among the steps, its batches and its order of them."""

    phase: Phase
    start: int
    stop: int
    batches: Batches
    order: BatchOrder | StreamedOrder
    validation: Batches


def demonstrations_of(data: TrainingData, supervision: Supervision, device: torch.device) -> Demonstrations | None:
    """The demonstrations that the budget gives a model of video; None where it gives none.

    Raises:
        LabelsNotAvailable: They are not there.
    """
    if supervision is Supervision.ACTIONS or data.budget.request.kind == "none":
        return None
    return shown_to_models(data.budget.demonstrations(data.train), device)


def parts_of(
    phases: Sequence[Phase],
    data: TrainingData,
    config: TrainingConfig,
    seed: int,
    device: torch.device,
    shown: Demonstrations | None = None,
) -> tuple[Part, ...]:
    """The phases one after the other; those that need actions see the labelled triplets alone.

    Args:
        phases, data, config, seed, device: Of the training.
        shown: The demonstrations that the budget gave a model of ``Supervision.FEW``: these are its labelled triplets,
            also to validate with, since of few none is held back.

    Raises:
        LabelsNotAvailable: A phase needs actions that are not there.
    """
    source_of = _of_streams if isinstance(data.train, StreamedTriplets) else _of_sets
    held = held_for_validation(data)
    frames = FramesOnDevice(device)
    watched: Batches = TripletBatches(held, None, frames)
    labelled_watched = watched
    sources: dict[bool, Source] = {}
    if not all(phase.needs_actions for phase in phases):
        sources[False] = source_of(data, frames, False)
    if any(phase.needs_actions for phase in phases):
        if shown is not None:
            sources[True] = _of_demonstrations(shown)
            labelled_watched = DemonstrationBatches(shown.subset(_spread(len(shown), VALIDATION_TRIPLETS)))
        else:
            sources[True] = source_of(data, frames, True)
            labelled_watched = _labelled_validation(data, held, frames)
    parts: list[Part] = []
    for number, phase in enumerate(phases):
        size = phase.batch_size or config.batch_size
        batches, order = sources[phase.needs_actions](phase, size, seed + number)
        if phase.with_labels and shown is not None:
            beside = BatchOrder(len(shown), phase.with_labels, seed + number)
            batches = LabelsBeside(batches, DemonstrationBatches(shown), beside)
        total = steps_of(config.epochs, len(data.train), size)
        start = parts[-1].stop if parts else 0
        parts.append(
            Part(
                phase=phase,
                start=start,
                stop=start + max(1, round(phase.fraction * total)),
                batches=batches,
                order=order,
                validation=labelled_watched if phase.needs_actions else watched,
            )
        )
    return tuple(parts)


def _labelled_validation(data: TrainingData, held: TripletSet, frames: FramesOnDevice) -> TripletBatches:
    """The labelled triplets to validate with; a budget of one has none of the validation episodes, only its own."""
    paid = data.budget.actions(held, "validation")
    if not len(paid.triplets):
        train = data.train
        if isinstance(train, StreamedTriplets):
            alone, _ = data.budget.streamed_actions(train)
            train = alone.picked(np.arange(len(alone)))
        paid = data.budget.actions(train, "training")
    return TripletBatches(paid.triplets, paid.actions, frames)


def _of_demonstrations(shown: Demonstrations) -> Source:
    """The triplets of a phase out of demonstrations; their episodes are not told, so none are side by side."""
    batches = DemonstrationBatches(shown)

    def source(phase: Phase, size: int, seed: int) -> tuple[Batches, BatchOrder]:
        return batches, BatchOrder(len(batches), size, seed)

    return source


def _of_sets(data: TrainingData, frames: FramesOnDevice, needs_actions: bool) -> Source:
    """The triplets of a phase out of the frame cache."""
    triplets, actions = data.train, None
    assert isinstance(triplets, TripletSet), "streamed triplets are not in the cache"
    if needs_actions:
        paid = data.budget.actions(triplets, "training")
        triplets, actions = paid.triplets, paid.actions
    batches, episode = TripletBatches(triplets, actions, frames), triplets.episode

    def source(phase: Phase, size: int, seed: int) -> tuple[Batches, BatchOrder]:
        order = BatchOrder(len(batches), size, seed, episode=episode, together=phase.together)
        return batches.reaching_back(phase.earlier), order

    return source


def _of_streams(data: TrainingData, frames: FramesOnDevice, needs_actions: bool) -> Source:
    """The triplets of a phase out of the compressed files."""
    triplets, actions = data.train, None
    assert isinstance(triplets, StreamedTriplets), "triplets of the cache are not streamed"
    if needs_actions:
        triplets, actions = data.budget.streamed_actions(triplets)

    def source(phase: Phase, size: int, seed: int) -> tuple[Batches, StreamedOrder]:
        order = triplets.order(size, seed, phase.together)
        return StreamedBatches(triplets, order, actions, frames.device, phase.earlier), order

    return source


def steps_before_labels(parts: Sequence[Part]) -> int | None:
    """The number of first steps that do not depend on the label budget; None if that is all steps, or none."""
    first = next((part.start for part in parts if part.phase.needs_actions or part.phase.with_labels), 0)
    return first or None


def held_for_validation(data: TrainingData) -> TripletSet:
    """The triplets that a training validates with; where they are streamed, a small cache is made of them.

    Raises:
        CacheNotWritable: That cache can be kept nowhere.
        StorageFull: There is no space for it.
    """
    return _evenly(data.validation, VALIDATION_TRIPLETS)


def labels_given(
    train: TripletSet | StreamedTriplets,
    validation: TripletSet | StreamedTriplets,
    budget: LabelBudget,
    supervision: Supervision,
) -> Mapping[str, int]:
    """How many labels a budget gives a training, by purpose; none of them is learned from.

    Raises:
        LabelsNotAvailable: The budget asks for labels that are not there.
    """
    if supervision is Supervision.ACTIONS:
        if isinstance(train, StreamedTriplets):
            budget.streamed_actions(train)
        else:
            budget.actions(train, "training")
        budget.actions(_evenly(validation, VALIDATION_TRIPLETS), "validation")
    elif budget.request.kind != "none":
        budget.demonstrations(train)
    return budget.given


def video_sample(data: TrainingData, most: int) -> TripletSet:
    """At most so many triplets of the training video, spread evenly; where it is streamed, those of the validation.

    Raises:
        CacheNotWritable, StorageFull: As for ``held_for_validation``.
    """
    return _evenly(data.train, most) if isinstance(data.train, TripletSet) else held_for_validation(data)


def _evenly(triplets: TripletSet | StreamedTriplets, most: int) -> TripletSet:
    """At most so many triplets, spread evenly."""
    if isinstance(triplets, TripletSet) and len(triplets) <= most:
        return triplets
    index = _spread(len(triplets), most).numpy()
    return triplets.subset(index) if isinstance(triplets, TripletSet) else triplets.picked(index)


def _spread(count: int, most: int) -> Int[Tensor, " m"]:
    """At most so many of so many places, spread evenly."""
    return torch.from_numpy(np.linspace(0, count - 1, min(most, count)).round().astype(np.int64))
