"""A job that computes on a GPU asks its cluster for one."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path

import pytest
import torch

from dmotion_bench.api import side_by_side
from dmotion_bench.api.side_by_side import Hands, gpus_of_a_job
from dmotion_bench.execution.executor import JobSize
from dmotion_bench.execution.ray_executor import RayExecutor
from dmotion_bench.execution.slurm_executor import SlurmExecutor


def test_only_jobs_on_a_gpu_ask_for_one() -> None:
    assert [gpus_of_a_job(Hands(device=device)) for device in ("auto", "cpu", "cuda")] == [0, 0, 1]


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


@pytest.mark.skipif(find_spec("submitit") is None, reason="submitit is not installed")
def test_slurm_is_asked_for_gpus(tmp_path: Path) -> None:
    executor = SlurmExecutor(1, tmp_path, cluster="local", size=JobSize(gpus=1))._executor()
    assert executor._executor.parameters["gpus_per_node"] == 1
    plain = SlurmExecutor(1, tmp_path, cluster="local")._executor()
    assert "gpus_per_node" not in plain._executor.parameters
