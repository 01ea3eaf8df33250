"""Pictures that are sent as a video: when they were taken, and whether some of them were lost on the way.

With B-frames an encoder sends a picture before others that are shown earlier, so a message comes at another time than
its picture's. It cannot send a picture before that is taken, and sends one for each that comes in.
"""

from __future__ import annotations

import numpy as np
from jaxtyping import Bool, Int64

from dmotion_bench.storage.imports.timeline import interval_ns, steady_hz

Times = Int64[np.ndarray, " n"]


def as_shown(times_ns: Times, numbers: Int64[np.ndarray, " n"]) -> Times:
    """When pictures were taken, ascending if the times of their messages tell of it; else the same times.

    Times that ascend as the pictures are shown are theirs. Those that ascend as the messages were sent belong to the
    pictures in turn, earlier by as many intervals as the encoder must have kept one.

    Args:
        times_ns: Of the messages, in the order in which their pictures are shown.
        numbers: Of the messages.
    """
    sent = times_ns[numbers.argsort()]
    if not (np.diff(times_ns) < 0).any() or (np.diff(sent) < 0).any():
        return times_ns
    return sent - round(pictures_kept(numbers) * interval_ns(sent))


def pictures_kept(numbers: Int64[np.ndarray, " n"]) -> int:
    """How many pictures an encoder kept at least while it waited for a later one, which it sent before them.

    Args:
        numbers: Of the messages, in the order in which their pictures are shown.
    """
    place_sent = numbers.argsort().argsort()
    return int((np.arange(len(numbers)) - place_sent).max())


def skips(times_ns: Times, is_key: Bool[np.ndarray, " n"]) -> int:
    """In how many places the times of a steady camera skip a picture, and the next one needs those before it.

    A picture that was only late comes shortly before the next one.

    Args:
        times_ns: When each picture was taken, ascending.
        is_key: Whether it needs no other.
    """
    if not steady_hz(times_ns):
        return 0
    intervals, usual = np.diff(times_ns), interval_ns(times_ns)
    was_late = np.append(2 * intervals[1:] < usual, False)
    return int(((2 * intervals >= 3 * usual) & ~was_late & ~is_key[1:]).sum())
