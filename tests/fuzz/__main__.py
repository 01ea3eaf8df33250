"""``python -m tests.fuzz``: spoil files, see what dmbench makes of them, print one JSON object."""

from __future__ import annotations

import argparse
import itertools
import json
import os
import shutil
import sys
from pathlib import Path


def main() -> None:
    """Parse, run, print."""
    parser = argparse.ArgumentParser(prog="python -m tests.fuzz", description=__doc__)
    parser.add_argument("--cases", type=int, help="so many cases; without it until --seconds are over")
    parser.add_argument("--seconds", type=float, help="stop after so many seconds")
    parser.add_argument("--seed", type=int, default=0, help="of all cases")
    parser.add_argument("--first", type=int, default=0, help="number of the first case")
    parser.add_argument(
        "--only", action="append", default=[], help="only this target: dataset, recording, run, entry, share"
    )
    parser.add_argument("--case", type=int, help="this case alone, with all that is known of it")
    parser.add_argument("--jobs", type=int, default=1, help="cases at a time; changes none of them")
    parser.add_argument("--keep", type=Path, default=Path("fuzz-faults"), help="where faulty inputs are kept")
    parser.add_argument("--summary", type=Path, help="write the JSON object into this file as well")
    asked = parser.parse_args()

    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"  # before anything is loaded: a forked process has one thread

    from tests.fuzz.campaign import Campaign, run_side_by_side, scratch_folder, target_of
    from tests.fuzz.warm import load_all

    scratch = scratch_folder()
    load_all(scratch / "site")
    try:
        only = tuple(asked.only) or (() if asked.case is None else (target_of(asked.case),))
        campaign = Campaign(scratch, asked.seed, only)
        if asked.case is not None:
            result = campaign.run(asked.case)
            if result.faults:
                campaign.keep(result, asked.keep)
            print(json.dumps(result.to_json(), indent=1, default=str))  # noqa: T201
            sys.exit(bool(result.faults))
        numbers = itertools.count(asked.first)
        if asked.cases is not None:
            wanted = (number for number in numbers if target_of(number) in campaign.targets)
            numbers = itertools.islice(wanted, asked.cases)
        summary = run_side_by_side(campaign, numbers, jobs=asked.jobs, seconds=asked.seconds, keep=asked.keep)
    finally:
        shutil.rmtree(scratch, ignore_errors=True)
    text = json.dumps(summary.to_json(), indent=1)
    if asked.summary:
        asked.summary.write_text(text + "\n")
    print(text)  # noqa: T201
    sys.exit(bool(summary.faults))


if __name__ == "__main__":
    main()
