"""What was seen to follow what in a task: which image came after which action at which image.

A model that is wrong about a push stays wrong. At the same image a planner has the same hope again, and goes to and fro
between two images for the rest of the task. By then it has been seen what really follows. An action that changes
nothing, which a planner is told of as ``blocked``, is the simplest case.

Images are the same if all of their pixels are. Where nothing ever repeats, as with a moving background, nothing is ever
known.
"""

from __future__ import annotations

import hashlib

import numpy as np
from jaxtyping import Float, Int, UInt8

UNKNOWN = -1


class Experience:
    """Of some tasks side by side, each for itself.

    Args:
        first: What is seen at their start.
        actions: How many there are; 0 of continuous ones, of which nothing is kept.

    Attributes:
        images: That were seen, each once a task.
        after: Of each image and action the number of the image that followed, or ``UNKNOWN``.
        here: The number of the image that each task shows now.
    """

    def __init__(self, first: UInt8[np.ndarray, "b h w 3"], actions: int) -> None:
        self._numbers: dict[tuple[int, bytes], int] = {}
        self.images: list[UInt8[np.ndarray, "h w 3"]] = []
        self.after: Int[np.ndarray, "n a"] = np.zeros((0, actions), np.int64)
        self.here: Int[np.ndarray, " b"] = self._numbered(first) if actions else np.zeros(0, np.int64)

    def took(
        self, actions: Int[np.ndarray, " b"] | Float[np.ndarray, "b a"], frames: UInt8[np.ndarray, "b h w 3"]
    ) -> None:
        """Keep what followed.

        Args:
            actions: That were taken, below 0 for none.
            frames: What is seen after them.
        """
        if not self.after.shape[1]:
            return
        reached, taken = self._numbered(frames), actions >= 0
        self.after[self.here[taken], actions[taken]] = reached[taken]
        self.here = reached

    def _numbered(self, frames: UInt8[np.ndarray, "b h w 3"]) -> Int[np.ndarray, " b"]:
        found = []
        for task, frame in enumerate(frames):
            name = (task, hashlib.blake2b(frame.tobytes(), digest_size=16).digest())
            if name not in self._numbers:
                self._numbers[name] = len(self.images)
                self.images.append(frame.copy())
            found.append(self._numbers[name])
        new = len(self.images) - len(self.after)
        self.after = np.concatenate([self.after, np.full((new, self.after.shape[1]), UNKNOWN)])
        return np.array(found)
