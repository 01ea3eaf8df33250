"""How many processes there is room for, in a container and beside other work."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from dmotion_bench.execution import available
from dmotion_bench.execution.available import available_workers

GIGABYTE = 2**30


@pytest.fixture
def system(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A machine of 16 processors with 64 GiB of free memory, and this process in the group /job/step."""
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(16)), raising=False)
    monkeypatch.setattr(available, "_PROC", tmp_path / "proc")
    monkeypatch.setattr(available, "_GROUPS", tmp_path / "groups")
    (tmp_path / "proc" / "self").mkdir(parents=True)
    (tmp_path / "proc" / "meminfo").write_text(f"MemTotal: 1 kB\nMemAvailable: {64 * 2**20} kB\n")
    (tmp_path / "proc" / "self" / "cgroup").write_text("1:cpu:/elsewhere\n0::/job/step\n")
    (tmp_path / "groups" / "job" / "step").mkdir(parents=True)
    return tmp_path


def _grant(group: Path, *, processors: str = "max 100000", memory: str = "max", used: int = 0, cached: int = 0) -> None:
    (group / "cpu.max").write_text(processors + "\n")
    (group / "memory.max").write_text(memory + "\n")
    (group / "memory.current").write_text(f"{used}\n")
    (group / "memory.stat").write_text(f"anon 5\ninactive_file {cached}\n")


@pytest.mark.usefixtures("system")
def test_without_bounds_all_of_the_machine_is_there() -> None:
    assert available_workers() == 16
    assert available_workers(gigabytes=8) == 8


def test_a_group_without_bounds_changes_nothing(system: Path) -> None:
    _grant(system / "groups" / "job" / "step")
    assert available_workers(gigabytes=8) == 8


def test_a_containers_processors_are_not_the_machines(system: Path) -> None:
    _grant(system / "groups" / "job" / "step", processors="250000 100000")
    assert available_workers() == 2
    _grant(system / "groups" / "job" / "step", processors="50000 100000")
    assert available_workers() == 1


def test_a_group_is_within_the_bounds_of_those_above_it(system: Path) -> None:
    _grant(system / "groups" / "job", processors="300000 100000")
    _grant(system / "groups" / "job" / "step", processors="800000 100000")
    assert available_workers() == 3


def test_a_containers_memory_counts_with_what_it_would_give_back(system: Path) -> None:
    step = system / "groups" / "job" / "step"
    _grant(step, memory=str(8 * GIGABYTE), used=6 * GIGABYTE, cached=2 * GIGABYTE)
    assert available_workers(gigabytes=1) == 4
    _grant(step, memory=str(8 * GIGABYTE), used=9 * GIGABYTE)
    assert available_workers(gigabytes=1) == 1


@pytest.mark.parametrize("text", ["", "max\n", "1 0\n", "one two\n"])
def test_what_cannot_be_read_is_no_bound(system: Path, text: str) -> None:
    for name in ("cpu.max", "memory.max", "memory.current", "memory.stat"):
        (system / "groups" / "job" / "step" / name).write_text(text)
    assert available_workers(gigabytes=8) == 8


def test_where_the_system_says_nothing_processors_alone_count(system: Path) -> None:
    (system / "proc" / "self" / "cgroup").unlink()
    (system / "proc" / "meminfo").unlink()
    assert available_workers(gigabytes=1000) == 16
