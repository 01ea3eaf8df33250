"""Read single keys from a terminal, including the arrow keys."""

from __future__ import annotations

import contextlib
import os
import select
import sys
from collections.abc import Iterator

from dmotion_bench.errors import UsageError

ARROWS = {"A": "up", "B": "down", "C": "right", "D": "left"}
ESCAPE = "escape"
WITHIN = 0.05  # [s] that the rest of an arrow key's bytes may take


def require_terminal(why: str) -> int:
    """Standard input, if it is a terminal.

    Raises:
        UsageError: It is no terminal.
    """
    if not sys.stdin.isatty():
        raise UsageError(
            f"{why} reads keys from a terminal, and standard input is not a terminal; "
            "run it in one, or over ssh with 'ssh -t'."
        )
    return sys.stdin.fileno()


@contextlib.contextmanager
def single_keys(terminal: int) -> Iterator[None]:
    """Deliver keys as they are pressed, without showing them; restore the terminal afterwards.

    Raises:
        UsageError: This system's terminals cannot be read key by key.
    """
    try:
        import termios
        import tty
    except ImportError:
        raise UsageError("this system's terminal does not deliver single keys; use Linux or macOS.") from None
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal, termios.TCSADRAIN)  # Ctrl-C still interrupts; keys pressed early are kept
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def read_keys(terminal: int) -> Iterator[str]:
    """Yield the pressed keys one by one: ``"up"``, ``"down"``, ``"left"``, ``"right"``, ``"escape"``, or a character.

    Ends with the input.
    """
    while data := os.read(terminal, 1):
        if data != b"\x1b":
            yield data.decode("latin-1")
            continue
        rest = ""
        while not _is_whole(rest) and select.select([terminal], [], [], WITHIN)[0]:
            after = os.read(terminal, 1).decode("latin-1")
            if not after:
                break
            rest += after
        if not rest:
            yield ESCAPE
        elif rest[0] in "[O" and rest[1:] and rest[-1] in ARROWS:
            yield ARROWS[rest[-1]]


def _is_whole(rest: str) -> bool:
    """Whether this is all that a key sends after an escape: one of several has numbers before its letter.

    With Shift an arrow sends ``[1;2C``, and F5 ``[15~``; what would be left of it were taken for other keys.
    """
    if rest[:1] == "[":
        return len(rest) > 1 and "@" <= rest[-1] <= "~"
    return len(rest) > (rest[:1] == "O")
