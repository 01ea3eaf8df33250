"""Which episode is for training, which for validation, which for the test: by episode, never by triplet."""

from __future__ import annotations

from typing import Final, get_args

import numpy as np
from jaxtyping import Int

from dmotion_bench.specs import SplitName

TEST_SHARE: Final = 0.1  # the paper's 9:1
VALIDATION_SHARE: Final = 0.1  # of what the test leaves
FEWEST_EPISODES: Final = 10  # with fewer, one episode is more than a tenth
_STREAM: Final = 0x5711  # sets the split's random numbers apart from the episodes'
SPLIT_NAMES: Final[tuple[SplitName, ...]] = get_args(SplitName)


def split_episodes(seed: int, episodes: int) -> dict[SplitName, Int[np.ndarray, " n"]]:
    """The episodes of each split, sorted: a pure function of the recipe's seed and the number of episodes.

    Each episode draws a number of its own; the lowest go to the test, the next to validation. When a data set
    is extended, most episodes therefore stay on their side.
    """
    keys = np.empty((episodes, 2), np.uint32)
    for one in range(episodes):
        keys[one] = np.random.SeedSequence([seed, _STREAM], spawn_key=(one,)).generate_state(2)
    order = np.lexsort((keys[:, 1], keys[:, 0]))
    test = 0 if episodes < 2 else max(1, round(TEST_SHARE * episodes))
    validation = 0 if episodes < 3 else max(1, round(VALIDATION_SHARE * (episodes - test)))
    return {
        "train": np.sort(order[test + validation :]),
        "validation": np.sort(order[test : test + validation]),
        "test": np.sort(order[:test]),
    }
