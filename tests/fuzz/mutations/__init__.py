"""Ways to spoil a file: plain bytes, and each format by its own structure.

Each takes a random generator and the file's bytes, and gives other bytes and a few words on what was done.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeVar

import numpy as np

T = TypeVar("T")
Mutation = Callable[[np.random.Generator, bytes], tuple[bytes, str]]


def pick(rng: np.random.Generator, choices: Sequence[T]) -> T:
    """One of several, each as likely."""
    return choices[int(rng.integers(len(choices)))]
