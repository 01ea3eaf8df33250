"""Single keys from a terminal, arrow keys among them."""

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
    """Standard input, if somebody sits before it.

    Raises:
        UsageError: It is no terminal.
    """
    if not sys.stdin.isatty():
        raise UsageError(
            f"{why} needs a terminal to read keys from, and standard input is none; "
            "run it in a terminal, over ssh with 'ssh -t'."
        )
    return sys.stdin.fileno()


@contextlib.contextmanager
def single_keys(terminal: int) -> Iterator[None]:
    """Keys arrive as they are pressed and are not echoed; afterwards the terminal is as it was.

    Raises:
        UsageError: This system's terminals cannot be read key by key.
    """
    try:
        import termios
        import tty
    except ImportError:
        raise UsageError("this system's terminal cannot be read key by key; it takes Linux or macOS.") from None
    before = termios.tcgetattr(terminal)
    try:
        tty.setcbreak(terminal, termios.TCSADRAIN)  # Ctrl-C still interrupts; keys pressed early are kept
        yield
    finally:
        termios.tcsetattr(terminal, termios.TCSADRAIN, before)


def read_keys(terminal: int) -> Iterator[str]:
    """One key after the other: ``"up"``, ``"down"``, ``"left"``, ``"right"``, ``"escape"``, or a character.

    Ends with the input.
    """
    while data := os.read(terminal, 1):
        if data != b"\x1b":
            yield data.decode("latin-1")
            continue
        rest = ""
        while len(rest) < 2 and select.select([terminal], [], [], WITHIN)[0]:
            after = os.read(terminal, 1).decode("latin-1")
            if not after:
                break
            rest += after
        if not rest:
            yield ESCAPE
        elif rest[0] in "[O" and rest[1:] in ARROWS:
            yield ARROWS[rest[1:]]
