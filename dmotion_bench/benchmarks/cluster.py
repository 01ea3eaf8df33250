"""A simulated cluster: jobs that sleep, under the real schedulers, and the share of the time that is not work.

``python -m dmotion_bench.benchmarks.cluster`` runs 64 workers on this machine: processes, Ray with 64 logical
processors, and jobs of submitit as it starts them where there is no Slurm. A sleeping job takes no processor, so 64 run
beside each other on any machine. What is measured is the scheduling, the start of the workers and the way of jobs and
receipts. Starting 64 processes takes as long as the cores of this machine need for it; on a cluster each machine
starts its own. So the time until all workers have been at work is told apart from the rest.
"""

from __future__ import annotations

import argparse
import itertools
import json
import sys
import tempfile
import time
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.execution.executor import Executor, JobSize
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.execution.ray_executor import RayExecutor
from dmotion_bench.execution.slurm_executor import SlurmExecutor
from dmotion_bench.interrupts import ended_like_ctrl_c

WORLD: Final = "robot_push"
"""Whose shards the jobs are as long as."""

_MEASURED: Final = 4  # shards, the first of which also starts the simulator


@dataclass(frozen=True, kw_only=True)
class Nap:
    """A job that sleeps so long [s]."""

    seconds: float


@dataclass(frozen=True, kw_only=True)
class Slept:
    """When a job began and ended, by the clock that all processes of a machine share [s]."""

    began: float
    ended: float


def nap(job: Nap) -> Slept:
    """Sleep."""
    began = time.monotonic()
    time.sleep(job.seconds)
    return Slept(began=began, ended=time.monotonic())


@dataclass(frozen=True, kw_only=True)
class Share:
    """How much of the time of all workers was not work.

    Attributes:
        executor: Which one.
        workers, jobs: How many.
        work: Seconds that the jobs slept, in all.
        wall: From the call to the last result.
        starting: Until as many jobs had begun as there are workers.
        not_work: 1 - work / (workers x wall).
        not_work_later: The same from the moment at which all workers were at work until the first one found no job.
        between_jobs: Seconds between the end of a job and the beginning of the next one of its worker, on average, in
            that time.
    """

    executor: str
    workers: int
    jobs: int
    work: float
    wall: float
    starting: float
    not_work: float
    not_work_later: float
    between_jobs: float


def measured_lengths(environment: str, count: int) -> list[float]:
    """How long one core takes for shards of an environment, 20 episodes each [s]."""
    from dmotion_bench.recording.speed import RecordedFrames  # which the workers, who import this module, do not need

    lengths = []
    with RecordedFrames(environment) as record:
        for _ in range(count):
            began = time.process_time()
            record()
            lengths.append(time.process_time() - began)
    return lengths


def simulate(name: str, executor: Executor, workers: int, naps: Sequence[Nap]) -> Share:
    """Run sleeping jobs by an executor, and say what of the time they did not sleep."""
    called = time.monotonic()
    slept = list(executor.map_unordered(nap, naps))
    wall = time.monotonic() - called
    begins = sorted(one.began for one in slept)
    all_busy, last_begin = begins[min(workers, len(begins)) - 1], begins[-1]
    later = max(last_begin - all_busy, 1e-9)
    within = sum(max(0.0, min(one.ended, last_begin) - max(one.began, all_busy)) for one in slept)
    idle = max(0.0, workers * later - within)
    started_later = sum(one.began > all_busy for one in slept)
    work = sum(one.ended - one.began for one in slept)
    return Share(
        executor=name,
        workers=workers,
        jobs=len(slept),
        work=work,
        wall=wall,
        starting=all_busy - called,
        not_work=1 - work / (workers * wall),
        not_work_later=idle / (workers * later),
        between_jobs=idle / started_later if started_later else 0.0,
    )


_HEAD: Final = (
    "| executor | workers | jobs | in all [s] | until all were at work [s] | not work | not work, from then on "
    "| between jobs [ms] |\n|---|---|---|---|---|---|---|---|\n"
)


def _row(share: Share) -> str:
    parts = (
        share.executor,
        str(share.workers),
        str(share.jobs),
        f"{share.wall:.1f}",
        f"{share.starting:.1f}",
        f"{share.not_work:.1%}",
        f"{share.not_work_later:.1%}",
        f"{1000 * share.between_jobs:.0f}",
    )
    return f"| {' | '.join(parts)} |\n"


def main(words: Sequence[str] | None = None) -> None:
    """Run, and print a table or a line of JSON for each executor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--workers", type=int, default=64)
    parser.add_argument("--jobs", type=int, default=192)
    parser.add_argument("--executors", nargs="+", default=["local", "ray", "submitit"])
    parser.add_argument("--seconds", type=float, nargs="+", help="lengths of jobs, in place of measured ones")
    parser.add_argument("--json", action="store_true", help="a line of JSON for each executor")
    asked = parser.parse_args(words)
    say = sys.stdout.write
    lengths = measured_lengths(WORLD, _MEASURED) if asked.seconds is None else asked.seconds
    if asked.json:
        say(json.dumps({"seconds of the jobs": lengths}) + "\n")
    else:
        say(f"Jobs sleep for {', '.join(f'{one:.1f}' for one in lengths)} s in turn.\n\n{_HEAD}")
    naps = [Nap(seconds=seconds) for seconds in itertools.islice(itertools.cycle(lengths), asked.jobs)]
    for name in asked.executors:
        with tempfile.TemporaryDirectory(prefix="dmbench-") as folder, ended_like_ctrl_c():  # which ends all workers
            share = simulate(name, _executor(name, asked.workers, Path(folder)), asked.workers, naps)
        say(json.dumps(asdict(share)) + "\n" if asked.json else _row(share))
        sys.stdout.flush()


def _executor(name: str, workers: int, folder: Path) -> Executor:
    if name == "local":
        return LocalExecutor(workers)
    if name == "ray":
        return RayExecutor(workers, JobSize(processors=1))
    return SlurmExecutor(workers, folder / "jobs", cluster="local")


if __name__ == "__main__":
    main()
