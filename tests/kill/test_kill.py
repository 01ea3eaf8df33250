"""Some kills of the quickest commands change nothing; a command that a kill does change is found."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from tests.kill.attack import Round, attack, undisturbed
from tests.kill.contents import files
from tests.kill.scenarios import Scenario

ROOT = Path(__file__).parents[2]


@pytest.mark.slow
def test_a_few_kills_change_nothing() -> None:
    only = ("--only", "record", "--only", "extend", "--only", "import")
    done = subprocess.run(
        [sys.executable, "-m", "tests.kill", "--kills", "6", "--seed", "22", *only],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert done.returncode in (0, 1), done.stderr
    said = json.loads(done.stdout)
    assert said["faults"] == []
    assert said["kills"] >= 6
    assert done.returncode == 0


WHOLE = """
import os, pathlib, signal, sys, time

def stop(number, _):
    part.unlink(missing_ok=True)
    sys.stderr.write("dmbench: interrupted; the same command goes on.\\n")
    sys.exit(128 + number)

part, place = pathlib.Path("out/x.part"), pathlib.Path("out/x")
signal.signal(signal.SIGTERM, stop)
signal.signal(signal.SIGINT, stop)
part.parent.mkdir(exist_ok=True)
part.unlink(missing_ok=True)
for number in range(5):
    with part.open("a") as file:
        file.write(f"{number}\\n")
    time.sleep(0.05)
part.replace(place)
"""
"""A command that comes to the same whenever it is killed."""

SAYS = 'sys.stderr.write("dmbench: interrupted; the same command goes on.\\n")'
LEAVES_A_CHILD = "if not os.fork():\n    time.sleep(5)\n    os._exit(0)\nfor number"
PLANTED = {
    "differs from the undisturbed outcome: out/x": ("part.unlink(missing_ok=True)\nfor", "for"),
    "other files than undisturbed: out/x.": ('pathlib.Path("out/x.part")', 'pathlib.Path(f"out/x.{os.getpid()}.part")'),
    "'Traceback' on stderr after SIGTERM": (SAYS, "1 / 0"),
    "exit code 1 after SIGTERM": ("sys.exit(128 + number)", "sys.exit(1)"),
    "not a word after SIGTERM": (SAYS, "pass"),
    "processes of the command are left": ("for number", LEAVES_A_CHILD),
    "started again, it fails with 1": ("part.unlink(missing_ok=True)\nfor", "assert not part.exists()\nfor"),
}
"""What is to be said of each mistake, and the mistake: the right text and the wrong one."""


def _rounds(source: str, tmp_path: Path, *, until: Callable[[Round], bool], at_most: int = 10) -> list[Round]:
    """Rounds of kills of a command, until one has what is looked for."""
    command = Scenario(
        name="a small command",
        words=(sys.executable, "-c", source),
        needs=(),
        outcome=lambda workspace: files(workspace, "out"),
    )
    truth = undisturbed(command, tmp_path, tmp_path / "undisturbed")
    found: list[Round] = []
    for number in range(at_most):
        found.append(attack(command, tmp_path, tmp_path / str(number), truth, np.random.default_rng([0, number])))
        if until(found[-1]):
            break
    return found


@pytest.mark.slow
def test_a_command_that_always_comes_to_the_same_has_no_fault(tmp_path: Path) -> None:
    seen: list[str] = []

    def enough(one: Round) -> bool:  # on a busy machine many a strike comes when the command has ended
        seen.extend(strike.split()[0] for strike in one.strikes)
        return len(seen) >= 10 and {"SIGKILL", "SIGTERM"} <= {*seen}

    rounds = _rounds(WHOLE, tmp_path, until=enough, at_most=60)
    assert [one.faults for one in rounds] == [[]] * len(rounds)
    assert {"SIGKILL", "SIGTERM"} <= {*seen}


@pytest.mark.slow
@pytest.mark.parametrize("said", PLANTED)
def test_a_mistake_that_is_planted_is_found(said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("tests.kill.attack.ORPHANS", 0.5)
    right, wrong = PLANTED[said]
    assert WHOLE.count(right) == 1

    def found(one: Round) -> bool:
        return any(said in fault for fault in one.faults)

    rounds = _rounds(WHOLE.replace(right, wrong), tmp_path, until=found, at_most=20)
    assert found(rounds[-1]), [one.faults for one in rounds]
