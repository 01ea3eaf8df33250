"""Whoever makes the shards, wherever and however often their workers are killed, the bytes are the same."""

from __future__ import annotations

import dataclasses
import json
import pickle
import random
import signal
import subprocess
import sys
import time
from concurrent.futures import ProcessPoolExecutor
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from mortal_workers import (
    DiesOnce,
    LeavesTraces,
    OutOfTimeOnce,
    RecordsAndDiesOnce,
    dies_at_one,
    raises_at_one,
    raises_what_cannot_be_sent,
)
from noise_world import files_of
from pretend_slurm import first_job, use_slurm

from dmotion_bench import errors, interrupts
from dmotion_bench.errors import DmbenchError, JobsLost, PackageNotInstalled, UnknownName
from dmotion_bench.execution import local_executor
from dmotion_bench.execution.executor import (
    ATTEMPTS,
    Executor,
    JobQueue,
)
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import jobs_folder
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.execution.slurm_executor import SlurmExecutor
from dmotion_bench.recording import session
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.workspace import Workspace

pytestmark = [pytest.mark.slow, pytest.mark.usefixtures("workers_find_the_tests_modules")]

RECIPE = DatasetRecipe(environment="grid_world", episodes=6, frames=6, tasks=2, shard_episodes=2)
needs_submitit = pytest.mark.skipif(find_spec("submitit") is None, reason="submitit is not installed")
needs_ray = pytest.mark.skipif(find_spec("ray") is None, reason="ray is not installed")


@pytest.fixture(scope="module")
def at_once(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    path = tmp_path_factory.mktemp("executors") / "d"
    record_dataset(path, RECIPE)
    return files_of(path)


def recorded_although_one_dies(executor: Executor, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, bytes]:
    monkeypatch.setattr(session, "record_shard", RecordsAndDiesOnce(folder / "died"))
    record_dataset(folder / "d", RECIPE, executor)
    assert (folder / "died").exists()
    return files_of(folder / "d")


def test_a_killed_process_costs_nothing_but_time(
    tmp_path: Path, at_once: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert recorded_although_one_dies(LocalExecutor(2), tmp_path, monkeypatch) == at_once


def done_beside_the_lost_one(executor: Executor, jobs: list[int], who: str) -> list[int]:
    """The results of jobs of which the one of number 1 kills every worker."""
    done: list[int] = []
    said = rf"{who} was killed at the same job {ATTEMPTS} times.*run the same command again"
    with pytest.raises(JobsLost, match=said) as caught:
        done.extend(executor.map_unordered(dies_at_one, jobs))
    assert caught.value.jobs == (1,)
    return sorted(done)


def test_a_job_that_kills_every_worker_stops_no_other() -> None:
    assert done_beside_the_lost_one(LocalExecutor(2), [1, 2, 3, 4], "a worker process") == [2, 3, 4]


def test_an_interruption_waits_until_a_pool_is_whole_and_ends_it(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[ProcessPoolExecutor] = []

    def interrupted(*words: Any, **options: Any) -> ProcessPoolExecutor:
        signal.raise_signal(signal.SIGINT)
        made.append(ProcessPoolExecutor(*words, **options))
        return made[-1]

    monkeypatch.setattr(local_executor, "ProcessPoolExecutor", interrupted)
    monkeypatch.setattr(interrupts._Received, "number", 0)  # as it is again afterwards
    with pytest.raises(KeyboardInterrupt):
        list(LocalExecutor(2).map_unordered(abs, [-1, -2]))
    (pool,) = made
    with pytest.raises(RuntimeError, match="shutdown"):
        pool.submit(abs, -1)


def test_every_error_survives_the_way_between_processes() -> None:
    kinds = [one for one in vars(errors).values() if isinstance(one, type) and issubclass(one, DmbenchError)]
    made: dict[type[DmbenchError], DmbenchError] = {
        UnknownName: UnknownName("model", "dmotoin", ["dmotion"]),
        PackageNotInstalled: PackageNotInstalled("ray", "--executor ray", "pip install ray"),
    }
    for kind in kinds:
        error = made.get(kind) or kind("a sentence")
        again = pickle.loads(pickle.dumps(error))
        assert type(again) is kind
        assert str(again) == str(error)
        assert vars(again) == vars(error)


def test_lost_jobs_go_first_and_not_for_ever() -> None:
    queue = JobQueue("ab", "a worker")
    assert queue.next() == (0, "a")
    queue.killed(0, "a")
    assert [queue.next(), queue.next(), queue.next()] == [(0, "a"), (1, "b"), None]
    queue.end()
    for _ in range(2):
        queue.killed(0, "a")
    assert queue.next() == (0, "a")
    assert queue.next() is None
    with pytest.raises(JobsLost, match="a worker was killed"):
        queue.end()


@pytest.mark.parametrize(("name", "package"), [("ray", "ray"), ("slurm", "submitit")])
def test_an_absent_package_is_named_with_the_command_that_installs_it(
    name: str, package: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(PackageNotInstalled, match=rf"--executor {name} needs .*pip install 'dmbench\[{name}\]'"):
        make_executor(name)


@needs_submitit
def test_without_slurm_its_executor_says_so(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(DmbenchError, match=r"no Slurm here.*'--executor local'"):
        make_executor("slurm")


@needs_submitit
def test_submitits_jobs_make_the_same_bytes_although_one_is_killed(
    tmp_path: Path, at_once: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    executor = SlurmExecutor(2, tmp_path / "jobs", cluster="local")
    assert recorded_although_one_dies(executor, tmp_path, monkeypatch) == at_once
    assert not (tmp_path / "jobs").exists()


@needs_submitit
def test_submitits_jobs_are_given_up_after_so_many_deaths(tmp_path: Path) -> None:
    executor = SlurmExecutor(1, tmp_path / "jobs", cluster="local")
    assert done_beside_the_lost_one(executor, [1, 2], "a job of Slurm") == [2]
    assert (tmp_path / "jobs").exists()  # with the logs


@needs_submitit
def test_a_job_whose_time_is_over_is_begun_again(tmp_path: Path) -> None:
    executor = SlurmExecutor(1, tmp_path / "jobs", cluster="local")
    assert sorted(executor.map_unordered(OutOfTimeOnce(tmp_path / "told"), [1, 2])) == ["1 done", "2 done"]
    assert (tmp_path / "told").exists()


@needs_submitit
def test_what_a_job_raises_arrives_and_stops_the_others(tmp_path: Path) -> None:
    executor = SlurmExecutor(1, tmp_path / "jobs", cluster="local")
    with pytest.raises(UnknownName, match="no shape named 'teapot'"):
        list(executor.map_unordered(raises_at_one, [1, 2, 3]))
    with pytest.raises(RuntimeError, match=r"OfTwo: the arm is stuck \(motor 3\)"):
        list(executor.map_unordered(raises_what_cannot_be_sent, [1]))


@pytest.fixture
def slurm(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where a pretended Slurm keeps the scripts that it was given."""
    use_slurm(tmp_path / "slurm", monkeypatch)
    return tmp_path / "slurm"


def wait_until_none_runs() -> None:
    """Until no job of the pretended Slurm runs any more, cancelled or not."""
    while b"RUNNING" in subprocess.run(["sacct"], capture_output=True, check=True).stdout:
        time.sleep(0.05)


@needs_submitit
def test_a_job_array_makes_the_same_bytes(tmp_path: Path, slurm: Path, at_once: dict[str, bytes]) -> None:
    record_dataset(tmp_path / "d", RECIPE, make_executor("slurm", 2, tmp_path / ".d-jobs"))
    assert files_of(tmp_path / "d") == at_once
    (script,) = slurm.glob("script-*")
    assert "#SBATCH --array=0-2%2\n#SBATCH --cpus-per-task=1" in script.read_text()
    assert not (tmp_path / ".d-jobs").exists()


@needs_submitit
def test_what_slurm_refuses_is_a_sentence(tmp_path: Path, slurm: Path, capfd: pytest.CaptureFixture[str]) -> None:
    (slurm / "bin" / "sbatch").write_text("#!/bin/sh\necho 'sbatch: error: Invalid account specified' >&2\nexit 1\n")
    says = r"^Slurm refuses the jobs: sbatch: error: Invalid account specified\. Name .*SBATCH_ACCOUNT"
    for jobs in (1, 2):
        with pytest.raises(DmbenchError, match=says):
            list(make_executor("slurm", 2, tmp_path / "jobs").map_unordered(abs, range(jobs)))
    assert capfd.readouterr().err == ""
    assert not (tmp_path / "jobs").exists()


@needs_submitit
@pytest.mark.parametrize(
    ("accounts", "state"),
    [("exit 1", "forgotten"), ("echo 'JobID|State|NodeList'; echo '{job}|PREEMPTED|'", "preempted")],
)
def test_a_job_that_slurm_s_accounts_lose_is_missed_in_its_queue(
    tmp_path: Path, slurm: Path, accounts: str, state: str
) -> None:
    """Its accounts may be switched off, too. Without this the command would wait for ever."""
    (slurm / "bin" / "sacct").write_text(f"#!/bin/sh\n{accounts.format(job=first_job(slurm))}\n")
    executor = make_executor("slurm", 1, tmp_path / "jobs")
    assert list(executor.map_unordered(DiesOnce(abs, tmp_path / state, -1), [-1])) == [1]
    assert (tmp_path / state).exists()


@needs_submitit
def test_what_the_logs_of_lost_jobs_end_with_is_told(tmp_path: Path, slurm: Path) -> None:
    srun = slurm / "bin" / "srun"
    broken = "import sys; sys.exit('ModuleNotFoundError: there is no dmbench here')"
    srun.write_text(srun.read_text().replace("sys.argv[start:]", f"[sys.argv[start], '-c', {broken!r}]"))
    said = rf"ends with 'ModuleNotFoundError: there is no dmbench here', and all logs are in '{tmp_path / 'jobs'}'\.$"
    with pytest.raises(JobsLost, match=said):
        list(make_executor("slurm", 1, tmp_path / "jobs").map_unordered(abs, [-1]))
    assert list((tmp_path / "jobs").glob("*_log.err"))
    srun.write_text("#!/bin/sh\nexit 1\n")
    with pytest.raises(JobsLost, match=r"It left no log: perhaps its machine does not see the workspace"):
        list(make_executor("slurm", 1, tmp_path / "other").map_unordered(abs, [-1]))


LIMITED = """#!{python}
import os, re, subprocess, sys
from pathlib import Path
array = re.search(r"--array=0-(\\d+)%", Path(sys.argv[1]).read_text())
asked = int(array[1]) + 1 if array else 1
if asked + len(subprocess.run(["squeue"], capture_output=True, check=True).stdout.split()) > {most}:
    sys.exit("sbatch: error: QOSMaxSubmitJobPerUserLimit")
os.execv({sbatch!r}, [{sbatch!r}, *sys.argv[1:]])
"""


@needs_submitit
@pytest.mark.parametrize("workers", [None, 4])
def test_where_slurm_takes_few_jobs_at_a_time_few_are_sent(tmp_path: Path, slurm: Path, workers: int | None) -> None:
    sbatch, own = slurm / "bin" / "sbatch", slurm / "bin" / "sbatch-without-limit"
    sbatch.rename(own)
    sbatch.write_text(LIMITED.format(python=sys.executable, most=2, sbatch=str(own)))
    sbatch.chmod(0o755)
    executor = make_executor("slurm", workers, tmp_path / "jobs")
    assert sorted(executor.map_unordered(abs, range(-5, 0))) == [1, 2, 3, 4, 5]


@needs_submitit
@pytest.mark.usefixtures("slurm")
def test_a_path_that_slurm_would_change_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(DmbenchError, match=r"^Slurm would replace the '%' in '.*100%/jobs'.*workspace without it"):
        make_executor("slurm", 2, tmp_path / "100%" / "jobs")


@needs_submitit
@pytest.mark.parametrize("workers", [1, 3, 64, 700, 1500])
def test_arrays_beside_each_other_never_run_more_tasks_than_workers(workers: int, tmp_path: Path, slurm: Path) -> None:
    executor = SlurmExecutor(workers, tmp_path)
    draw, left, arrays, most = random.Random(workers), 5000, list[int](), 0
    while left or sum(arrays):
        if (room := min(executor._room(sum(arrays)), left)) > 0:
            arrays.append(room)
            left -= room
        running = [min(array, workers) for array in arrays]  # as many as Slurm may run of each
        most = max(most, sum(running))
        arrays = [array - draw.randint(0, own) for array, own in zip(arrays, running, strict=True)]
    assert most == workers


@needs_submitit
def test_leaving_cancels_the_job_array(tmp_path: Path, slurm: Path) -> None:
    results = make_executor("slurm", 2, tmp_path / "jobs").map_unordered(LeavesTraces(tmp_path, seconds=30), range(2))
    assert next(iter(results)) == 0
    results.close()  # type: ignore[attr-defined]
    wait_until_none_runs()
    assert not (tmp_path / "ended-1").exists()


KILLED = """
import os, signal, sys, threading, time
from pathlib import Path
from mortal_workers import LeavesTraces
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import jobs_folder
from dmotion_bench.workspace import Workspace

root, scratch = Path(sys.argv[1]), Path(sys.argv[2])
with jobs_folder(Workspace(root)) as folder:
    executor = make_executor("slurm", 2, folder / "slurm" if scratch.name == "own" else scratch)
    for _ in executor.map_unordered(LeavesTraces(root, seconds=60), range(2)):
        os.kill(os.getpid(), signal.SIGKILL)
"""


@needs_submitit
@pytest.mark.parametrize("scratch", ["own", "of-a-recording"])
def test_the_next_command_cancels_the_jobs_of_one_that_was_killed(tmp_path: Path, slurm: Path, scratch: str) -> None:
    words = [sys.executable, "-c", KILLED, str(tmp_path), str(tmp_path / scratch)]
    assert subprocess.run(words, check=False, timeout=120).returncode == -signal.SIGKILL
    assert b"RUNNING" in subprocess.run(["sacct"], capture_output=True, check=True).stdout
    with jobs_folder(Workspace(tmp_path)):
        if scratch != "own":
            assert list(make_executor("slurm", 2, tmp_path / scratch).map_unordered(abs, [-1])) == [1]
    wait_until_none_runs()
    assert not (tmp_path / "ended-1").exists()
    assert not list(tmp_path.glob(".jobs-*"))


@needs_ray
def test_an_address_where_no_ray_listens_is_a_sentence(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("RAY_ADDRESS", "127.0.0.1:9")
    with pytest.raises(DmbenchError, match=r"no Ray at RAY_ADDRESS='127.0.0.1:9'.*ray start --head"):
        list(make_executor("ray").map_unordered(dies_at_one, [1]))


RAY = """
import json, sys, time
from pathlib import Path
import psutil
from mortal_workers import InterruptedOnce, LeavesTraces, RecordsAndDiesOnce, dies_at_one, raises_at_one
from dmotion_bench.errors import DmbenchError
from dmotion_bench.recording import session
from dmotion_bench.execution.ray_executor import RayExecutor
from dmotion_bench.specs import DatasetRecipe

folder, recipe = Path(sys.argv[1]), DatasetRecipe(**json.loads(sys.argv[2]))
executor = RayExecutor(2)  # before Ray is imported: it says what Ray may not report
import ray

ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False)
session.record_shard = RecordsAndDiesOnce(folder / "died")
session.record_dataset(folder / "d", recipe, executor)
said = {}
for work in (dies_at_one, raises_at_one):
    done = []
    try:
        done.extend(executor.map_unordered(work, [0, 1, 2, 3]))
    except DmbenchError as error:
        said[work.__name__] = [type(error).__name__, str(error), sorted(done)]
said["interrupted"] = sorted(executor.map_unordered(InterruptedOnce(folder / "asked"), [0, 1, 2]))
results = executor.map_unordered(LeavesTraces(folder, seconds=60), [1, 0])
said["first"] = next(results)
while not (folder / "begun-1").exists():
    time.sleep(0.01)
slow = int((folder / "begun-1").read_text())
results.close()
until = time.monotonic() + 30
while psutil.pid_exists(slow) and time.monotonic() < until:
    time.sleep(0.05)
said["is cancelled"] = not psutil.pid_exists(slow)
said["ray is still there"] = ray.is_initialized()  # it was not the executor's to stop
(folder / "said.json").write_text(json.dumps(said))
"""


@pytest.mark.slow
@needs_ray
def test_ray_makes_the_same_bytes_although_one_is_killed(tmp_path: Path, at_once: dict[str, bytes]) -> None:
    recipe = {key: value for key, value in dataclasses.asdict(RECIPE).items() if key not in ("parameters", "vary")}
    (tmp_path / "with_ray.py").write_text(RAY)
    words = [sys.executable, str(tmp_path / "with_ray.py"), str(tmp_path), json.dumps(recipe)]
    done = subprocess.run(words, capture_output=True, text=True, timeout=300, check=False)
    assert done.returncode == 0, done.stderr
    said = json.loads((tmp_path / "said.json").read_text())
    kind, sentence, done_beside = said["dies_at_one"]
    assert (kind, done_beside) == ("JobsLost", [0, 2, 3])
    assert said["interrupted"] == [0, 1, 2]
    assert (tmp_path / "asked").exists()
    assert f"a worker of Ray was killed at the same job {ATTEMPTS} times" in sentence
    assert said["raises_at_one"][0] == "UnknownName"
    assert "no shape named 'teapot'" in said["raises_at_one"][1]
    assert said["first"] == 0
    assert said["is cancelled"]
    assert not (tmp_path / "ended-1").exists()
    assert said["ray is still there"]
    assert (tmp_path / "died").exists()
    record_dataset(tmp_path / "d", RECIPE)  # nothing is missing; what the dead left is cleared away
    assert files_of(tmp_path / "d") == at_once
