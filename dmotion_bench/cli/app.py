"""The Typer application, and the one place where errors become sentences and exit codes.

Exit codes: 0 done, 1 failed, 2 wrong usage, 75 ended because another process of the same training did, 130 interrupted
by Ctrl-C, 143 by SIGTERM, 129 by a closed terminal.
"""

from __future__ import annotations

import contextlib
import importlib
import logging
import os
import re
import sys
from collections.abc import Iterator
from typing import NoReturn

import typer

from dmotion_bench import __version__
from dmotion_bench.cli.misuse import Misuse, is_help, told
from dmotion_bench.errors import DmbenchError, Interrupted, ProcessLost, UsageError
from dmotion_bench.execution.processes import LOST, is_led
from dmotion_bench.execution.refusals import refused
from dmotion_bench.interrupts import INTERRUPTED, exit_code, received
from dmotion_bench.storage.limits import LONGEST_TEXT
from dmotion_bench.wording import sentence, shown
from dmotion_bench.workspace import CACHE_VARIABLE

app = typer.Typer(
    name="dmbench",
    help="Compare models that predict the next camera image, learned from robot video without action labels.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"], "max_content_width": 100},
)

COMMANDS = (
    "demo",
    "record",
    "data",
    "train",
    "score",
    "plan",
    "play",
    "view",
    "leaderboard",
    "share",
    "reproduce",
    "list_names",
    "bench",
    "info",
)
"""Modules of this package, in the order of ``dmbench --help``; each has ``register(app)``."""


def _version(value: bool) -> None:
    if value:
        typer.echo(f"dmbench {__version__}")
        raise typer.Exit


@app.callback()
def dmbench(
    version: bool = typer.Option(
        False, "--version", help="Print the version and exit.", callback=_version, is_eager=True
    ),
) -> None:
    """Compare models that predict the next camera image, learned from robot video without action labels."""


def register_commands() -> None:
    """Add every command to the application, once."""
    if app.registered_commands:
        return
    for name in COMMANDS:
        importlib.import_module(f"dmotion_bench.cli.{name}").register(app)


def main() -> None:
    """Run the command that was typed; print an error as one sentence."""
    try:
        _require_text()
        with _log_on_stderr():
            register_commands()
            sys.exit(app(prog_name="dmbench", standalone_mode=False) or 0)
    except Misuse as error:
        if is_help(error):
            error.show()
            raise SystemExit(error.exit_code) from None
        _fail(told(error), error.exit_code)
    except typer.Abort:  # what Typer makes of an EOFError
        _fail("aborted.", 1)
    except UsageError as error:
        _fail(str(error), 2)
    except ProcessLost as error:
        _fail("" if is_led() else str(error), LOST, at_once=True)
    except Interrupted as error:
        _fail(str(error), exit_code())
    except DmbenchError as error:
        _fail(str(error), 1)
    except (MemoryError, RuntimeError) as error:
        if (said := _out_of_memory(error)) is None:
            raise
        _fail(said, 1)
    except BrokenPipeError:
        sys.stderr.close()
        raise SystemExit(1) from None
    except OSError as error:
        _fail(refused(error), 1)
    except KeyboardInterrupt:
        _fail("" if is_led() else INTERRUPTED, exit_code())
    except SystemExit as leaving:
        if leaving.code == 130:  # what Typer makes of an interruption, without a word
            _fail("" if is_led() else INTERRUPTED, exit_code())
        if not leaving.code and received():  # a server or a viewer, which ends when it is told to
            _fail("ended.", exit_code())
        raise


def _out_of_memory(error: MemoryError | RuntimeError) -> str | None:
    """A sentence for an error that says that memory did not suffice, as torch says it in a RuntimeError; else None."""
    said = str(error)
    if not isinstance(error, MemoryError) and "can't allocate memory" not in said and "out of memory" not in said:
        return None
    asked = re.search(r"tried to allocate (\d+) bytes", said)
    size = f": {int(asked[1]) / 2**30:,.1f} GiB were asked for at once" if asked else ""
    return f"the memory does not suffice for this{size}; take a smaller model, batch or data set."


def _fail(said: str, code: int, *, at_once: bool = False) -> NoReturn:
    """Say it and exit; at once, without what Python does at its end.

    There torch may wait for a thread of gloo that was just told of a lost process, and hold the lock that this thread
    waits for. Such a process would stay for ever.
    """
    with contextlib.suppress(OSError):  # who closed stderr does not want to know
        if said:  # else whoever started this process says it
            print(f"dmbench: {sentence(said)}", file=sys.stderr, flush=True)  # noqa: T201 (the command's own voice)
    if at_once:
        with contextlib.suppress(OSError, ValueError):
            sys.stdout.flush()
        os._exit(code)
    raise SystemExit(code)


def _require_text() -> None:
    """See that every name can be written into a file and printed.

    Raises:
        UsageError: The working folder is gone, or a name is not UTF-8.
    """
    try:
        folder = os.getcwd()  # noqa: PTH109 (as it is, not as a path)
    except FileNotFoundError:
        raise UsageError("the working folder was deleted; change into one that is there.") from None
    given = [("the argument", word) for word in sys.argv[1:]]
    given += [(name, os.environ.get(name, "")) for name in ("DMBENCH_WORKSPACE", CACHE_VARIABLE)]
    if any(len(text) > LONGEST_TEXT for _, text in given):
        raise UsageError(f"an argument is longer than {LONGEST_TEXT:,} characters, which no name and no path is.")
    for what, text in (*given, ("the working folder", folder)):
        try:
            text.encode()
        except UnicodeEncodeError:
            raise UsageError(
                f"{what} {shown(text)} is not UTF-8 text, which all that dmbench writes is; rename it, or reach it by "
                "a symbolic link of another name."
            ) from None


@contextlib.contextmanager
def _log_on_stderr() -> Iterator[None]:
    """What the library logs is said in the command line's voice."""
    log, handler = logging.getLogger("dmotion_bench"), logging.StreamHandler()
    handler.setFormatter(logging.Formatter("dmbench: %(message)s"))
    log.addHandler(handler)
    try:
        yield
    finally:
        log.removeHandler(handler)
