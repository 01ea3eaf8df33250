"""The choice of episodes to show."""

from __future__ import annotations

from collections.abc import Sequence

from dmotion_bench.errors import UsageError
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.readable import ReadableDataset

FEW = 3
"""About 4 MB each of a run on Robot Push."""


def choose_episodes(dataset: ReadableDataset, asked: Sequence[int], split: SplitName | None) -> list[int]:
    """The episodes asked for, each once, or the first few of the split, or of all.

    Raises:
        UsageError: There is no such episode, it is of another split, or the split has none.
    """
    of_split = range(len(dataset)) if split is None else dataset.split(split).tolist()
    if not len(of_split):
        raise UsageError(
            f"{dataset.name} has no episode in the {split} split; name another split, or episodes without a split."
        )
    for episode in asked:
        if episode >= len(dataset):
            raise UsageError(f"{dataset.name} has no episode {episode}; it has 0 to {len(dataset) - 1}.")
        if episode not in of_split:
            listed = ", ".join(map(str, of_split[:20])) + (" ..." if len(of_split) > 20 else "")
            raise UsageError(f"episode {episode} of {dataset.name} is not in the {split} split; that has {listed}.")
    return list(dict.fromkeys(asked)) or list(of_split[:FEW])
