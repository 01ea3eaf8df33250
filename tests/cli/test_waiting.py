"""How long torch's threads wait for each other in a command, as OpenMP itself says when torch loads."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

from dmotion_bench.cli import SPINS, bound_waiting

VARIABLES = {"GOMP_SPINCOUNT": "77", "OMP_WAIT_POLICY": "PASSIVE"}


@pytest.mark.slow
def test_waiting_threads_give_way(tmp_path: Path) -> None:
    own = {name: value for name, value in os.environ.items() if name not in VARIABLES}
    told = subprocess.run(
        [sys.executable, "-c", "from dmotion_bench.cli import main; main()", "bench", "--only", "no such speed"],
        env=own | {"OMP_DISPLAY_ENV": "VERBOSE", "DMBENCH_WORKSPACE": str(tmp_path)},
        capture_output=True,
        text=True,
        check=False,
    ).stderr
    if "GOMP_SPINCOUNT" not in told:
        pytest.skip("this torch waits with another OpenMP than GNU's")
    assert re.findall(r"GOMP_SPINCOUNT = '(\d+)'", told) == [SPINS]
    assert "no speed named 'no such speed'" in told


@pytest.mark.parametrize("name", VARIABLES)
def test_a_variable_that_is_set_decides_instead(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    for one in VARIABLES:
        monkeypatch.delenv(one, raising=False)
    monkeypatch.setenv(name, VARIABLES[name])
    bound_waiting()
    assert {one: os.environ[one] for one in VARIABLES if one in os.environ} == {name: VARIABLES[name]}
