"""How much a data set can hold at most: what readers set memory aside for, and what writers refuse beforehand."""

from __future__ import annotations

from typing import Final

from dmotion_bench.actions import Continuous
from dmotion_bench.specs import EnvSpec

MIB: Final = 2**20
EPISODE_BYTES: Final = 512 * MIB
"""An episode is held in memory as a whole, with its labels."""
MOST_EPISODES: Final = 1_000_000
MOST_FRAMES: Final = 1_000_000  # an episode
MOST_TASKS: Final = 100_000
MOST_SHARD_EPISODES: Final = 10_000
MOST_OBJECTS: Final = 253  # a mask has a byte a pixel, and 0 and 1 are taken
MOST_FACTORS: Final = 256
MOST_REPLAYED: Final = 100
MOST_PARAMETERS: Final = 200_000  # an import names its files here
MOST_VERSIONS: Final = 256
LONGEST_NAME: Final = 256  # characters
LONGEST_TEXT: Final = 4096
LARGEST_SIDE: Final = 4096  # [px]
LARGEST_FILE: Final = 2**50  # [bytes]
LARGEST_MANIFEST: Final = 32 * 2**20  # bytes of a dataset.json that are read
SHARD_ENTRY: Final = 350  # bytes that dataset.json takes for a shard, with files below a terabyte
LAST_NS: Final = 2**63 - 1  # of a clock that counts nanoseconds in 64 bits
INDEX_BYTES: Final = 16
"""A frame has an entry of this size in the message index of its video file, however well its pixels are compressed."""
_STATE_BYTES: Final = 80  # ten numbers of eight bytes for each thing in each frame


def most_frames(spec: EnvSpec) -> int:
    """Frames that an episode can have."""
    frame = spec.height * spec.width * (3 + 1) + _STATE_BYTES * (1 + len(spec.objects))
    if isinstance(spec.actions, Continuous):
        frame += 8 * spec.actions.width
    return min(MOST_FRAMES, EPISODE_BYTES // frame)


def longest_episode(spec: EnvSpec) -> str:
    """How many frames an episode can have, in words."""
    return (
        f"an episode of {spec.width}x{spec.height} pixels can have {most_frames(spec):,}, which with their labels take "
        f"{EPISODE_BYTES // MIB} MiB of memory"
    )
