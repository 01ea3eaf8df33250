"""The held-out transitions that models are scored on, in batches that can span several episodes.

One episode's labels are in memory at a time, and one batch of frames, however many episodes there are.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, fields
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.errors import DatasetError, LabelsNotAvailable
from dmotion_bench.learning.data.triplets import SplitProtocol, TripletSet
from dmotion_bench.specs import EnvSpec, EpisodeLabels, SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.messages import StateLabels

STARTS_PER_EPISODE = 4


@dataclass(frozen=True, kw_only=True)
class TransitionBatch:
    """Triplets with their labels; row i's ``action`` leads from its frame 1 to its frame 2.

    Attributes:
        episode, step: The middle frame's episode and its number within it.
        frames: Axis 1 is previous, current, next.
        action: Taken at the middle frame.
        pushed: Whether it moves an object.
        masks: Which agent each pixel shows, 1 + its number in ``EnvSpec.agents``, 0 for none; axis 1 is current, next.
            None where they were not asked for.
        shifts: How far each agent's centre moves, (right, down) [px].
    """

    episode: Int[np.ndarray, " b"]
    step: Int[np.ndarray, " b"]
    frames: UInt8[np.ndarray, "b 3 h w 3"]
    action: Int[np.ndarray, " b"] | Float[np.ndarray, "b a"]
    pushed: Bool[np.ndarray, " b"]
    masks: UInt8[np.ndarray, "b 2 h w"] | None
    shifts: Float[np.ndarray, "b k 2"]

    @property
    def agents(self) -> UInt8[np.ndarray, "b 2 h w"]:
        """The masks, of batches that have them."""
        assert self.masks is not None, "these batches were asked for without masks"
        return self.masks

    @property
    def agent(self) -> Bool[np.ndarray, "b 2 h w"]:
        """Which pixels show an agent; axis 1 is current, next."""
        return self.agents > 0

    def __len__(self) -> int:
        return len(self.step)

    def __getitem__(self, rows: slice) -> TransitionBatch:
        parts: dict[str, Any] = {name: None if one is None else one[rows] for name, one in vars(self).items()}
        return TransitionBatch(**parts)


@dataclass(frozen=True, kw_only=True)
class RolloutBatch:
    """The starts of rollouts and the true frames that follow.

    Attributes:
        episode, start: The episode, and the number within it of ``current``.
        previous, current: The two true frames that a rollout begins with.
        future: The true frames after them.
        actions: The recorded ones; ``actions[:, k]`` leads to ``future[:, k]``.
        pushed: Whether that action moves an object.
    """

    episode: Int[np.ndarray, " b"]
    start: Int[np.ndarray, " b"]
    previous: UInt8[np.ndarray, "b h w 3"]
    current: UInt8[np.ndarray, "b h w 3"]
    future: UInt8[np.ndarray, "b t h w 3"]
    actions: Int[np.ndarray, "b t"] | Float[np.ndarray, "b t a"]
    pushed: Bool[np.ndarray, "b t"]


class HeldOut:
    """One split of a labelled data set, as scoring reads it.

    Args:
        dataset: Must have labels.
        split: Which part.
        protocol: ``"paper"`` takes the triplets of the paper's leaking split; rollouts are by episode always.

    Raises:
        LabelsNotAvailable: The actions of the data set are not known.
        DatasetError: The split is empty.
    """

    def __init__(self, dataset: Dataset, split: SplitName, protocol: SplitProtocol = "episode") -> None:
        if dataset.spec.actions is None:
            raise LabelsNotAvailable(
                f"the actions of {dataset.name!r} are not known, so predictions that follow them cannot be scored; "
                "import the recording again with its actions: 'dmbench data import FILE --actions TOPIC --out DIR'."
            )
        self.dataset, self.split, self.protocol = dataset, split, protocol
        self._triplets = TripletSet.of_split(dataset, split, protocol)
        if not len(self._triplets):
            raise DatasetError(
                f"the {split} split of {dataset.name!r} has no triplet; record more episodes "
                "with 'dmbench record' and a larger '--episodes'."
            )

    def __len__(self) -> int:
        """Number of triplets."""
        return len(self._triplets)

    def batches(self, size: int, *, masks: bool = True) -> Iterator[TransitionBatch]:
        """All triplets in the order of their episodes and steps, ``size`` at a time, the last batch the rest.

        Args:
            size: Triplets in a batch.
            masks: Whether they come along; to decode them takes most of the time.
        """
        waiting: list[TransitionBatch] = []
        for part in self._by_episode(size, masks):
            waiting.append(part)
            if sum(map(len, waiting)) >= size:
                merged = _joined(waiting)
                whole = len(merged) // size * size
                for start in range(0, whole, size):
                    yield merged[start : start + size]
                waiting = [merged[whole:]]
        if sum(map(len, waiting)):
            yield _joined(waiting)

    def rollouts(self, horizon: int, size: int) -> Iterator[RolloutBatch]:
        """Rollouts of ``horizon`` steps, ``size`` at a time; see ``rollout_starts``."""
        pairs = self._starts(horizon)
        for first in range(0, len(pairs), size):
            yield self._rollout_batch(pairs[first : first + size], horizon)

    def count_rollouts(self, horizon: int) -> int:
        """How many rollouts of ``horizon`` steps there are."""
        return len(self._starts(horizon))

    @property
    def longest_rollout(self) -> int:
        """Steps of the longest rollout that an episode has the frames for; below 1 if there is none."""
        lengths = np.diff(np.asarray(self.dataset.cache().offsets))
        return int(lengths[self.dataset.split(self.split)].max(initial=0)) - 2

    def _starts(self, horizon: int) -> list[tuple[int, int]]:
        offsets = np.asarray(self.dataset.cache().offsets)
        lengths = np.diff(offsets)
        return [
            (episode, start)
            for episode in self.dataset.split(self.split).tolist()
            for start in rollout_starts(int(lengths[episode]), horizon).tolist()
        ]

    def _rollout_batch(self, pairs: list[tuple[int, int]], horizon: int) -> RolloutBatch:
        cache = self.dataset.cache()
        states = {episode: self.dataset.states(episode) for episode in {episode for episode, _ in pairs}}
        frames, actions, pushed = [], [], []
        for episode, start in pairs:
            place = int(cache.offsets[episode]) + start
            frames.append(cache.checked(np.array([place - 1]), horizon + 2)[place - 1 : place + horizon + 1])
            actions.append(states[episode].actions[start : start + horizon])
            pushed.append(states[episode].pushed[start : start + horizon])
        stacked = np.stack(frames)
        return RolloutBatch(
            episode=np.asarray([episode for episode, _ in pairs]),
            start=np.asarray([start for _, start in pairs]),
            previous=stacked[:, 0],
            current=stacked[:, 1],
            future=stacked[:, 2:],
            actions=np.stack(actions),
            pushed=np.stack(pushed),
        )

    def _by_episode(self, most: int, masks: bool) -> Iterator[TransitionBatch]:
        """The triplets of one episode after the other, those of a long one in parts."""
        episodes, first, count = np.unique(self._triplets.episode, return_index=True, return_counts=True)
        for episode, start, rows in zip(episodes.tolist(), first.tolist(), count.tolist(), strict=True):
            agents: UInt8[np.ndarray, "t h w"] | None = None
            labels: StateLabels | EpisodeLabels
            if masks:
                labels = whole = self.dataset.labels(episode)
                agents = agents_in(whole.masks, self.dataset.spec)
            else:
                labels = self.dataset.states(episode)
            place = labels.agent.pixel
            for begin in range(start, start + rows, most):
                part = self._triplets.subset(np.arange(begin, min(begin + most, start + rows)))
                step = part.step
                yield TransitionBatch(
                    episode=part.episode,
                    step=step,
                    frames=part.gather(np.arange(len(part))),
                    action=labels.actions[step],
                    pushed=labels.pushed[step],
                    masks=None if agents is None else np.stack([agents[step], agents[step + 1]], axis=1),
                    shifts=(place[step + 1] - place[step]).astype(np.float64),
                )


def agents_in(masks: UInt8[np.ndarray, "*t h w"], spec: EnvSpec) -> UInt8[np.ndarray, "*t h w"]:
    """Which agent each pixel shows: 1 + its number in ``EnvSpec.agents``, 0 for none."""
    number = np.zeros(256, np.uint8)
    number[list(spec.agent_masks)] = np.arange(1, len(spec.agents) + 1)
    agents: UInt8[np.ndarray, "*t h w"] = number[masks]
    return agents


def rollout_starts(frames: int, horizon: int) -> Int[np.ndarray, " s"]:
    """Where the rollouts of an episode begin: up to four places, spread evenly from its first to its last possible.

    Every rollout has its whole horizon of true frames, so all steps of a rollout curve are over the same starts;
    an episode of fewer than ``horizon`` + 2 frames has none.
    """
    last = frames - 1 - horizon
    if last < 1:
        return np.zeros(0, np.int64)
    return np.unique(np.linspace(1, last, STARTS_PER_EPISODE).round().astype(np.int64))


def _joined(parts: list[TransitionBatch]) -> TransitionBatch:
    columns = {field.name: [getattr(part, field.name) for part in parts] for field in fields(TransitionBatch)}
    joined: dict[str, Any] = {
        name: None if values[0] is None else np.concatenate(values) for name, values in columns.items()
    }
    return TransitionBatch(**joined)
