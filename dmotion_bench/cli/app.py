"""The Typer application, and the one place where errors become sentences and exit codes.

Exit codes: 0 done, 1 failed, 2 wrong usage, 130 interrupted.
"""

from __future__ import annotations

import errno
import importlib
import sys
from typing import NoReturn

import typer

from dmotion_bench import __version__
from dmotion_bench.errors import DmbenchError, Interrupted, StorageFull, UsageError
from dmotion_bench.storage.atomic import FULL

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
    "list_names",
    "bench",
    "info",
)
"""Modules of this package, in the order of ``dmbench --help``; each has ``register(app)``."""


IN_THE_WAY = (errno.ENOTDIR, errno.EISDIR, errno.EEXIST, errno.ENAMETOOLONG, errno.ELOOP, errno.EINVAL)
"""Error numbers of paths at which the file or folder cannot be created or read."""

INTERRUPTED = "interrupted; run the same command again to go on where it stopped."


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


def _short(path: object) -> str:
    text = str(path)
    return text if len(text) <= 100 else f"{text[:60]}...{text[-20:]}"


def _fail(sentence: str, code: int) -> NoReturn:
    print(f"dmbench: {sentence}", file=sys.stderr)  # noqa: T201 (the command line's own voice)
    raise SystemExit(code)


def main() -> None:
    """Run the command that was typed; print an error as one sentence."""
    try:
        register_commands()
        app(prog_name="dmbench", standalone_mode=True)
    except UsageError as error:
        _fail(str(error), 2)
    except Interrupted as error:
        _fail(str(error), 130)
    except DmbenchError as error:
        _fail(str(error), 1)
    except BrokenPipeError:
        sys.stderr.close()
        raise SystemExit(1) from None
    except OSError as error:
        if error.errno in FULL:
            _fail(
                str(
                    StorageFull(
                        f"no space left on the device while writing {error.filename or 'a file'!r}; "
                        "free some and run the same command again: it goes on where it stopped."
                    )
                ),
                1,
            )
        if error.errno in (errno.EACCES, errno.EPERM, errno.EROFS):
            _fail(f"may not write or read {error.filename!r}: {error.strerror}.", 1)
        if error.errno in IN_THE_WAY and error.filename is not None:
            _fail(f"cannot write or read {_short(error.filename)!r}: {error.strerror}; name another path.", 1)
        raise
    except KeyboardInterrupt:
        _fail(INTERRUPTED, 130)
    except SystemExit as leaving:
        if leaving.code == 130:  # what Typer makes of Ctrl-C, without a word
            _fail(INTERRUPTED, 130)
        raise
