"""Jobs run by Slurm, one a task of a job array, through submitit.

Which partition, account and time limit: in the variables that ``sbatch`` itself reads (``SBATCH_PARTITION``,
``SBATCH_ACCOUNT``, ``SBATCH_TIMELIMIT``). Each machine needs dmbench installed and the workspace under the same path.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import shutil
import subprocess
import time
from collections.abc import Callable, Generator, Iterable, Sequence
from pathlib import Path
from typing import Any, Final, Generic, Literal

from dmotion_bench.errors import DmbenchError, PackageNotInstalled
from dmotion_bench.execution.executor import Job, JobQueue, JobSize, Result, Sendable
from dmotion_bench.wording import shortened, shown

_NAME: Final = "dmbench"  # of all our jobs
_ARRAY: Final = 1000  # tasks in a job array that every Slurm allows
_LOOK_AGAIN: Final = {"slurm": 2.0, "local": 0.05}  # [s]
_PATIENCE: Final = {"slurm": 90.0, "local": 0.0}
"""Seconds for a shared folder to show what a job that has ended wrote; NFS remembers for up to 60 what is there."""
_DOUBTFUL: Final = ("UNKNOWN", "PREEMPTED")
"""States in which submitit waits for a job, although it may never come back."""
_ASK_AGAIN: Final = {"slurm": 30.0}  # [s] between two questions to Slurm's queue
_ANSWER_WITHIN: Final = 60.0  # [s] for Slurm's queue
_LOG_END: Final = 4096  # bytes of a log that are read
_LAST_WORDS: Final = 300  # characters of them that are said
_GOODBYE: Final = 10.0  # [s] for cancelled processes on this machine to end


class SlurmExecutor:
    """Slurm's tasks, or processes that submitit starts on this machine in the same way.

    Args:
        workers: How many tasks at a time; None: as many as Slurm lets run, or one on this machine.
        folder: For submitit's files; all machines see it. It is deleted at the end, unless jobs failed.
        cluster: ``"local"`` is for trying it out where there is no Slurm.
        size: What is asked for, for each job.

    Raises:
        PackageNotInstalled: There is no submitit here.
        DmbenchError: There is no Slurm here, or the folder's path has a sign that Slurm replaces.
    """

    def __init__(
        self,
        workers: int | None,
        folder: Path,
        cluster: Literal["slurm", "local"] = "slurm",
        size: JobSize | None = None,
    ) -> None:
        try:
            import submitit
        except ImportError as error:
            raise PackageNotInstalled("submitit", "--executor slurm", "pip install 'dmbench[slurm]'") from error
        if cluster == "slurm" and not all(map(shutil.which, ("sbatch", "srun", "sacct"))):
            raise DmbenchError(
                "there is no Slurm here: 'sbatch', 'srun' and 'sacct' are not on the path; run this on a login node, "
                "or use this machine with '--executor local'."
            )
        if cluster == "slurm" and "%" in (place := str(folder.absolute())):
            raise DmbenchError(
                f"Slurm would replace the '%' in {shown(place)}, where its jobs' files would be; use a workspace "
                "without it in its path."
            )
        self._submitit: Any = submitit
        self._workers, self._folder, self._cluster = workers, folder.absolute(), cluster
        self._size = size or JobSize()
        self._allowed = math.inf  # jobs that Slurm takes at a time
        self._asks_queue = cluster == "slurm" and shutil.which("squeue") is not None
        self._asked, self._missed = -math.inf, set[str]()

    def map_unordered(self, function: Callable[[Job], Result], jobs: Iterable[Job]) -> Generator[Result, None, None]:
        """The results, as they are ready."""
        queue = JobQueue(jobs, "a job of Slurm")
        cancel_left(self._folder)
        self._folder.mkdir(mode=0o700, parents=True, exist_ok=True)
        executor = self._executor()
        running: list[_Submitted[Job]] = []
        failed, told = False, ""
        try:
            while True:
                running += self._submit(executor, function, queue, len(running))
                if not running:
                    break
                gone = self._gone(running)
                ended = [one for one in running if one.ended(_PATIENCE[self._cluster], gone=one in gone)]
                running = [one for one in running if one not in ended]
                for one in ended:
                    if one.lost:
                        told = one.last_words()
                        queue.killed(one.number, one.job)
                    else:
                        yield self._result(one)
                if not ended:
                    time.sleep(_LOOK_AGAIN[self._cluster])
            queue.end(told)
        except DmbenchError:
            failed = any(self._folder.glob("*_log.*"))  # they may say why
            raise
        finally:
            self._cancel(running)
            if not failed:
                shutil.rmtree(self._folder, ignore_errors=True)

    def _executor(self) -> Any:
        # Without '%j', a folder for each job: it is made after the job was started, which may look for it earlier.
        executor = self._submitit.AutoExecutor(folder=str(self._folder), cluster=self._cluster)
        size = self._size
        executor.update_parameters(
            name=_NAME, timeout_min=size.minutes, cpus_per_task=size.processors, mem_gb=size.gigabytes
        )
        if size.gpus:
            executor.update_parameters(gpus_per_node=size.gpus)
        executor.update_parameters(slurm_array_parallelism=self._workers or _ARRAY)
        return executor

    def _room(self, running: int) -> int:
        """How many jobs may be submitted beside those that run or wait.

        No more than Slurm took when it refused some. It likes few and large arrays, but bounds only how many tasks of
        one of them run at a time: while one is there, what is submitted beside it may not exceed ``workers`` even if
        all of it runs.
        """
        if self._cluster == "local":
            return (self._workers or 1) - running
        if self._workers is not None and running:
            room = min(_ARRAY, self._workers - running)
        else:
            room = _ARRAY - running if running <= _ARRAY // 2 else 0
        return int(min(room, self._allowed - running))

    def _submit(
        self, executor: Any, function: Callable[[Job], Result], queue: JobQueue[Job], running: int
    ) -> list[_Submitted[Job]]:
        """Some jobs as one array beside those that run; half as many if Slurm refuses them, for it may limit them.

        Raises:
            DmbenchError: Slurm refuses a single one.
        """
        chosen, most = list[tuple[int, Job]](), self._room(running)
        while len(chosen) < most and (numbered := queue.next()) is not None:
            chosen.append(numbered)
        errors = self._submitit.core.utils
        while chosen:
            try:
                with contextlib.redirect_stderr(io.StringIO()):  # submitit prints there what it raises
                    handles = executor.map_array(_Guarded(function), [job for _, job in chosen])
            except (errors.FailedJobError, errors.FailedSubmissionError) as error:
                if running + len(chosen) == 1:
                    said = " ".join(str(error).split()) or "sbatch gave no reason"
                    raise DmbenchError(
                        f"Slurm refuses the jobs: {said.rstrip('.')}. Name your account and a partition in the "
                        "variables SBATCH_ACCOUNT and SBATCH_PARTITION ('sacctmgr show associations' and 'sinfo' list "
                        "them), and run the same command again."
                    ) from None
                kept = len(chosen) // 2
                for numbered in reversed(chosen[kept:]):
                    queue.back(*numbered)
                chosen, self._allowed = chosen[:kept], max(1, running + kept)
            else:
                self._allowed *= 2  # it may have refused for another reason
                return [_Submitted(number, job, handle) for (number, job), handle in zip(chosen, handles, strict=True)]
        return []

    def _gone(self, running: Sequence[_Submitted[Job]]) -> list[_Submitted[Job]]:
        """Those of the jobs of which Slurm's accounts do not say that they ended, although its queue has them no more.

        Accounts may be switched off, or forget a job; and a job that was preempted may or may not begin again.
        """
        doubtful = [one for one in running if one.handle.state.upper() in _DOUBTFUL] if self._asks_queue else []
        if doubtful and time.monotonic() - self._asked >= _ASK_AGAIN[self._cluster]:
            self._asked, self._missed = time.monotonic(), self._missing(running)
        return [one for one in doubtful if one.handle.job_id in self._missed]

    def _missing(self, running: Sequence[_Submitted[Job]]) -> set[str]:
        """The numbers of the jobs that Slurm's queue does not have; none where it does not answer."""
        words = ["squeue", "--noheader", "--array", "--format=%i", f"--name={_NAME}", f"--user={os.getuid()}"]
        try:
            asked = subprocess.run(words, check=True, capture_output=True, text=True, timeout=_ANSWER_WITHIN)
        except subprocess.SubprocessError:
            return set()
        return {one.handle.job_id for one in running} - set(asked.stdout.split())

    def _result(self, one: _Submitted[Job]) -> Any:
        try:
            outcome = one.handle.result()
        except self._submitit.core.utils.FailedJobError as error:
            last = [line for line in str(error).splitlines() if line.strip() and not line.startswith("-")][-4:]
            raise DmbenchError(
                f"a job of Slurm failed: {' '.join(last)}; its logs are in {str(self._folder)!r}."
            ) from None
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    def _cancel(self, running: list[_Submitted[Job]]) -> None:
        """Cancel the running jobs; files that they have not renamed yet are lost without harm."""
        if not running:
            return
        if self._cluster == "slurm":
            arrays = {one.handle.job_id.split("_")[0] for one in running}
            subprocess.run(["scancel", *sorted(arrays)], check=False, capture_output=True)
            return
        for one in running:
            one.handle.cancel(check=False)
        deadline = time.monotonic() + _GOODBYE
        while not all(one.handle.done() for one in running) and time.monotonic() < deadline:
            time.sleep(0.05)


def cancel_left(folder: Path) -> None:
    """Cancel the jobs of Slurm whose files a command has left in its folder because it was killed."""
    named = {file.name.split("_")[0] for file in folder.glob("*_submission.sh")}
    arrays = sorted(name for name in named if name.isdecimal())  # and no option of scancel
    if arrays and shutil.which("scancel"):
        subprocess.run(["scancel", f"--name={_NAME}", *arrays], check=False, capture_output=True)


class _Submitted(Generic[Job]):
    """A job that was submitted to Slurm."""

    def __init__(self, number: int, job: Job, handle: Any) -> None:
        self.number, self.job, self.handle = number, job, handle
        self._done_since: float | None = None

    @property
    def lost(self) -> bool:
        """Whether it left no result, as when its process was killed."""
        return not self.handle.paths.result_pickle.exists()

    def last_words(self) -> str:
        """How the log of its errors ends, as a sentence, and where all logs are."""
        path: Path = self.handle.paths.stderr
        try:
            with path.open("rb") as log:
                log.seek(max(0, path.stat().st_size - _LOG_END))
                lines = log.read(_LOG_END).decode(errors="replace").splitlines()
        except OSError:
            return "It left no log: perhaps its machine does not see the workspace, or was switched off."
        last = next((line.strip() for line in reversed(lines) if line.strip()), "")
        said = f"Its log ends with {shown(shortened(last, _LAST_WORDS))}, and all" if last else "All"
        return f"{said} logs are in {shown(str(self.handle.paths.folder))}."

    def ended(self, patience: float, *, gone: bool = False) -> bool:
        """Whether there is a result, or has been none for so long after its end [s].

        Args:
            patience: So long.
            gone: Whether it ended although Slurm's accounts do not say so.
        """
        if not self.handle.done() and not gone:
            self._done_since = None
            return False
        self._done_since = self._done_since or time.monotonic()
        return not self.lost or time.monotonic() - self._done_since >= patience


class _Guarded(Generic[Job, Result]):
    """Gives back what a function raises: submitit would keep the traceback's text only.

    Slurm says by a signal that a job's time is over soon. submitit then raises an error in the middle of the function,
    where it could be taken for one of a model, after which the next one begins. An interruption is none: it ends the
    process, and the job counts as lost with its worker.
    """

    def __init__(self, function: Callable[[Job], Result]) -> None:
        self._function = Sendable(function)

    def __call__(self, job: Job) -> Result | Exception:
        try:
            return self._function(job)
        except Exception as error:
            return error

    def checkpoint(self, job: Job) -> None:
        """Called by submitit in the middle of a job that is to end."""
        raise KeyboardInterrupt
