"""The split into training, validation and test episodes; it is by episode, never by triplet.

Episodes that are parts of one recording stay on one side (decision 109).
"""

from __future__ import annotations

from typing import Final, get_args

import numpy as np
from jaxtyping import Int

from dmotion_bench.specs import SplitName

TEST_SHARE: Final = 0.1  # the paper's 9:1
VALIDATION_SHARE: Final = 0.1  # of what the test leaves
FEWEST_EPISODES: Final = 10  # with fewer, one episode is more than a tenth; the same of sources
_STREAM: Final = 0x5711  # sets the split's random numbers apart from the episodes'
SPLIT_NAMES: Final[tuple[SplitName, ...]] = get_args(SplitName)


def split_episodes(
    seed: int, episodes: int, sources: Int[np.ndarray, " {episodes}"] | None = None
) -> dict[SplitName, Int[np.ndarray, " n"]]:
    """The episodes of each split, sorted: a pure function of the arguments.

    Each source draws a number of its own; the lowest go to the test, the next to validation. When a data set
    is extended, most episodes therefore stay on their side.

    Args:
        seed: The recipe's.
        episodes: How many there are.
        sources: The number of the recording that each episode is a part of; None: each episode is its own source.
    """
    numbers, source_of = np.unique(np.arange(episodes) if sources is None else sources, return_inverse=True)
    count = len(numbers)
    keys = np.empty((count, 2), np.uint32)
    for place, number in enumerate(numbers.tolist()):
        keys[place] = np.random.SeedSequence([seed, _STREAM], spawn_key=(number,)).generate_state(2)
    order = np.lexsort((keys[:, 1], keys[:, 0]))
    test = 0 if count < 2 else max(1, round(TEST_SHARE * count))
    validation = 0 if count < 3 else max(1, round(VALIDATION_SHARE * (count - test)))
    sides: dict[SplitName, Int[np.ndarray, " n"]] = {
        "train": order[test + validation :],
        "validation": order[test : test + validation],
        "test": order[:test],
    }
    return {name: np.flatnonzero(np.isin(source_of, side)) for name, side in sides.items()}
