"""Why a piece of work failed, in a sentence: the same whether a command did it or one of its jobs."""

from __future__ import annotations

import errno
from typing import Final

from dmotion_bench.errors import DmbenchError
from dmotion_bench.execution.processes import NO_ROOM
from dmotion_bench.storage.atomic import FULL
from dmotion_bench.wording import shown

_DENIED: Final = (errno.EACCES, errno.EPERM, errno.EROFS)
_IN_THE_WAY: Final = (errno.EEXIST, errno.ENOTDIR)
_GONE: Final = (errno.ENOENT, errno.ESTALE)


def reason(error: Exception) -> str:
    """Why a job failed that may raise anything: a sentence where there is one, else the error's kind and text."""
    if isinstance(error, DmbenchError):
        return str(error)
    return refused(error) if isinstance(error, OSError) else f"{type(error).__name__}: {error}"


def refused(error: OSError) -> str:
    """What the operating system would not do, in a sentence."""
    what, why = shown(error.filename) if error.filename is not None else "a file", error.strerror or error
    if error.errno in FULL:
        return (
            f"no space left on the device while writing {what}; free some and run the same command again: "
            "it goes on where it stopped."
        )
    if error.errno in NO_ROOM:
        return (
            f"this machine has no memory or no process left ({why}); end other programs and run the same command again."
        )
    if error.errno in _DENIED:
        return f"may not write or read {what}: {why}."
    if error.errno in _GONE:
        return f"{what} is not there, or was deleted meanwhile; run the same command again, or name another path."
    if error.errno in _IN_THE_WAY:
        return f"{what} cannot be there, a file is in the way; name another path."
    return f"cannot write or read {what}: {why}; name another path."
