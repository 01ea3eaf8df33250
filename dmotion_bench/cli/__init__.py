"""The command ``dmbench``: parse, call, render, nothing else.

Every command lives in a file of its own; what it needs beyond the core's light modules it imports when it
runs, so that ``dmbench --help`` loads no torch.
"""

import sys

__all__ = ["main"]


def main() -> None:
    """Entry point of the ``dmbench`` script. Ctrl-C ends it without a traceback, also while it is still loading."""
    try:
        from dmotion_bench.cli.app import main as run
    except KeyboardInterrupt:
        sys.exit(130)
    run()
