"""What commands print on stdout.

``--json`` prints one object alone: what environments, models and libraries print meanwhile goes to stderr."""

from __future__ import annotations

import contextlib
import json
import math
import os
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final, TextIO

import typer

from dmotion_bench.wording import printable

_STDOUT: Final = 1
_STDERR: Final = 2


@dataclass(frozen=True, kw_only=True)
class _Reserved:
    """What was stdout before: of the process, and in Python."""

    file: int
    stream: TextIO


_reserved: list[_Reserved] = []
"""The innermost last; there is one stdout in a process."""


def reserve_stdout(context: typer.Context, as_json: bool) -> bool:
    """The callback of ``--json``: until the command ends, whatever is printed goes to stderr, in Python or below it.

    Processes that the command starts inherit that.
    """
    if as_json and not context.resilient_parsing:
        context.with_resource(_reserving())
    return as_json


def say(text: object = "", *, err: bool = False, nl: bool = True) -> None:
    """Print a text, without what a terminal takes as an order: names in it may come from anybody.

    Args:
        text: It.
        err: Whether on stderr.
        nl: Whether the line ends after it.
    """
    typer.echo(printable(str(text)), err=err, nl=nl)


def print_json(value: Any) -> None:
    """Print the object that the command was asked for; a number that JSON has no word for is null in it."""
    with own_stdout():
        typer.echo(json.dumps(_finite(value), allow_nan=False))


def _finite(value: Any) -> Any:
    """A value with None in place of each NaN and infinity."""
    if isinstance(value, dict):
        return {name: _finite(one) for name, one in value.items()}
    if isinstance(value, list | tuple):
        return [_finite(one) for one in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


@contextlib.contextmanager
def own_stdout() -> Iterator[None]:
    """The command's own stdout again, for its object or for a process that is to print it."""
    if not _reserved:
        yield
        return
    with _printing_to(_reserved[-1].file, _reserved[-1].stream):
        yield


@contextlib.contextmanager
def _reserving() -> Iterator[None]:
    try:
        own = os.dup(_STDOUT)
    except OSError:  # it is closed
        yield
        return
    _reserved.append(_Reserved(file=own, stream=sys.stdout))
    try:
        with _printing_to(_STDERR, sys.stderr):
            yield
    finally:
        _reserved.pop()
        os.close(own)


@contextlib.contextmanager
def _printing_to(file: int, stream: TextIO) -> Iterator[None]:
    """Whatever is printed meanwhile goes there."""
    before = os.dup(_STDOUT)
    _flush()
    os.dup2(file, _STDOUT)
    try:
        with contextlib.redirect_stdout(stream):
            yield
            _flush()
    finally:
        _flush()
        os.dup2(before, _STDOUT)
        os.close(before)


def _flush() -> None:
    """Write what Python and C libraries hold back; each has a buffer of its own."""
    if sys.stdout is not None:  # it is None in a process that was started without
        sys.stdout.flush()
    import ctypes  # other commands start without it

    with contextlib.suppress(OSError, AttributeError, TypeError):  # Windows has no library of this name
        ctypes.CDLL(None).fflush(None)
