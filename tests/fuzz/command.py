"""``dmbench`` as a user types it, in this process: its exit code, stdout and stderr."""

from __future__ import annotations

import io
import json
import sys
from dataclasses import dataclass
from typing import Any

from dmotion_bench.cli import main
from dmotion_bench.errors import DmbenchError
from tests.fuzz.case import Fault, checked_sentence


@dataclass(frozen=True)
class Said:
    """What a command said."""

    code: int
    out: str
    err: str

    def done(self) -> None:
        """See that it succeeded.

        Raises:
            DmbenchError: It did not; with its sentence.
        """
        if self.code:
            raise DmbenchError(self.err)

    def json(self) -> Any:
        """What it printed as JSON.

        Raises:
            DmbenchError: It failed, with its sentence.
            Fault: It printed no JSON.
        """
        self.done()
        try:
            return json.loads(self.out)
        except ValueError as error:
            raise Fault("no JSON", f"{error}: {self.out[:200]!r}") from None


def dmbench(*words: str, allowed: tuple[int, ...] = (0, 1, 2)) -> Said:
    """Run a command.

    Raises:
        Fault: It ended in a traceback, or said nothing of what is wrong.
    """
    before = sys.argv, sys.stdout, sys.stderr
    out, err = io.BytesIO(), io.BytesIO()
    sys.argv = ["dmbench", *words]
    sys.stdout = io.TextIOWrapper(out, "utf-8", write_through=True)
    sys.stderr = io.TextIOWrapper(err, "utf-8", errors="backslashreplace", write_through=True)
    try:
        main()
        code: Any = 0
    except SystemExit as left:
        code = left.code or 0
    finally:
        streams, (sys.argv, sys.stdout, sys.stderr) = (sys.stdout, sys.stderr), before
        for stream in streams:
            if not stream.closed:
                stream.detach()
    said = Said(code, out.getvalue().decode("utf-8", "replace"), err.getvalue().decode("utf-8", "replace"))
    if "Traceback (most recent call last)" in said.err:
        raise Fault("traceback on stderr", said.err[-1500:])
    if code not in allowed:
        raise Fault("exit code", f"{code!r}: {said.err[-500:]!r}")
    if code:
        checked_sentence(said.err)
    return said
