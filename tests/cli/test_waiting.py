"""How long torch's threads wait for each other in a command, as OpenMP itself says when torch loads."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dmotion_bench.cli import SPINS


@pytest.mark.slow
@pytest.mark.parametrize(
    ("given", "spins"), [({}, SPINS), ({"GOMP_SPINCOUNT": "77"}, "77"), ({"OMP_WAIT_POLICY": "PASSIVE"}, "0")]
)
def test_waiting_threads_give_way_unless_a_variable_says_otherwise(
    given: dict[str, str], spins: str, tmp_path: Path
) -> None:
    own = {name: value for name, value in os.environ.items() if name not in ("GOMP_SPINCOUNT", "OMP_WAIT_POLICY")}
    told = subprocess.run(
        [sys.executable, "-c", "from dmotion_bench.cli import main; main()", "bench", "--only", "no such speed"],
        env=own | {"OMP_DISPLAY_ENV": "VERBOSE", "DMBENCH_WORKSPACE": str(tmp_path)} | given,
        capture_output=True,
        text=True,
        check=False,
    ).stderr
    if "GOMP_SPINCOUNT" not in told:
        pytest.skip("this torch waits with another OpenMP than GNU's")
    assert re.findall(r"GOMP_SPINCOUNT = '(\d+)'", told) == [spins]
    assert "no speed named 'no such speed'" in told
