"""How long Ray runs, with a pretended Ray; ``test_executors.py`` runs jobs on a real one."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from dmotion_bench.errors import DmbenchError
from dmotion_bench.execution import ray_executor
from dmotion_bench.execution.executor import JobSize
from dmotion_bench.execution.ray_executor import RayExecutor


class PretendRay:
    """Does a task when it is asked for its result."""

    exceptions = SimpleNamespace(
        **{
            name: type(name, (Exception,), {})
            for name in (
                *("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"),
                *("TaskCancelledError", "RayTaskError", "GetTimeoutError"),
            )
        }
    )

    def __init__(self) -> None:
        self.events: list[str] = []
        self.running = False
        self.processors = 2
        self.silent = 0  # of how many starts no worker answers

    def init(self, **options: Any) -> None:
        self.events.append("started")
        self.running, self.processors = True, options["num_cpus"]

    def shutdown(self) -> None:
        self.events.append("stopped")
        self.running = False

    def is_initialized(self) -> bool:
        return self.running

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": self.processors}

    def nodes(self) -> list[dict[str, Any]]:
        return [{"Alive": True, "Resources": {"CPU": self.processors}}, {"Alive": False, "Resources": {"CPU": 64}}]

    def remote(self, **options: Any) -> Callable[[Callable[[Any], Any]], Any]:
        return lambda function: SimpleNamespace(remote=lambda *job: (function, job))

    def wait(self, tasks: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        return tasks[:1], tasks[1:]

    def get(self, task: Any, timeout: float | None = None) -> Any:
        if timeout and self.events.count("started") <= self.silent:
            raise self.exceptions.GetTimeoutError
        if not timeout:
            self.events.append("a job")
        return task[0](*task[1])


@pytest.fixture
def ray(monkeypatch: pytest.MonkeyPatch) -> PretendRay:
    monkeypatch.setitem(sys.modules, "ray", pretended := PretendRay())  # type: ignore[arg-type]
    monkeypatch.delenv("RAY_ADDRESS", raising=False)
    return pretended


def test_one_ray_serves_all_that_an_executor_is_asked_for(ray: PretendRay) -> None:
    executor = RayExecutor(2)
    assert list(executor.map_unordered(str, [])) == []
    assert ray.events == []  # nothing to start it for
    assert [list(executor.map_unordered(abs, [-1])), list(executor.map_unordered(abs, [-2]))] == [[1], [2]]
    assert ray.events == ["started", "a job", "a job"]
    del executor
    assert ray.events[-1] == "stopped"


def test_a_ray_that_runs_already_is_left_running(ray: PretendRay) -> None:
    ray.running = True
    assert list(RayExecutor(2).map_unordered(abs, [-1])) == [1]
    assert ray.events == ["a job"]


@pytest.mark.parametrize(("workers", "most"), [(1, 1), (3, 3), (None, 3)])
def test_as_many_jobs_are_given_to_ray_as_were_asked_for(
    ray: PretendRay, monkeypatch: pytest.MonkeyPatch, workers: int | None, most: int
) -> None:
    """A cluster has room for more; without a number one job waits beside those for which there are processors."""
    given: list[int] = []
    waited = ray.wait
    monkeypatch.setattr(ray, "wait", lambda tasks, num_returns: given.append(len(tasks)) or waited(tasks, num_returns))
    ray.running = True
    assert len(list(RayExecutor(workers).map_unordered(abs, range(8)))) == 8
    assert max(given) == most


def cache_of_worker(_job: int) -> str | None:
    return os.environ.get("DMBENCH_CACHE")


def test_workers_of_a_ray_that_runs_already_take_the_cache_of_the_command(
    ray: PretendRay, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ray.running = True
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DMBENCH_CACHE", "frames")
    found = RayExecutor(1).map_unordered(cache_of_worker, [1, 2])
    pretended = ray.get

    def get(task: Any) -> Any:  # it runs already, so nothing is asked of it first
        monkeypatch.delenv("DMBENCH_CACHE")  # as in a worker of an earlier Ray
        return pretended(task)

    monkeypatch.setattr(ray, "get", get)
    assert list(found) == [str(tmp_path / "frames")] * 2


class OfTwo(Exception):
    def __init__(self, what: str, motor: int) -> None:
        super().__init__(f"{what} (motor {motor})")


def raises_what_cannot_be_sent(_job: int) -> None:
    raise OfTwo("the arm is stuck", 3)


def test_what_cannot_be_sent_to_the_command_arrives_as_its_text(ray: PretendRay) -> None:
    """Ray would say that its own system failed: it cannot read such an exception."""
    with pytest.raises(RuntimeError, match=r"OfTwo: the arm is stuck \(motor 3\)"):
        list(RayExecutor(1).map_unordered(raises_what_cannot_be_sent, [1]))


def test_a_ray_of_this_machine_can_run_what_is_asked_for(ray: PretendRay, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_executor, "available_workers", lambda: 2)
    assert list(RayExecutor(size=JobSize(processors=8)).map_unordered(abs, [-1])) == [1]
    assert ray.processors == 8
    ray.running = False
    with pytest.raises(DmbenchError, match="each job asks for 1 GPU, and Ray finds 0 on this machine"):
        list(RayExecutor(size=JobSize(gpus=1)).map_unordered(abs, [-1]))


@pytest.mark.parametrize(
    ("size", "told"),
    [
        (JobSize(processors=2), ""),
        (JobSize(processors=4), "has the 4 processors that each job"),
        (JobSize(gpus=1), "has the 1 processor and 1 GPU that each job"),
    ],
)
def test_jobs_that_no_machine_of_a_running_ray_can_do_are_told_of(
    ray: PretendRay, caplog: pytest.LogCaptureFixture, size: JobSize, told: str
) -> None:
    """Ray itself waits and says nothing; a cluster that grows may get such a machine."""
    ray.running = True
    assert list(RayExecutor(2, size).map_unordered(abs, [-1])) == [1]
    assert len(caplog.messages) == bool(told)
    assert told in caplog.text


def test_a_ray_whose_workers_do_not_answer_is_started_anew_once(ray: PretendRay) -> None:
    ray.silent = 1
    executor = RayExecutor(2)
    assert list(executor.map_unordered(abs, [-1])) == [1]
    assert ray.events == ["started", "stopped", "started", "a job"]
    ray.events.clear()
    ray.running, ray.silent = False, 2
    with pytest.raises(DmbenchError, match=r"started 2 times .* no worker of it answered within 90 s; .*logs'"):
        list(executor.map_unordered(abs, [-1]))
    assert ray.events == ["started", "stopped"] * 2


def test_a_ray_that_fails_to_start_is_started_anew_once_and_then_told_of(
    ray: PretendRay, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ray raises a plain ``Exception`` where a busy machine takes it too long."""
    started = ray.init

    def late(**options: Any) -> None:
        started(**options)
        if ray.events.count("started") <= late_starts:
            raise Exception("The current node timed out during startup. This could happen because\nof much.")  # noqa: TRY002

    monkeypatch.setattr(ray, "init", late)
    late_starts = 1
    executor = RayExecutor(2)
    assert list(executor.map_unordered(abs, [-1])) == [1]
    assert ray.events == ["started", "stopped", "started", "a job"]
    ray.events.clear()
    ray.running, late_starts = False, 2
    with pytest.raises(DmbenchError, match=r"started 2 times .* it failed \(The current node timed out .*because\);"):
        list(executor.map_unordered(abs, [-1]))
    assert ray.events == ["started", "stopped"] * 2
