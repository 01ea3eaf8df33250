"""Entries that are checked beside each other get the verdicts of entries that are checked in turn."""

from __future__ import annotations

import signal
import time
from pathlib import Path
from typing import Any

import psutil
import pytest
from dmbench_command import dmbench, finish, never_ending, start_dmbench
from mortal_workers import Deadly, Losing
from pretend_slurm import use_slurm

from dmotion_bench.errors import UnknownName
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.interrupts import INTERRUPTED
from dmotion_bench.scoring.references import published_results
from dmotion_bench.workspace import Workspace
from leaderboard import check
from leaderboard.check import check_paths
from leaderboard.entry import Entry, published_entry
from leaderboard.entry_file import write_entry
from leaderboard.paper import label_count

pytestmark = pytest.mark.slow


@pytest.fixture
def entries(tmp_path: Path, sound: Entry) -> Path:
    """Published rows, one of them with a wrong source, an entry whose run is elsewhere, and a file that is none."""
    folder = tmp_path / "entries"
    folder.mkdir()
    for number, row in enumerate(published_results()[:4]):
        content = dict(published_entry(row, label_count(row.environment, row.labels)).content)
        written = write_entry(Entry(content | ({"source": "me"} if number == 2 else {})), folder)
        written.rename(folder / f"row-{number}.json")
    write_entry(sound, folder).rename(folder / "far-away.json")
    (folder / "nothing.json").write_text("{")
    return folder


@pytest.mark.parametrize("name", ["local", "slurm"])
def test_a_killed_worker_changes_no_verdict(
    entries: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, name: str
) -> None:
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent.parent))
    if name == "slurm":
        use_slurm(tmp_path / "slurm", monkeypatch)
    nowhere, counted = Workspace(tmp_path / "nowhere"), list[tuple[int, int]]()
    in_turn = check_paths([entries], nowhere)
    executor = Deadly(make_executor(name, 2, tmp_path / "scratch"), tmp_path / "died")
    found = check_paths([entries], nowhere, executor=executor, on_verdict=lambda *told: counted.append(told))
    assert (tmp_path / "died").exists()
    assert found == in_turn
    assert [bool(verdict.findings) for verdict in found] == [False, True, False, False, True, False]
    assert [verdict.holds for verdict in found] == [False, False, True, True, False, True]
    assert counted == [(done, 6) for done in range(7)]


def test_an_entry_whose_job_is_lost_is_not_checked(entries: Path, tmp_path: Path) -> None:
    found = check_paths([entries], Workspace(tmp_path / "nowhere"), executor=Losing())
    in_turn = check_paths([entries], Workspace(tmp_path / "nowhere"))
    assert (found[0].findings, found[0].missing) == ((), ("a worker was killed.",))
    assert found[1:] == in_turn[1:]


def test_jobs_say_how_far_they_are(entries: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    seen: list[str] = []

    def slow(*_: Any, how: Any, **__: Any) -> Any:
        time.sleep(0.6)
        how.progress("scoring", 1, 4)
        seen.extend(path.read_text() for path in tmp_path.glob("check-*.json"))
        raise UnknownName("thing", "a", ["b"])

    monkeypatch.setattr(check, "check_entry", slow)
    (verdict,) = check_paths([entries / "row-1.json"], Workspace(tmp_path), progress=tmp_path)
    assert "no thing named 'a'" in verdict.findings[0]
    assert '"what": "row-1", "done": 1, "total": 4, "status": "scoring"' in seen[0]
    assert not list(tmp_path.glob("check-*.json"))


def test_ctrl_c_ends_all_and_says_how_to_go_on(entries: Path, tmp_path: Path, sound: Entry) -> None:
    for number in range(60):  # enough that they are not all checked before Ctrl-C comes
        write_entry(sound, entries).rename(entries / f"more-{number}.json")
    process = start_dmbench(("leaderboard", "check", str(entries), "--workers", "2"), tmp_path)
    children: list[psutil.Process] = []
    while len(children) < 3:  # two workers, and what tracks their resources
        assert process.poll() is None, process.communicate()
        children = psutil.Process(process.pid).children(recursive=True)
        time.sleep(0.01)
    process.send_signal(signal.SIGINT)
    outcome = finish(process)
    assert outcome.code == 130
    assert "of 66 entries; the same command checks all of them again" in outcome.sentence()
    assert not never_ending(children)


def test_ctrl_c_before_entries_are_counted_names_no_number(
    entries: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("dmotion_bench.api.leaderboard.leaderboard_check", interrupted)
    outcome = dmbench(("leaderboard", "check", str(entries), "--workers", "2"), capsys, monkeypatch)
    assert (outcome.code, outcome.sentence()) == (130, f"dmbench: {INTERRUPTED}\n")


def test_the_command_says_the_same_for_any_workers(
    entries: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("leaderboard", "check", str(entries), "--json")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    alone, beside = (dmbench((*words, *more), capsys, monkeypatch) for more in ((), ("--workers", "2")))
    ray = finish(start_dmbench((*words, "--workers", "2", "--executor", "ray"), tmp_path), seconds=300)
    assert alone == beside
    assert (alone.code, alone.out) == (ray.code, ray.out)
    assert alone.code == 1
    assert not list(tmp_path.glob(".jobs-*"))


def test_entries_that_call_themselves_the_same_are_told_apart_by_their_files(
    sound: Entry, changed: Any, tmp_path: Path
) -> None:
    folder = tmp_path / "entries"
    for number, entry in enumerate((sound, changed(seed=5), changed(run="another"))):
        write_entry(entry, folder).rename(folder / f"sent-{number}.json")
    names = [verdict.entry for verdict in check_paths([folder], Workspace(tmp_path / "nowhere"))]
    assert names == [f"{sound.name}, sent-0.json", f"{sound.name}, sent-1.json", "another"]
