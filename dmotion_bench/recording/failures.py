"""What somebody else's environment or policy raises, as a sentence: it may raise anything at any time."""

from __future__ import annotations

import contextlib
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

from dmotion_bench.errors import DmbenchError, RecordingFailed


def said(error: BaseException) -> str:
    """What an error says, in one line."""
    return " ".join(f"{type(error).__name__}: {error}".split()).removesuffix(":").removesuffix(".")


def failed(who: str, what: str, when: str, error: BaseException) -> RecordingFailed:
    """The error for what was raised in the middle of an episode, with the line of code that raised it.

    Args:
        who: The environment, as it is named in sentences.
        what: Its method.
        when: Step and seed.
        error: What was raised.
    """
    place, text = traceback.extract_tb(error.__traceback__)[-1], " ".join(str(error).split()).rstrip(".")
    return RecordingFailed(
        f"{who} raised {type(error).__name__} in {what} {when}{': ' if text else ''}{text} "
        f"({Path(place.filename).name}, line {place.lineno}). Mend the environment, or give it other settings with "
        "'--set'."
    )


@contextlib.contextmanager
def guarded(who: str, what: str, when: Callable[[], str]) -> Iterator[None]:
    """Turn what is raised in the block into a sentence; ``when`` is asked only then."""
    try:
        yield
    except (DmbenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:
        raise failed(who, what, when(), error) from error
