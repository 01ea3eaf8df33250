"""Half a minute of the fuzzer finds nothing; with faults planted it finds each of them."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, ClassVar

import pytest

from dmotion_bench.errors import DatasetCorrupt
from tests.fuzz import child
from tests.fuzz.case import Case, Fault, Probe
from tests.fuzz.targets import Target

ROOT = Path(__file__).parents[2]
CASES = 120  # half a minute; always the same ones, whatever else the machine does

PLANTED = """
import sys
from dmotion_bench.errors import DatasetError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.frame_cache import Mapped
from tests.fuzz import __main__, child

def spoilt(name, instead):
    right = getattr(Dataset, name)
    def wrong(self, *given):
        try:
            return right(self, *given)
        except DatasetError:
            return instead()
    setattr(Dataset, name, wrong)

def forget():
    raise KeyError("forgotten")

def wait():
    while True:
        pass

def take_much():
    taken.append(b"x" * (300 << 20) if not taken else b"")

taken = []
child.CPU_S, child.MEMORY = 2, 256 << 20  # a slow machine takes that much memory in a second
spoilt("labels", forget)
spoilt("tasks", wait)
spoilt("video", take_much)
Mapped.is_sound = lambda self, place: True
__main__.main()
"""


def _fuzz(command: tuple[str, ...], words: tuple[str, ...], folder: Path) -> tuple[int, dict[str, Any]]:
    """The exit code of the fuzzer and what it printed."""
    done = subprocess.run(
        [sys.executable, *command, *words, "--keep", str(folder)],
        cwd=ROOT,
        capture_output=True,
        text=True,
        check=False,
        timeout=900,
    )
    assert done.returncode in (0, 1), done.stderr
    assert done.stdout, done.stderr
    return done.returncode, json.loads(done.stdout)


@pytest.mark.slow
def test_half_a_minute_of_fuzzing_finds_nothing(tmp_path: Path) -> None:
    code, said = _fuzz(("-m", "tests.fuzz"), ("--cases", str(CASES), "--seed", "22"), tmp_path)
    assert said["faults"] == {}
    assert code == 0
    targets = ("dataset", "recording", "run", "entry", "share", "remote")
    assert all(sum(said["verdicts"][name].values()) > 0 for name in targets)


@pytest.mark.slow
def test_faults_that_are_planted_in_dmbench_are_found(tmp_path: Path) -> None:
    code, said = _fuzz(("-c", PLANTED), ("--cases", "40", "--only", "dataset", "--seed", "5"), tmp_path)
    assert code == 1
    found = " ".join(said["faults"])
    assert "KeyError" in found
    assert "hang" in found
    assert "memory" in found
    assert "wrong content at cache differs" in found
    kept = json.loads(next(tmp_path.glob("*.json")).read_text())
    assert kept["again"] == f"python -m tests.fuzz --seed 5 --only dataset --case {kept['number']}"
    assert (tmp_path / f"case-{kept['number']}" / "data").is_dir()


class Trap(Target):
    """Something that does as it is told when it is asked."""

    name: ClassVar[str] = "trap"
    share: ClassVar[int] = 1

    def __init__(self, ask: Callable[[], Any]) -> None:
        super().__init__(Path("nowhere"))
        self.ask = ask

    def make(self) -> None:
        """Nothing is needed."""

    def names(self) -> list[str]:
        return []

    def spoil(self, case: Case) -> None:
        case.tell("dataset.json", "gone")

    def intact(self, case: Case, name: str) -> None:
        """There is no original."""

    def probes(self, case: Case, spoilt: None) -> Iterator[Probe]:
        yield Probe("ask", self.ask)

    def judge(self, case: Case, spoilt: None, answers: Any, reference: Any) -> Iterator[tuple[str, str]]:
        if "ask" in answers and answers["ask"].value == "'wrong'":
            yield "wrong content", "the answer is wrong"


def _result(ask: Callable[[], Any], tmp_path: Path) -> child.Result:
    case = Case(number=1, seed=0, target="trap", folder=tmp_path / "case")
    return child.run_case(case, Trap(ask), {})


def _kinds(ask: Callable[[], Any], tmp_path: Path) -> list[str]:
    result = _result(ask, tmp_path)
    assert (result.verdict == "fault") == bool(result.faults)
    return [fault["fault"] for fault in result.faults]


def _raise(error: Exception) -> Any:
    raise error


def _loop() -> None:
    while True:
        pass


def _sleep() -> None:
    import time

    time.sleep(60)


def _crash() -> None:
    import os

    os.abort()


def test_values_and_sentences_are_no_faults(tmp_path: Path) -> None:
    answered = _result(lambda: {"frames": [1, 2]}, tmp_path)
    refused = _result(lambda: _raise(DatasetCorrupt("it is damaged; make it anew.")), tmp_path)
    absent = _result(lambda: (tmp_path / "absent").read_bytes(), tmp_path)
    assert [one.verdict for one in (answered, refused, absent)] == ["ok", "sentence", "sentence"]
    assert refused.answers["ask"].sentence == "it is damaged; make it anew."
    assert refused.formats == ["JSON"]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ask", "kind"),
    [
        (lambda: {}["absent"], "KeyError"),
        (lambda: _raise(OSError("of no file")), "OSError"),
        (lambda: _raise(DatasetCorrupt(" ")), "no sentence"),
        (lambda: _raise(Fault("exit code", "-11")), "exit code"),
        (lambda: "wrong", "wrong content"),
        (_loop, "hang"),
        (_sleep, "hang"),
        (_crash, "crash SIGABRT"),
    ],
    ids=lambda one: one if isinstance(one, str) else "",
)
def test_a_fault_is_told_by_its_kind(
    ask: Callable[[], Any], kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(child, "CPU_S", 1)
    monkeypatch.setattr(child, "WALL_S", 5)
    assert _kinds(ask, tmp_path) == [kind]


@pytest.mark.slow
def test_too_much_memory_is_a_fault_and_a_little_less_is_none(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "MEMORY", 256 << 20)
    assert _kinds(lambda: bool(bytearray(b"x" * (400 << 20))), tmp_path) == ["memory"]
    assert _kinds(lambda: bool(bytearray(b"x" * (50 << 20))), tmp_path) == []


@pytest.mark.slow
def test_the_memory_of_a_process_that_is_started_counts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(child, "MEMORY", 1400 << 20)
    source = "import sys; b'x' * (int(sys.argv[1]) << 20)"

    def start(size: int) -> bool:
        return subprocess.run([sys.executable, "-c", source, str(size)], check=True).returncode == 0

    assert _kinds(lambda: start(1500), tmp_path) == ["memory"]
    assert _kinds(lambda: start(1000), tmp_path) == []
