"""A job that computes on a GPU asks its cluster for one."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
import torch

from dmotion_bench.api import reproducing, side_by_side
from dmotion_bench.api.reproducing import plan_table, what_it_costs
from dmotion_bench.api.side_by_side import Hands
from dmotion_bench.errors import UsageError
from dmotion_bench.execution.executor import JobSize
from dmotion_bench.execution.ray_executor import RayExecutor
from dmotion_bench.execution.slurm_executor import SlurmExecutor


@pytest.mark.parametrize("gpu_here", [False, True])
@pytest.mark.parametrize("executor", ["slurm", "ray"])
def test_a_cluster_is_asked_for_a_gpu_exactly_where_a_job_computes_on_one(
    executor: str, gpu_here: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: gpu_here)
    hands = [Hands(device=device, executor=executor) for device in ("auto", "cpu", "cuda")]
    assert [(one.job_device, one.job_size().gpus) for one in hands] == [("cpu", 0), ("cpu", 0), ("cuda", 1)]
    assert Hands().job_device == ("cuda" if gpu_here else "cpu")  # jobs of this machine


def test_without_a_gpu_here_the_jobs_of_a_cluster_can_be_counted_and_those_of_this_machine_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(reproducing, "cost_of", lambda plan, speeds: speeds)
    plan = plan_table("labels", preset="tiny", models=["lapo"], worlds=["planar_push"], workspace=tmp_path)
    speeds: Any = what_it_costs(plan, Hands(device="cuda", executor="slurm"))
    assert speeds.device == torch.device("cpu")
    with pytest.raises(UsageError, match="no CUDA device"):
        what_it_costs(plan, Hands(device="cuda"))
    assert Hands(device="cuda").at_once(3) is not None


@pytest.mark.parametrize(("gigabytes", "jobs", "most"), [(79.0, 40, 16), (79.0, 3, 3), (10.0, 40, 2), (1.0, 40, 1)])
def test_jobs_share_a_gpu_as_far_as_its_memory_goes(
    gigabytes: float, jobs: int, most: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(side_by_side, "available_workers", lambda _: 16)
    monkeypatch.setattr(torch.cuda, "is_available", lambda: True)
    monkeypatch.setattr(torch.cuda, "mem_get_info", lambda: (int(gigabytes * 2**30), 80 * 2**30))
    assert Hands().at_once(jobs) == Hands(device="cuda").at_once(jobs) == most
    assert Hands(device="cpu").at_once(jobs) == min(16, jobs)
    assert Hands(device="cuda", workers=7).at_once(jobs) == 7
    assert Hands(device="cuda", executor="ray").at_once(jobs) is None  # each asks Ray for a GPU


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
@pytest.mark.parametrize(("gpus", "most"), [(0, 8), (1, 2), (4, 1)])
def test_ray_runs_as_many_jobs_as_there_are_gpus_for(gpus: int, most: int) -> None:
    executor = RayExecutor(size=JobSize(processors=2, gpus=gpus))
    assert executor._most({"CPU": 16.0, "GPU": 2.0}) == most


@pytest.mark.skipif(find_spec("ray") is None, reason="Ray is not installed")
def test_ray_is_not_started_where_there_is_nothing_to_do(monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: RayExecutor) -> None:
        raise AssertionError("Ray was started")

    monkeypatch.setattr(RayExecutor, "_start", refuse)
    assert list(RayExecutor(2).map_unordered(abs, [])) == []
    with pytest.raises(AssertionError, match="was started"):
        list(RayExecutor(2).map_unordered(abs, [1]))


@pytest.mark.skipif(find_spec("submitit") is None, reason="submitit is not installed")
def test_slurm_is_asked_for_gpus(tmp_path: Path) -> None:
    executor = SlurmExecutor(1, tmp_path, cluster="local", size=JobSize(gpus=1))._executor()
    assert executor._executor.parameters["gpus_per_node"] == 1
    plain = SlurmExecutor(1, tmp_path, cluster="local")._executor()
    assert "gpus_per_node" not in plain._executor.parameters
