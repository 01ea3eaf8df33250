"""Which of the names in a recording somebody may have meant."""

from __future__ import annotations

import difflib
import re
from collections.abc import Sequence
from typing import Final

from dmotion_bench.wording import shown

_BETWEEN: Final = re.compile(r"[./]")  # the parts of a name


def did_you_mean(known: Sequence[str], asked: str) -> str:
    """A question with the name that is nearest to the one asked for, whole or by its last part; empty without any.

    Args:
        known: The names that there are.
        asked: What somebody typed.
    """
    names = {_BETWEEN.split(name)[-1]: name for name in known} | {name: name for name in known}
    near = difflib.get_close_matches(asked, names, 1)
    return f"did you mean {shown(names[near[0]])}? " if near else ""
