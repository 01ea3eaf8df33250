"""A data set whose triplets torch can load."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, SupportsIndex

import numpy as np
import torch
from jaxtyping import Float, Int, UInt8

from dmotion_bench.api.settings import SPLIT_PROTOCOLS, require_one_of, whole
from dmotion_bench.errors import LabelsNotAvailable, UsageError
from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.triplets import SplitProtocol, TripletSet
from dmotion_bench.learning.images import to_model
from dmotion_bench.specs import SplitName
from dmotion_bench.storage import dataset as stored
from dmotion_bench.storage.shard import EpisodeRow
from dmotion_bench.workspace import AnyPath, Workspace, in_workspace

Triplet = dict[str, torch.Tensor]
"""``previous``, ``current`` and ``next``, each Float[c h w] in [-1, 1]; ``episode``; with labels also ``action``."""


Video = UInt8[np.ndarray, "t h w 3"]
"""The frames of an episode, RGB 0-255."""


class Dataset(stored.Dataset, torch.utils.data.Dataset[Video]):
    """A data set on disk; ``open_dataset`` opens one.

    It has what ``dmotion_bench.storage.dataset.Dataset`` has, such as ``video(episode)``, ``split(name)`` and
    ``labels(episode)``, and ``triplets`` for torch. It is a data set of torch itself: its items are the videos of its
    episodes, without their labels.
    """

    def __getitem__(self, episode: SupportsIndex) -> Video:
        """An episode's frames, RGB 0-255, as ``video`` gives them; -1 is the last episode.

        Raises:
            IndexError: There is none of this number.
            UsageError: That is no number.
        """
        return self.video(_place("episode", episode, len(self)))

    def __repr__(self) -> str:
        """Its name, its episodes and frames, and where they are from."""
        return f"<Dataset {self.name!r}: {len(self)} episodes, {self.lengths.sum()} frames, {self.recipe.environment}>"

    def row(self, episode: SupportsIndex) -> EpisodeRow:
        """Where an episode is and how it came about.

        Raises:
            UsageError: There is none of this number, or that is no number.
        """
        return super().row(whole("episode", episode))

    def triplets(
        self,
        split: SplitName = "train",
        *,
        labels: str | SupportsIndex | None = None,
        seed: SupportsIndex = 0,
        protocol: SplitProtocol = "episode",
    ) -> TripletDataset:
        """The triplets of consecutive frames of a split, as a ``torch.utils.data.Dataset``.

        Args:
            split: ``"train"``, ``"validation"`` or ``"test"``.
            labels: A label budget, such as ``"10%"``, ``"all"`` or ``64``: only the triplets whose actions it pays
                for, and those actions. None or ``"none"``: all triplets, without actions; ``labels/`` is not opened.
            seed: Changes nothing: what the budgets that are allowed here give is the same for every seed.
            protocol: ``"episode"`` keeps whole episodes apart; ``"paper"`` shuffles triplets as the paper does.

        Raises:
            UnknownName: There is no such split or protocol.
            UsageError: Labels of test episodes are asked for.
            LabelsNotAvailable: The labels are not there, or the budget is for demonstrations.
            InvalidSetting: That is no label budget.

        Example:
            >>> from torch.utils.data import DataLoader
            >>> loader = DataLoader(dm.open_dataset("grid_world-tiny").triplets("train"), batch_size=8)
            >>> next(iter(loader))["current"].shape
            torch.Size([8, 3, 128, 128])
        """
        self.split(split)  # an unknown name is said here
        require_one_of("protocol", protocol, SPLIT_PROTOCOLS)
        chosen = TripletSet.of_split(self, split, protocol)
        request = LabelRequest("none") if labels is None else LabelRequest.parse(str(labels))
        if request.kind == "none":
            return TripletDataset(chosen)
        purpose: Literal["training", "validation"]
        if split == "train":
            purpose = "training"
        elif split == "validation":
            purpose = "validation"
        else:
            raise UsageError(
                f"labels={labels!r} was asked for the test split, whose labels no model may learn from; "
                "leave out labels, or take the split 'train' or 'validation'. dm.score reads them to judge a model."
            )
        if request.kind not in ("share", "count"):
            raise LabelsNotAvailable(
                f"labels={labels!r} are demonstrations, which a training draws; ask for a number of triplets such as "
                'labels=64, a share such as labels="10%", or labels="all".'
            )
        budget = LabelBudget(self, request, whole("seed", seed, 0))
        labelled = budget.actions(chosen, purpose)
        return TripletDataset(labelled.triplets, labelled.actions)


class TripletDataset(torch.utils.data.Dataset[Triplet]):
    """Triplets of consecutive frames, one by one; a plain ``DataLoader`` makes batches of them.

    A batch has the fields of ``TripletBatch``: ``model.losses(TripletBatch(**batch))``.

    Args:
        triplets: Which ones.
        actions: Of each, where they were paid for.

    Attributes:
        triplets: Which ones: ``triplets.episode`` and ``triplets.step`` say where each is from.
        actions: Of each, or None.
    """

    def __init__(
        self, triplets: TripletSet, actions: Int[np.ndarray, " n"] | Float[np.ndarray, "n a"] | None = None
    ) -> None:
        self.triplets, self.actions = triplets, actions

    def __len__(self) -> int:
        return len(self.triplets)

    def __repr__(self) -> str:
        return f"<TripletDataset: {len(self)} triplets, with{'out' if self.actions is None else ''} actions>"

    def __getitem__(self, index: SupportsIndex) -> Triplet:
        """One triplet; -1 is the last.

        Raises:
            IndexError: There is none of this number.
            UsageError: That is no number.
        """
        return self.__getitems__([_place("triplet", index, len(self))])[0]

    def __getitems__(self, indices: Sequence[int]) -> list[Triplet]:
        """Several at once, which a ``DataLoader`` asks for: one read for a batch."""
        rows = np.asarray(indices, np.int64)
        frames = to_model(torch.from_numpy(self.triplets.gather(rows)))
        episodes = torch.from_numpy(self.triplets.episode[rows])
        known: dict[str, Any] = {} if self.actions is None else {"action": as_tensor(self.actions[rows])}
        return [
            {"previous": frames[row, 0], "current": frames[row, 1], "next": frames[row, 2], "episode": episodes[row]}
            | {name: value[row] for name, value in known.items()}
            for row in range(len(rows))
        ]


def _place(what: str, index: SupportsIndex, count: int) -> int:
    """Where an item is, counted from the first one.

    Raises:
        IndexError: There is none.
        UsageError: The index is no whole number.
    """
    place = whole(what, index)
    if not -count <= place < count:
        raise IndexError(f"there is no {what} {place}; there are {count}.")
    return place % count


@in_workspace
def open_dataset(data: AnyPath | None = None, *, workspace: AnyPath | None = None) -> Dataset:
    """Open a data set that was recorded or imported.

    Args:
        data: Its folder, its name in the workspace, or what ``record`` returned. Default: the workspace's only one.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.

    Raises:
        DatasetMissing, UnknownName: There is none.
        UsageError: There are several, and none was named.
        DatasetIncomplete: Its recording was interrupted.
        DatasetCorrupt: Its files are damaged.

    Example:
        >>> data = dm.open_dataset("grid_world-tiny")
        >>> data.video(0).shape, data.video(0).dtype
        ((12, 128, 128, 3), dtype('uint8'))
    """
    place = Workspace.current()
    return Dataset.open(place.dataset(data))
