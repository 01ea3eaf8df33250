"""``python -m tests.kill``: kill commands at random moments, run them again, compare; print one JSON object."""

from __future__ import annotations

import argparse
import json
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np


def main() -> None:
    """Parse, kill, print."""
    from tests.kill.scenarios import SCENARIOS

    parser = argparse.ArgumentParser(prog="python -m tests.kill", description=__doc__)
    parser.add_argument("--kills", type=int, default=200, help="so many in all")
    parser.add_argument("--seed", type=int, default=0, help="of every moment")
    names = ", ".join(scenario.name for scenario in SCENARIOS)
    parser.add_argument("--only", action="append", default=[], help=f"only this command: {names}")
    parser.add_argument("--summary", type=Path, help="write the JSON object into this file as well")
    parser.add_argument("--keep", type=Path, help="where the workspaces of faulty rounds are kept")
    asked = parser.parse_args()
    scratch = Path(tempfile.mkdtemp(prefix="dmbench-kill-", dir="/dev/shm" if Path("/dev/shm").is_dir() else None))
    try:
        summary = kill(scratch, asked.kills, asked.seed, tuple(asked.only), asked.keep)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    text = json.dumps(summary, indent=1)
    if asked.summary:
        asked.summary.write_text(text + "\n")
    print(text)  # noqa: T201
    sys.exit(bool(summary["faults"]))


def kill(scratch: Path, kills: int, seed: int, only: tuple[str, ...], keep: Path | None) -> dict[str, Any]:
    """Rounds of all commands in turn until there were so many kills; what came of them."""
    from tests.kill.attack import attack, undisturbed
    from tests.kill.scenarios import SCENARIOS, make_base

    chosen = [scenario for scenario in SCENARIOS if not only or scenario.name in only]
    began, base = time.monotonic(), scratch / "base"
    make_base(base, chosen)
    truth = {one.name: undisturbed(one, base, scratch / "undisturbed" / str(n)) for n, one in enumerate(chosen)}
    counts: dict[str, Counter[str]] = {one.name: Counter() for one in chosen}
    faults: list[dict[str, Any]] = []
    done = number = 0
    while done < kills:
        scenario, rng = chosen[number % len(chosen)], np.random.default_rng([seed, number])
        workspace = scratch / "rounds" / str(number)
        found = attack(scenario, base, workspace, truth[scenario.name], rng)
        done += len(found.strikes)
        counts[scenario.name].update(strike.split()[0] for strike in found.strikes)
        counts[scenario.name]["rounds"] += 1
        told = {"command": scenario.name, "round": number, "strikes": found.strikes}
        faults += [told | {"fault": fault} for fault in found.faults]
        if found.faults and keep is not None:
            keep.mkdir(parents=True, exist_ok=True)
            shutil.copytree(workspace, keep / str(number), dirs_exist_ok=True)
        shutil.rmtree(workspace, ignore_errors=True)
        number += 1
        for fault in found.faults:
            print(f"{scenario.name}, {'; '.join(found.strikes)}: {fault}", file=sys.stderr)  # noqa: T201
        print(f"{done} kills, {len(faults)} faults", file=sys.stderr, flush=True)  # noqa: T201
    return {
        "seed": seed,
        "kills": done,
        "rounds": number,
        "seconds": round(time.monotonic() - began, 1),
        "commands": {name: dict(sorted(count.items())) for name, count in counts.items()},
        "undisturbed_s": {name: round(one.seconds, 2) for name, one in truth.items()},
        "faults": faults,
    }


if __name__ == "__main__":
    main()
