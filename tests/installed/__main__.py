"""``python -m tests.installed``: build, install from the package index into an empty environment, follow the road."""

from __future__ import annotations

import argparse
import sys
import tempfile
from pathlib import Path

from tests.installed.building import build
from tests.installed.environment import from_the_index
from tests.installed.road import follow


def main() -> None:
    """Print what was built and installed; raise where a command fails."""
    parser = argparse.ArgumentParser(prog="python -m tests.installed", description=__doc__)
    parser.add_argument("--python", default=sys.executable, help="the interpreter to install for")
    parser.add_argument("--without-torch", action="store_true", help="leave out torch and the commands that need it")
    chosen = parser.parse_args()
    with tempfile.TemporaryDirectory(prefix="dmbench-smoke-") as name:
        folder = Path(name)
        for part in ("built", "workspace"):
            (folder / part).mkdir()
        _, wheel = build(folder / "built")
        print(f"built {wheel.name}; installing it for {chosen.python}", flush=True)  # noqa: T201
        python = from_the_index(folder / "environment", wheel, chosen.python, without_torch=chosen.without_torch)
        follow(python, folder / "workspace", without_torch=chosen.without_torch)
    print("every command of the road ended well")  # noqa: T201


if __name__ == "__main__":
    main()
