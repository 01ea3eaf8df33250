"""What a new user does, in an empty folder: record, train, score, view, play, plan, leaderboard."""

from __future__ import annotations

import os
import pty
import subprocess
from pathlib import Path

RUN = "dmotion-grid_world-tiny-epochs_0.2-s0"
WITHOUT_TORCH = (
    ("record", "grid_world", "--preset", "tiny", "--tasks", "2"),
    ("record", "push_t", "--preset", "tiny", "--episodes", "2", "--tasks", "0"),
    ("data", "check", "grid_world-tiny"),
    ("list", "environments"),
    ("list", "models"),
)
WITH_TORCH = (
    ("view", "grid_world-tiny", "--save", "data.rrd"),
    ("train", "dmotion", "--data", "grid_world-tiny", "--set", "epochs=0.2"),
    ("score", RUN, "--metrics", "prediction", "--horizon", "4"),
    ("view", RUN, "--save", "run.rrd"),
    ("play", RUN, "--save", "play.rrd"),
    ("plan", RUN, "--steps", "2", "--save", "plan.rrd"),
    ("leaderboard", "build", "--out", "site"),
    ("leaderboard", "check", "site/entries"),
)
KEYS = b"\x1b[A\x1b[Cq"
"""Up, right, and leave: what is typed to 'play'."""

TYPED_IN_ONE_PROCESS = """
import ast, sys
from dmotion_bench.cli import main

for words in ast.literal_eval(sys.argv[1]):
    sys.argv = ["dmbench", *words]
    try:
        main()
    except SystemExit as end:
        if end.code:
            raise
"""
"""Runs commands of dmbench that load torch, which takes longer than what they do."""

IMPORT_EVERYTHING = """
import importlib, pkgutil, sys
import dmotion_bench
assert dmotion_bench.__path__[0].startswith(sys.prefix), dmotion_bench.__path__
names = [found.name for found in pkgutil.walk_packages(dmotion_bench.__path__, "dmotion_bench.")]
for name in names:
    if not name.endswith("__main__"):
        importlib.import_module(name)
assert not {"recorders", "baselines", "leaderboard"} & set(sys.modules)
print(len(names))
"""


def follow(python: Path, folder: Path, *, without_torch: bool = False) -> None:
    """Type the commands of the road one after the other.

    Args:
        python: The interpreter of the environment.
        folder: An empty folder.
        without_torch: Leave out what needs torch.
    """
    for words in WITHOUT_TORCH:
        dmbench(python, folder, *words)
    if not without_torch:
        run([str(python), "-c", TYPED_IN_ONE_PROCESS, repr(WITH_TORCH)], folder)


def dmbench(python: Path, folder: Path, *words: str) -> str:
    """What a command prints; a failure says what the command said."""
    return run([str(python.with_name("dmbench")), *words], folder)


def run(words: list[str], folder: Path) -> str:
    """What a program prints that knows nothing of this source tree."""
    kept = ("PATH", "HOME", "LANG", "TMPDIR")
    environment = {name: os.environ[name] for name in kept if name in os.environ}
    environment |= {"DMBENCH_QUIET": "1", "OMP_NUM_THREADS": "1"}
    controller, terminal = pty.openpty()
    try:
        os.write(controller, KEYS)
        done = subprocess.run(
            words, cwd=folder, env=environment, stdin=terminal, capture_output=True, text=True, check=False, timeout=300
        )
    finally:
        os.close(terminal)
        os.close(controller)
    assert done.returncode == 0, f"{' '.join(words)}\n{done.stderr}"
    return done.stdout
