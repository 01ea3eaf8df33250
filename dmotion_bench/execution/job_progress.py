"""How far the jobs of an executor are: each says so in a small file of a folder that all machines share."""

from __future__ import annotations

import contextlib
import json
import shutil
import socket
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.errors import UsageError
from dmotion_bench.execution.slurm_executor import cancel_left
from dmotion_bench.storage.atomic import FULL, TEMPORARY_SUFFIX
from dmotion_bench.storage.lock import try_lock
from dmotion_bench.wording import shown
from dmotion_bench.workspace import Workspace

SECONDS: Final = 0.5
"""Between two looks at the files, and between two writes of one."""
_PREFIX: Final = ".jobs-"
_USER: Final = "user"
"""The file in a jobs' folder that names the machine of the command that uses it, which holds a lock on it."""


@dataclass(frozen=True, kw_only=True)
class JobProgress:
    """How far a job is.

    Attributes:
        what: What it does now.
        done, total: So much of so much; None where the end is not known.
        status: Free text beside it.
        unit: What is counted, such as ``"steps"``; empty where ``what`` says it.
    """

    what: str
    done: float
    total: float | None
    status: str = ""
    unit: str = ""


@contextlib.contextmanager
def jobs_folder(workspace: Workspace) -> Iterator[Path]:
    """A folder of the workspace in which jobs meet; what is left in it at the end is deleted, logs of failures stay.

    What commands of this machine left that were killed is deleted first, and their jobs of Slurm are cancelled.

    Raises:
        UsageError: No folder can be made there.
    """
    try:
        workspace.root.mkdir(parents=True, exist_ok=True)
        folder = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=workspace.root)).absolute()
    except OSError as error:
        if error.errno in FULL:
            raise
        raise UsageError(
            f"jobs meet in a folder of {shown(str(workspace.root.absolute()))}, and none can be made there "
            f"({error.strerror}); name another workspace with DMBENCH_WORKSPACE, for an import '--out DIR'."
        ) from None
    try:
        for user in workspace.root.glob(f"{_PREFIX}*/{_USER}"):
            if _was_killed(user):
                for inside in user.parent.iterdir():
                    cancel_left(inside)
                shutil.rmtree(user.parent, ignore_errors=True)
        with (folder / _USER).open("w") as user_file:
            try_lock(user_file.fileno())
            user_file.write(socket.gethostname())
            user_file.flush()
            yield folder
    finally:
        for left in folder.glob("*"):
            if left.is_file():
                left.unlink(missing_ok=True)
        with contextlib.suppress(OSError):
            folder.rmdir()  # not while it holds the logs of jobs that failed


def _was_killed(user: Path) -> bool:
    """Whether the command that uses a folder is gone; of other machines, whose locks may not be seen here, never."""
    try:
        with user.open("r+") as file:
            return file.read() == socket.gethostname() and try_lock(file.fileno()) is True
    except OSError:
        return False


class ProgressFile:
    """Where one job says how far it is; a file that cannot be written costs nothing but the progress.

    Args:
        path: Of the file; None: nobody wants to know.
        clock: Gives the time in seconds.
    """

    def __init__(self, path: Path | None, clock: Callable[[], float] = time.monotonic) -> None:
        self._path, self._clock, self._due = path, clock, clock()

    def tell(self, progress: JobProgress) -> None:
        """Write it, unless something was written a moment ago."""
        if self._path is None or self._clock() < self._due:
            return
        self._due = self._clock() + SECONDS
        with contextlib.suppress(OSError):
            # Not synced: after a power cut no job is left that anybody could ask about.
            written = self._path.with_name(self._path.name + TEMPORARY_SUFFIX)
            written.write_bytes(json.dumps(asdict(progress)).encode())
            written.replace(self._path)

    def end(self) -> None:
        """The job is over."""
        if self._path is not None:
            with contextlib.suppress(OSError):
                self._path.unlink(missing_ok=True)


def read_progress(folder: Path) -> Mapping[str, JobProgress]:
    """What every running job says, by the name of its file."""
    found: dict[str, JobProgress] = {}
    for path in sorted(folder.glob("*.json")):
        with contextlib.suppress(OSError, ValueError, TypeError):  # just written anew, or its job has just ended
            found[path.stem] = JobProgress(**json.loads(path.read_bytes()))
    return found


@contextlib.contextmanager
def watching(folder: Path, show: Callable[[Mapping[str, JobProgress]], None]) -> Iterator[None]:
    """Within the block ``show`` is told, now and then and by another thread, what every running job says."""
    over = threading.Event()

    def look() -> None:
        while not over.wait(SECONDS):
            show(read_progress(folder))

    thread = threading.Thread(target=look, daemon=True)
    thread.start()
    try:
        yield
    finally:
        over.set()
        thread.join()
