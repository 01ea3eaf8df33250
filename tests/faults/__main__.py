"""Apply each deliberate fault to a copy of the repository and see whether a test notices: ``python -m tests.faults``.

Prints a line a fault; the exit code is 1 if a fault goes unnoticed, 2 if tests fail without any.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterable
from pathlib import Path

from tests.faults.catalogue import FAULTS, Fault

ROOT = Path(__file__).resolve().parents[2]
COPIED = ("dmotion_bench", "recorders", "baselines", "leaderboard", "tests", "docs", "pyproject.toml")


def fails(tests: Iterable[str], copy: Path) -> bool:
    """Whether one of the tests fails in the copy.

    Raises:
        RuntimeError: They could not be run.
    """
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider", *tests],
        cwd=copy,
        env=os.environ | {"PYTHONPATH": str(copy), "PYTHONDONTWRITEBYTECODE": "1"},
        capture_output=True,
        text=True,
        check=False,
    )
    if done.returncode not in (0, 1):
        raise RuntimeError(f"pytest could not run {tests}:\n{done.stdout[-2000:]}{done.stderr[-2000:]}")
    return done.returncode == 1


def is_noticed(fault: Fault, copy: Path) -> bool:
    """Whether one of the fault's tests fails; the copy is mended again."""
    file = copy / fault.file
    right = file.read_text()
    file.write_text(right.replace(fault.right, fault.wrong))
    try:
        return fails(fault.tests, copy)
    finally:
        file.write_text(right)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--only", default="", help="faults whose name holds this text")
    only = parser.parse_args().only
    unnoticed = 0
    with tempfile.TemporaryDirectory(prefix="dmbench-faults-") as folder:
        copy = Path(folder)
        for name in COPIED:
            source = ROOT / name
            (shutil.copytree if source.is_dir() else shutil.copy2)(source, copy / name)
        faults = [fault for fault in FAULTS if only in fault.name]
        if fails(sorted({test for fault in faults for test in fault.tests}), copy):
            print("the tests fail without any fault: run 'make test' first")  # noqa: T201
            return 2
        for fault in faults:
            began = time.monotonic()
            noticed = is_noticed(fault, copy)
            unnoticed += not noticed
            print(f"{'noticed' if noticed else 'MISSED '}  {time.monotonic() - began:5.1f} s  {fault.name}", flush=True)  # noqa: T201
    return 1 if unnoticed else 0


if __name__ == "__main__":
    raise SystemExit(main())
