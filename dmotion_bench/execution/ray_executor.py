"""Jobs run by Ray: on this machine, or on the cluster that ``RAY_ADDRESS`` or ``ray.init`` names.

Ray itself starts no killed worker's task anew: ``JobQueue`` counts. Each machine needs dmbench installed and the
workspace under the same path.
"""

from __future__ import annotations

import itertools
import logging
import os
import signal
import socket
import threading
import weakref
from collections.abc import Callable, Generator, Iterable, Mapping
from pathlib import Path
from typing import Any, Final

from dmotion_bench.errors import DmbenchError, PackageNotInstalled
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.executor import Job, JobQueue, JobSize, Result, Sendable
from dmotion_bench.wording import counted
from dmotion_bench.workspace import CACHE_VARIABLE

_LOG: Final = logging.getLogger(__name__)
_USAGE_STATISTICS: Final = "RAY_USAGE_STATS_ENABLED"
_MORE_MACHINES: Final = "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"
"""0, on any system: a Ray of this machine alone, whose servers listen on the loopback address and on no other."""
_KNOCK: Final = 10.0  # [s]
_FIRST_ANSWER: Final = 90.0  # [s], of a worker of a Ray that was just started; on a busy machine it takes 20
_STARTS: Final = 2


class RayExecutor:
    """Ray's workers. Ray is started for the first jobs where it does not run, and then stopped with this executor.

    Args:
        workers: How many at a time; None: as many as there are processors for.
        size: What is asked for, for each job; of it, Ray is told the processors and the GPUs.

    Raises:
        PackageNotInstalled: There is no Ray here.
    """

    def __init__(self, workers: int | None = None, size: JobSize | None = None) -> None:
        os.environ.setdefault(_USAGE_STATISTICS, "0")  # Ray would report to its makers; read when it is imported
        if "RAY_ADDRESS" not in os.environ:
            os.environ.setdefault(_MORE_MACHINES, "0")
        try:
            import ray
        except ImportError as error:
            raise PackageNotInstalled("ray", "--executor ray", "pip install 'dmbench[ray]'") from error
        self._ray: Any = ray
        size = size or JobSize()
        self._workers, self._each, self._gpus = workers, size.processors, size.gpus

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Generator[Result, None, None]:
        """The results, as they are ready."""
        asked = iter(jobs)
        first = list(itertools.islice(asked, 1))
        if not first:
            return  # there is nothing that Ray would have to be started for
        ray = self._ray
        queue = JobQueue(itertools.chain(first, asked), "a worker of Ray")
        running: dict[Any, tuple[int, Job]] = {}
        killed = (
            ray.exceptions.WorkerCrashedError,
            ray.exceptions.NodeDiedError,
            ray.exceptions.OutOfMemoryError,
            ray.exceptions.TaskCancelledError,  # only what is left at the end is cancelled here: it was interrupted
        )
        try:
            if not ray.is_initialized():
                self._start()
            self._tell_of_waiting()
            # One more than can run, so that nobody waits; where a number was given, never more than that.
            limit = self._workers or self._most(ray.cluster_resources()) + 1

            cache = os.environ.get(CACHE_VARIABLE)
            chosen = {CACHE_VARIABLE: str(Path(cache).absolute())} if cache else {}

            sent = Sendable(function)

            def run(job: Job) -> Result:  # Ray takes functions, not whatever can be called
                os.environ.update(chosen)  # a worker has the variables of its Ray, which may have run before
                return sent(job)

            task = ray.remote(num_cpus=self._each, num_gpus=self._gpus, max_retries=0)(run)
            while True:
                while len(running) < limit and (numbered := queue.next()) is not None:
                    running[task.remote(numbered[1])] = numbered
                if not running:
                    break
                (done, *_), _ = ray.wait(list(running), num_returns=1)
                numbered = running.pop(done)
                try:
                    result = ray.get(done)
                except killed:
                    queue.killed(*numbered)
                else:
                    yield result
            queue.end()
        except ray.exceptions.RayTaskError as error:
            raise error.cause from None  # what the function raised
        finally:
            for one in running:
                ray.cancel(one, force=True)

    def _most(self, resources: Mapping[str, float]) -> int:
        """How many jobs the cluster can run at a time."""
        most = int(resources.get("CPU", 1)) // self._each
        return max(1, min(most, int(resources.get("GPU", 0)) // self._gpus) if self._gpus else most)

    def _tell_of_waiting(self) -> None:
        """Warn where no machine can run a job: Ray says nothing then, and waits for one that can, perhaps for ever."""
        wanted = {"CPU": self._each, "GPU": self._gpus}
        alive = [node["Resources"] for node in self._ray.nodes() if node["Alive"]]
        if not any(all(has.get(kind, 0) >= count for kind, count in wanted.items()) for has in alive):
            gpus = f" and {counted(self._gpus, 'GPU')}" if self._gpus else ""
            _LOG.warning(
                "no machine of this Ray cluster has the %s%s that each job asks for, so the jobs wait until one joins; "
                "if none will, stop this command and ask for less ('--threads', '--device cpu').",
                *(counted(self._each, "processor"), gpus),
            )

    def _start(self) -> None:
        """Start Ray; it would end this process on SIGTERM without tidying up."""
        before = signal.getsignal(signal.SIGTERM)
        weakref.finalize(self, self._ray.shutdown)  # not after each map: a recording and its proof are two
        self._init()
        if threading.current_thread() is threading.main_thread():
            signal.signal(signal.SIGTERM, before)

    def _init(self) -> None:
        quiet = {"log_to_driver": False, "logging_level": logging.ERROR}
        if address := os.environ.get("RAY_ADDRESS"):
            try:
                _knock(address)
                self._ray.init(**quiet)
            except Exception as error:  # as below
                raise DmbenchError(
                    f"there is no Ray at RAY_ADDRESS={address!r}: {_first_line(error)}; start it with "
                    "'ray start --head', or take the variable away to use this machine's processors."
                ) from None
            return
        processors = self._workers * self._each if self._workers else max(available_workers(), self._each)
        for _ in range(_STARTS):
            said = f"no worker of it answered within {_FIRST_ANSWER:.0f} s"
            try:
                self._ray.init(num_cpus=processors, include_dashboard=False, **quiet)
            except Exception as error:  # Ray raises plain ones, such as where a busy machine takes it too long
                said = f"it failed ({_first_line(error)})"
            else:
                if self._answers():
                    break
            self._ray.shutdown()
        else:
            raise DmbenchError(
                f"Ray was started {_STARTS} times on this machine, and {said}; see '/tmp/ray/session_latest/logs', or "
                "use '--executor local'."
            )
        if self._gpus > (found := self._ray.cluster_resources().get("GPU", 0)):  # Ray would wait for them for ever
            raise DmbenchError(
                f"each job asks for {counted(self._gpus, 'GPU')}, and Ray finds {found:.0f} on this machine; compute "
                "with '--device cpu', or name a cluster that has some in the variable RAY_ADDRESS."
            )

    def _answers(self) -> bool:
        """Whether a worker does a task. Where workers cannot register, Ray tries for ever and says nothing.

        github.com/ray-project/ray/issues/59342
        """
        try:
            return bool(self._ray.get(self._ray.remote(num_cpus=1)(_answer).remote(), timeout=_FIRST_ANSWER))
        except self._ray.exceptions.GetTimeoutError:
            return False


def _first_line(error: Exception) -> str:
    """What an error says, without what it says at length."""
    return (str(error).strip() or type(error).__name__).splitlines()[0].rstrip(".")


def _answer() -> bool:
    """A task that takes no time."""
    return True


def _knock(address: str) -> None:
    """Fail at once if no Ray cluster answers; Ray itself would try for minutes."""
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdigit():
        socket.create_connection((host, int(port)), timeout=_KNOCK).close()
