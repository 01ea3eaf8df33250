"""How long Ray runs, with a pretended Ray; ``test_executors.py`` runs jobs on a real one."""

from __future__ import annotations

import sys
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import pytest

from dmotion_bench.execution.ray_executor import RayExecutor


class PretendRay:
    """Does a task when it is asked for its result."""

    exceptions = SimpleNamespace(
        **{
            name: type(name, (Exception,), {})
            for name in (
                *("WorkerCrashedError", "NodeDiedError", "OutOfMemoryError"),
                *("TaskCancelledError", "RayTaskError"),
            )
        }
    )

    def __init__(self) -> None:
        self.events: list[str] = []
        self.running = False

    def init(self, **options: Any) -> None:
        self.events.append("started")
        self.running = True

    def shutdown(self) -> None:
        self.events.append("stopped")
        self.running = False

    def is_initialized(self) -> bool:
        return self.running

    def cluster_resources(self) -> dict[str, float]:
        return {"CPU": 2}

    def remote(self, **options: Any) -> Callable[[Callable[[Any], Any]], Any]:
        return lambda function: SimpleNamespace(remote=lambda job: (function, job))

    def wait(self, tasks: list[Any], num_returns: int) -> tuple[list[Any], list[Any]]:
        return tasks[:1], tasks[1:]

    def get(self, task: Any) -> Any:
        self.events.append("a job")
        return task[0](task[1])


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
