"""What was typed wrong, in a sentence: Typer says which bound a value breaks, and not which value.

Typer may have click, or a copy of it with other errors of the same names: they are known by their base class.
"""

from __future__ import annotations

from typing import Any, Final

import typer

from dmotion_bench.wording import command, shown

Misuse: Final[Any] = typer.BadParameter.__base__
"""``UsageError`` of click, or of the copy of it that Typer has."""


def is_help(error: Any) -> bool:
    """Whether nothing was typed behind a command, which is answered with its help."""
    return type(error).__name__ == "NoArgsIsHelpError"


def told(error: Any) -> str:
    """The sentence: what was given, what is allowed, and which command explains it."""
    said = str(error.format_message()).rstrip(".")
    faults: list[dict[str, Any]] = getattr(error.__cause__, "errors", list)()  # of pydantic, in newer versions of Typer
    if faults:
        option, _, rule = said.removeprefix("Invalid value for ").partition(": Input should ")
        said = f"{option} is {shown(faults[0]['input'])}; it should {rule.partition(',')[0]}"
    end = "" if said.endswith("?") else "."
    explained = "" if error.ctx is None else f" See {command(f'{error.ctx.command_path} -h')}."
    return f"{said[:1].lower()}{said[1:]}{end}{explained}"
