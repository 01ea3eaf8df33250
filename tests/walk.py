"""A page of the documentation as a reader follows it: files are saved, commands typed, Python run.

What a block is, is said by its first line::

    ```python title="mine.py"    saved as mine.py in the working folder; so with toml and others
    ```console                   a line '$ COMMAND' is typed; the lines below are what it prints
    ```pycon                     run as a doctest; names live on until the end of the page
    ```text                      shown, not run

What is printed is compared apart from numbers and from how wide columns are; ``...`` stands for any text.
"""

from __future__ import annotations

import doctest
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final, Literal

BLOCK: Final = re.compile(r"^```(\w*)(?: title=\"([^\"]+)\")?\n(.*?)^```$", re.MULTILINE | re.DOTALL)
_COMMAND: Final = re.compile(r"^\$ (.+)\n((?:(?!\$ ).*\n)*)", re.MULTILINE)
_NUMBER: Final = re.compile(r"[-+]?\d[\d,.]*(?:e[-+]\d+)?")
_PRECISION: Final = re.compile(r"\b(?:bf16|float32)\b")  # a training takes the one that its processor is faster in


@dataclass(frozen=True, kw_only=True)
class Step:
    """One thing that a reader does.

    Attributes:
        kind: What.
        text: The command, the code, or the content of the file.
        expected: What a command prints, empty where the page does not show it.
        name: Of the file.
    """

    kind: Literal["command", "python", "file"]
    text: str
    expected: str = ""
    name: str = ""


def steps(page: str) -> Iterator[Step]:
    """What a reader of this page does, from top to bottom.

    Raises:
        ValueError: A block is of no known kind, so nobody would notice that it is wrong.
    """
    for kind, name, text in BLOCK.findall(page):
        if name:
            yield Step(kind="file", text=text, name=name)
        elif kind == "console":
            for command, expected in _COMMAND.findall(text):
                yield Step(kind="command", text=command.partition("  #")[0].strip(), expected=expected)
        elif kind == "pycon":
            yield Step(kind="python", text=text)
        elif kind != "text":
            raise ValueError(f"a block of the kind {kind!r} without a title is not run: {text[:60]!r}")


def run_python(code: str, names: dict[str, Any], where: str) -> int:
    """Run a doctest and keep its names; returns how many examples it had."""
    said: list[str] = []
    test = doctest.DocTestParser().get_doctest(code, names, where, where, 0)
    runner = doctest.DocTestRunner(optionflags=doctest.FAIL_FAST | doctest.ELLIPSIS)
    runner.run(test, out=said.append, clear_globs=False)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
    names.update(test.globs)
    return len(test.examples)


def save(step: Step, folder: Path) -> None:
    """Save a file as the page says."""
    file = folder / step.name
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(step.text)


def assert_printed(expected: str, printed: str, where: str) -> None:
    """Whether a command prints what the page shows."""
    wanted, got = _compared(expected), _compared(printed)
    pattern = ".*".join(re.escape(part) for part in wanted.split("..."))
    assert re.fullmatch(pattern, got, re.DOTALL), f"{where}\nthe page shows:\n{expected}\nit prints:\n{printed}"


def _compared(text: str) -> str:
    plain = _NUMBER.sub("#", _PRECISION.sub("precision", text.replace("...", "\0")))
    lines = [re.sub(r"[\s─]+", " ", line).strip() for line in plain.splitlines()]
    return "\n".join(line for line in lines if line).replace("\0", "...")
