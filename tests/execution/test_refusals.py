"""A job that fails says the same sentence as a command."""

from __future__ import annotations

import errno

import pytest

from dmotion_bench.errors import RunError
from dmotion_bench.execution.refusals import reason


@pytest.mark.parametrize(
    ("error", "said"),
    [
        (RunError("training diverged."), "training diverged."),
        (PermissionError(errno.EACCES, "Permission denied", "/runs/a"), "may not write or read '/runs/a': Permission"),
        (
            FileExistsError(errno.EEXIST, "File exists", "/runs/a"),
            "'/runs/a' cannot be there, a file is in the way; name",
        ),
        (FileNotFoundError(errno.ENOENT, "No such file", "/a\x1b[31m"), "'/a\\x1b[31m' is not there, or was deleted"),
        (OSError("a library's own"), "cannot write or read a file: a library's own; name another path."),
        (ZeroDivisionError("by hand"), "ZeroDivisionError: by hand"),
    ],
)
def test_a_failure_is_a_sentence_where_there_is_one(error: Exception, said: str) -> None:
    assert said in reason(error)
    assert "Errno" not in reason(error)
