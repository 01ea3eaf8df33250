"""The command ``dmbench``: parse, call, render, nothing else.

Every command lives in a file of its own; what it needs beyond the core's light modules it imports when it
runs, so that ``dmbench --help`` loads no torch.
"""

from dmotion_bench.cli.app import app, main

__all__ = ["app", "main"]
