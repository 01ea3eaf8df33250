"""``--json`` prints one object alone: what environments, models and libraries print meanwhile goes to stderr."""

from __future__ import annotations

import contextlib
import os
import sys
from collections.abc import Iterator
from typing import Final

_STDOUT: Final = 1
_STDERR: Final = 2


@contextlib.contextmanager
def prints_on_stderr(as_json: bool) -> Iterator[None]:
    """Send to stderr whatever this process and those that it starts print, in Python or below it.

    Args:
        as_json: Whether the command was given ``--json``; without it nothing is changed.
    """
    if not as_json:
        yield
        return
    try:
        own = os.dup(_STDOUT)
    except OSError:  # it is closed
        yield
        return
    _flush()
    os.dup2(_STDERR, _STDOUT)
    try:
        with contextlib.redirect_stdout(sys.stderr):
            yield
    finally:
        _flush()
        os.dup2(own, _STDOUT)
        os.close(own)


def _flush() -> None:
    """Write what Python and C libraries hold back; each has a buffer of its own."""
    if sys.stdout is not None:  # it is None in a process that was started without
        sys.stdout.flush()
    import ctypes  # other commands start without it

    with contextlib.suppress(OSError, AttributeError, TypeError):  # Windows has no library of this name
        ctypes.CDLL(None).fflush(None)
