"""Work that dies, raises or is slow on purpose, in a module that a worker process imports quickly."""

from __future__ import annotations

import os
import signal
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dmotion_bench.recording.session import ShardJob
    from dmotion_bench.storage.shard import ShardReceipt


@dataclass(frozen=True)
class RecordsAndDiesOnce:
    """Records shards; but whoever is the first to be given the third is killed with its file half written."""

    mark: Path

    def __call__(self, job: ShardJob) -> ShardReceipt:
        from dmotion_bench.recording.session import record_shard

        if job.index == 2 and not self.mark.exists():
            self.mark.touch()
            half = job.dataset / "video" / "shard-00002.mcap.dead.part"
            half.parent.mkdir(exist_ok=True)
            half.write_bytes(b"half")
            os.kill(os.getpid(), signal.SIGKILL)
        return record_shard(job)


def dies_at_one(number: int) -> int:
    if number == 1:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def raises_at_one(number: int) -> int:
    from dmotion_bench.errors import UnknownName

    if number == 1:
        raise UnknownName("shape", "teapot", ["cube"])
    return number


@dataclass(frozen=True)
class LeavesTraces:
    """A file when it begins and another, much later, when it has ended."""

    folder: Path
    seconds: float

    def __call__(self, number: int) -> int:
        (self.folder / f"begun-{number}").touch()
        if number > 0:
            time.sleep(self.seconds)
        (self.folder / f"ended-{number}").touch()
        return number
