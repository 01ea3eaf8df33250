"""The data of a training: its triplets, phase by phase, and the labels that its budget gives."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch

from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.batches import TripletBatches
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.labels import LabelBudget
from dmotion_bench.learning.model import Demonstrations, Phase, TrainingConfig
from dmotion_bench.learning.triplets import BatchOrder, TripletSet
from dmotion_bench.specs import Supervision

VALIDATION_TRIPLETS = 1024


@dataclass(frozen=True, kw_only=True)
class TrainingData:
    """The data that a run learns from.

    Attributes:
        train, validation: Triplets whose frames may be seen.
        budget: The door to the labels.
    """

    train: TripletSet
    validation: TripletSet
    budget: LabelBudget


@dataclass(frozen=True, kw_only=True)
class Part:
    """A phase with its place among the steps, its batches and its order of them."""

    phase: Phase
    start: int
    stop: int
    batches: TripletBatches
    order: BatchOrder
    validation: TripletBatches


def demonstrations_of(data: TrainingData, supervision: Supervision, device: torch.device) -> Demonstrations | None:
    """The demonstrations that the budget gives a model of video; None where it gives none.

    Raises:
        LabelsNotAvailable: They are not there.
    """
    if supervision is not Supervision.NONE or data.budget.request.kind == "none":
        return None
    given = data.budget.demonstrations(data.train)
    images = to_model(torch.from_numpy(given.frames)).to(device)
    return Demonstrations(
        previous=images[:, 0],
        current=images[:, 1],
        next=images[:, 2],
        action=as_tensor(given.actions, device),
    )


def parts_of(
    phases: Sequence[Phase], data: TrainingData, config: TrainingConfig, seed: int, device: torch.device
) -> tuple[Part, ...]:
    """The phases one after the other; those that need actions see the labelled triplets alone.

    Raises:
        LabelsNotAvailable: A phase needs actions that are not there.
    """
    video = TripletBatches(data.train, None, device)
    watched = TripletBatches(_evenly(data.validation, VALIDATION_TRIPLETS), None, device)
    labelled, labelled_watched = video, watched
    if any(phase.needs_actions for phase in phases):
        paid = data.budget.actions(data.train, "training")
        labelled = TripletBatches(paid.triplets, paid.actions, device)
        held = data.budget.actions(_evenly(data.validation, VALIDATION_TRIPLETS), "validation")
        labelled_watched = TripletBatches(held.triplets, held.actions, device)
    parts: list[Part] = []
    for number, phase in enumerate(phases):
        batches = labelled if phase.needs_actions else video
        size = phase.batch_size or config.batch_size
        total = BatchOrder(len(video), size, 0).steps(config.epochs)
        start = parts[-1].stop if parts else 0
        parts.append(
            Part(
                phase=phase,
                start=start,
                stop=start + max(1, round(phase.fraction * total)),
                batches=batches,
                order=BatchOrder(
                    len(batches), size, seed + number, episode=batches.triplets.episode, together=phase.together
                ),
                validation=labelled_watched if phase.needs_actions else watched,
            )
        )
    return tuple(parts)


def steps_before_labels(parts: Sequence[Part]) -> int | None:
    """The number of first steps that do not depend on the label budget; None if that is all steps, or none."""
    first = next((part.start for part in parts if part.phase.needs_actions), 0)
    return first or None


def _evenly(triplets: TripletSet, most: int) -> TripletSet:
    """At most so many triplets, spread evenly."""
    if len(triplets) <= most:
        return triplets
    return triplets.subset(np.linspace(0, len(triplets) - 1, most).round().astype(np.int64))
