"""The command ``dmbench``: parse, call, render, nothing else.

Every command lives in a file of its own; what it needs beyond the core's light modules it imports when it
runs, so that ``dmbench --help`` loads no torch.
"""

import atexit
import contextlib
import io
import os
import signal
import sys

from dmotion_bench.interrupts import INTERRUPTED, ended_like_ctrl_c, exit_code

__all__ = ["main"]

SPINS = "10000"
"""How often a waiting thread looks: about 0.2 ms, longer than most pauses between the parallel parts of a step.

GNU's OpenMP, which torch ships, looks 300,000 times. Beside other work a step with two threads then takes ten times as
long as with one (docs/decisions/050-waiting-threads-give-way.md).
"""


def main() -> None:
    """Entry point of the ``dmbench`` script. Ctrl-C ends it with a sentence, also while it is still loading."""
    _open_streams()
    bound_waiting()
    if "WORLD_SIZE" in os.environ:  # one of several processes: torch would advise each of them, on stderr
        os.environ.setdefault("TORCH_CPP_LOG_LEVEL", "ERROR")
    try:
        with ended_like_ctrl_c():
            from dmotion_bench.cli.app import main as run

            run()
    except KeyboardInterrupt:
        with contextlib.suppress(OSError):
            print(f"dmbench: {INTERRUPTED}", file=sys.stderr, flush=True)  # noqa: T201
        sys.exit(exit_code())
    finally:  # all is done or told: while libraries tidy up, Ctrl-C could only show a traceback of theirs
        atexit.register(signal.signal, signal.SIGINT, signal.SIG_IGN)


def bound_waiting() -> None:
    """See that torch's threads wait for each other for a moment only, and then leave their core to other work.

    OpenMP reads this when torch loads. A variable that is set already decides instead.
    """
    if not {"GOMP_SPINCOUNT", "OMP_WAIT_POLICY"} & os.environ.keys():
        os.environ["GOMP_SPINCOUNT"] = SPINS


def _open_streams() -> None:
    """See that everything can be printed.

    Closed streams (``2>&-``) are opened on /dev/null; else the next file that is opened would take the stream's number.
    A character that stdout's encoding lacks, such as ± in ASCII, becomes a question mark; stderr, where an error ends,
    has its escape sequence in Python already.
    """
    for number, name in enumerate(("stdin", "stdout", "stderr")):
        try:
            os.fstat(number)
        except OSError:
            os.set_inheritable(os.open(os.devnull, os.O_RDWR), True)  # the lowest number that is free: this one
        if getattr(sys, name) is None:
            setattr(sys, name, os.fdopen(number, "r" if number == 0 else "w", closefd=False))
    if isinstance(sys.stdout, io.TextIOWrapper):
        sys.stdout.reconfigure(errors="replace")
