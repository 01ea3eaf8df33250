"""Runs Rerun's command line and stops it as soon as the program that started it has ended.

Standard input is a pipe that the asking program holds open and never writes to: when that program ends, killed or not,
the system closes the pipe. Everything in this process's group is then killed.
"""

from __future__ import annotations

import os
import signal
import threading

from rerun_cli.__main__ import main


def _end_with_the_pipe(pipe: int) -> None:
    os.read(pipe, 1)
    os.killpg(0, signal.SIGKILL)


if __name__ == "__main__":
    held = os.dup(0)  # kept from Rerun, which gets an empty input
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    threading.Thread(target=_end_with_the_pipe, args=(held,), daemon=True).start()
    raise SystemExit(main())
