"""Ctrl-C, ``kill`` and a closed terminal end a command alike: it tidies up, and only the exit code differs.

All of them become a ``KeyboardInterrupt``, so that whatever copes with Ctrl-C copes with every one of them.
"""

from __future__ import annotations

import contextlib
import signal
import threading
from collections.abc import Callable, Iterator
from types import FrameType
from typing import Any, Final

INTERRUPTED: Final = "interrupted; run the same command again to go on where it stopped."
ENDING: Final = tuple(one for one in signal.Signals if one.name in ("SIGTERM", "SIGHUP"))
"""What a process is asked to end by, beside Ctrl-C; Windows has no SIGHUP."""


class _Received:
    """The last signal that asked this process to end, if any, and how many have come so far."""

    number: int = 0
    times: int = 0

    @classmethod
    def note(cls, number: int) -> None:
        """One has come."""
        cls.number = number
        cls.times += 1


def received() -> int:
    """The signal that asked this process to end, Ctrl-C's where Python alone noticed it; 0 if none did."""
    return _Received.number


def times_received() -> int:
    """How many signals have asked this process to end so far; a program of its own may have gone on after some."""
    return _Received.times


def interrupted_by(number: int) -> KeyboardInterrupt:
    """The interruption by a signal that another library has received."""
    _Received.note(number)
    return KeyboardInterrupt()


def exit_code() -> int:
    """The exit code of an interrupted process: 130 after Ctrl-C, 143 after ``kill``, 129 after a closed terminal."""
    return 128 + (_Received.number or signal.SIGINT)


@contextlib.contextmanager
def ended_like_ctrl_c() -> Iterator[None]:
    """Every signal that asks to end raises ``KeyboardInterrupt``, unless the process was started to ignore it."""
    _Received.number = 0

    def interrupt(number: int, _frame: FrameType | None) -> None:
        _Received.note(number)
        raise KeyboardInterrupt

    with _handled(interrupt, [number for number in ENDING if signal.getsignal(number) == signal.SIG_DFL]):
        yield


@contextlib.contextmanager
def stop_between_steps() -> Iterator[Callable[[], bool]]:
    """Delay an interruption to the end of the present step; a second interruption takes effect at once."""
    asked = False

    def ask(number: int, _frame: FrameType | None) -> None:
        nonlocal asked
        _Received.note(number)
        if asked:
            raise KeyboardInterrupt
        asked = True

    heeded = [number for number in (signal.SIGINT, *ENDING) if signal.getsignal(number) != signal.SIG_IGN]
    with _handled(ask, heeded):
        yield lambda: asked


@contextlib.contextmanager
def _handled(handler: Callable[[int, FrameType | None], Any], numbers: list[signal.Signals]) -> Iterator[None]:
    """Install signal handlers for the block; outside of the main thread Python allows none."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    before = {number: signal.signal(number, handler) for number in numbers}
    try:
        yield
    finally:
        for number, handled in before.items():
            signal.signal(number, handled)
