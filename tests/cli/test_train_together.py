"""``dmbench train --devices N --nodes M`` and ``torchrun``: one result, one sentence, and nobody is left behind."""

from __future__ import annotations

import json
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from dmbench_command import Outcome, dmbench, finish, never_ending, start_dmbench
from walking_square import record_walks

from dmotion_bench.interrupts import INTERRUPTED
from dmotion_bench.learning.runs.checkpoint import load

pytestmark = pytest.mark.slow

QUICK = ("dmotion", "--device", "cpu", "--set", "batch_size=4", "--threads", "1")
SHORT, LONG = ("--set", "epochs=0.2"), ("--set", "epochs=200")
LISTENS = """
import os, sys

watched, rank = os.environ["WATCHED"], os.environ.get("RANK")
handle = os.open(os.environ["WATCHED_LOG"], os.O_WRONLY | os.O_APPEND | os.O_CREAT)

def hook(event, given):
    if event == "open" and isinstance(given[0], str) and watched in given[0]:
        os.write(handle, f"{rank} {given[1]} {given[0]}\\n".encode())

sys.addaudithook(hook)
"""


@pytest.fixture
def data(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return record_walks(tmp_path / "data" / "walk-small")


def _wait_for_steps(run: Path, process: subprocess.Popen[str]) -> None:
    deadline = time.monotonic() + 100
    while not ((run / "metrics.jsonl").is_file() and (run / "metrics.jsonl").read_text().count("\n") > 1):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.05)


def _of_rank(process: subprocess.Popen[str], rank: int) -> psutil.Process:
    children = psutil.Process(process.pid).children(recursive=True)
    return next(child for child in children if child.environ().get("RANK") == str(rank))


@pytest.mark.parametrize("ended", ["interrupted", "killed", "launcher killed"])
def test_all_end_together_and_the_run_goes_on(data: Path, tmp_path: Path, ended: str) -> None:
    words = ("train", *QUICK, *LONG, "--set", "validations=400", "--out", str(tmp_path / "run"))
    process = start_dmbench((*words, "--devices", "2"), tmp_path)
    _wait_for_steps(tmp_path / "run", process)
    both = [_of_rank(process, rank) for rank in (0, 1)]
    if ended == "interrupted":
        process.send_signal(signal.SIGINT)
    elif ended == "killed":
        both[1].kill()
    else:
        process.kill()
    outcome = finish(process)
    assert not never_ending(both)
    if ended == "interrupted":
        assert outcome.code == 130
        assert outcome.err.splitlines()[-1] == f"dmbench: {INTERRUPTED}"  # one core for two processes is said above it
    elif ended == "killed":
        assert outcome.code == 1
        assert "process 1 of the 2 that train together was killed (SIGKILL)" in outcome.sentence()
    step = load(tmp_path / "run" / "last.safetensors")[1]["step"]
    assert step > 0
    if ended != "launcher killed":  # the worst of the three; from there the run goes on
        return
    again = start_dmbench((*words, "--resume"), tmp_path)  # with one process
    time.sleep(0.1)
    while load(tmp_path / "run" / "last.safetensors")[1]["step"] <= step:
        assert again.poll() is None, again.communicate()
        time.sleep(0.1)
    again.send_signal(signal.SIGINT)
    assert finish(again).code == 130


LOSES_ANOTHER = """
import atexit

from dmotion_bench.cli import app, main
from dmotion_bench.errors import ProcessLost

def lose():
    raise ProcessLost(1)

atexit.register(print, "the end of Python")
app.register_commands = lose
print("a result", end="")
main()
"""


def test_who_has_lost_another_process_does_not_wait_for_the_end_of_python() -> None:
    """Torch's threads may hold one another up there, and the process would stay for ever."""
    done = subprocess.run([sys.executable, "-c", LOSES_ANOTHER], capture_output=True, text=True, check=False)
    assert done.returncode == 75
    assert done.stdout == "a result"
    assert done.stderr.startswith("dmbench: process 1 of this training ends because another one has ended.")


def test_others_read_what_the_first_has_finished(
    data: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Process 1 opens the checkpoint of the last sitting before the first one writes, and later no file at all."""
    (tmp_path / "hooks").mkdir()
    (tmp_path / "hooks" / "sitecustomize.py").write_text(LISTENS)
    words = ("train", *QUICK, *SHORT, "--out", str(tmp_path / "run"), "--devices", "2", "--json")
    assert dmbench((*words[:-3], "--set", "validations=2"), capsys, monkeypatch).code == 0
    manifest = json.loads((tmp_path / "run" / "run.json").read_text())
    (tmp_path / "run" / "run.json").write_text(json.dumps({**manifest, "result": None}))
    for cache in tmp_path.rglob("frames-*.arrow"):
        cache.unlink()
    log = tmp_path / "opened.txt"
    for name, value in (("PYTHONPATH", tmp_path / "hooks"), ("WATCHED", tmp_path), ("WATCHED_LOG", log)):
        monkeypatch.setenv(name, str(value))
    outcome = finish(start_dmbench((*words, "--set", "validations=2"), tmp_path))
    assert outcome.code == 0, outcome.err
    opened = [line.split(" ", 2) for line in log.read_text().splitlines()]
    own = [(rank, mode, Path(path)) for rank, mode, path in opened if Path(path).is_relative_to(tmp_path / "run")]
    assert {mode for rank, mode, _ in own if rank == "1"} == {"r"}
    writes = [place for place, (rank, mode, path) in enumerate(own) if rank == "0" and path.suffix == ".part"]
    reads = [place for place, (rank, _, path) in enumerate(own) if rank == "1" and path.suffix == ".safetensors"]
    assert reads
    checkpoints = [place for place in writes if "safetensors" in own[place][2].name]
    assert max(reads) < min(checkpoints, default=len(own))
    built = [rank for rank, mode, path in opened if "frames-" in path and path.endswith(".part") and mode == "x"]
    assert built == ["0"]


def test_torchrun_gives_the_result_once(data: Path, tmp_path: Path) -> None:
    main = "from dmotion_bench.cli import main; main()"
    words = ("train", *QUICK, *SHORT, "--out", str(tmp_path / "run"), "--json")
    run = [sys.executable, "-m", "torch.distributed.run", "--standalone", "--nproc-per-node=2", "--no-python"]
    done = subprocess.run(
        [*run, sys.executable, "-c", main, *words], capture_output=True, text=True, check=False, timeout=200
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["labels"] == 4
    assert json.loads((tmp_path / "run" / "run.json").read_text())["result"]["processes"] == 2


def test_two_machines_of_one_process_each(data: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        monkeypatch.setenv("MASTER_PORT", str(free.getsockname()[1]))
    monkeypatch.setenv("MASTER_ADDR", "127.0.0.1")
    words = ("train", *QUICK, *SHORT, "--out", str(tmp_path / "run"), "--nodes", "2", "--json")
    started = []
    for node in (0, 1):
        monkeypatch.setenv("NODE_RANK", str(node))
        started.append(start_dmbench(words, tmp_path))
    outcomes: list[Outcome] = [finish(process) for process in started]
    assert [outcome.code for outcome in outcomes] == [0, 0], outcomes
    assert outcomes[1].out == ""
    assert json.loads(outcomes[0].out)["model"] == "dmotion"
    assert json.loads((tmp_path / "run" / "run.json").read_text())["result"]["processes"] == 2


@pytest.mark.parametrize(
    ("words", "environment", "says"),
    [
        (("--devices", "5"), {}, "5 processes cannot share a batch of 4; start at most 4"),
        (("--nodes", "2"), {"MASTER_ADDR": "127.0.0.1"}, "missing here: MASTER_PORT, NODE_RANK"),
        (
            ("--nodes", "2"),
            {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": "2900", "NODE_RANK": "2"},
            "NODE_RANK is '2'; with --nodes 2 it can be 0 to 1.",
        ),
        (("--all", "--devices", "2"), {}, "leave out"),
        ((), {"WORLD_SIZE": "2"}, "the environment says that this is one of several processes, and not which"),
    ],
)
def test_what_cannot_be_costs_a_sentence(
    data: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    words: tuple[str, ...],
    environment: dict[str, str],
    says: str,
) -> None:
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    given = QUICK[1:3] if "--all" in words else QUICK
    outcome = dmbench(("train", *given, *words), capsys, monkeypatch)
    assert outcome.code == 2
    assert says in outcome.sentence()
