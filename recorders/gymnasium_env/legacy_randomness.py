"""The random numbers that numpy and Python share in a whole process, kept apart for one simulator.

Some simulators draw from ``numpy.random`` or ``random`` themselves, which no ``reset(seed=...)`` reaches. While such a
simulator works, these generators hold numbers of its own, begun by the episode's seed; afterwards they are as they were
before. So it repeats, and nobody else notices.
"""

from __future__ import annotations

import contextlib
import random
from collections.abc import Iterator
from typing import Any

import numpy as np


class LegacyRandomness:
    """The shared generators' states, as one simulator sees them."""

    def __init__(self) -> None:
        self.begin(0)

    def begin(self, seed: int) -> None:
        """Start anew; ``seed`` is below 2^32."""
        self._numpy: Any = np.random.RandomState(seed).get_state()
        self._python = random.Random(seed).getstate()

    @contextlib.contextmanager
    def lent(self) -> Iterator[None]:
        """Put them in the place of the process's own for as long as the block lasts."""
        outside = np.random.get_state(), random.getstate()  # noqa: NPY002
        np.random.set_state(self._numpy)  # noqa: NPY002
        random.setstate(self._python)
        try:
            yield
        finally:
            self._numpy, self._python = np.random.get_state(), random.getstate()  # noqa: NPY002
            np.random.set_state(outside[0])  # noqa: NPY002
            random.setstate(outside[1])
