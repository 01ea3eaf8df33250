"""Docstrings as mkdocstrings reads them, and annotations as they stand in the source.

Ours are of Google's style but for three habits: ``Example:`` holds one example, ``::`` begins a listing, and one line
may explain several names.
"""

from __future__ import annotations

import dataclasses
import re
from typing import Any, Final

import griffe

_SHAPED: Final = {"Float", "Int", "Bool", "UInt8", "Shaped", "Num"}
"""jaxtyping's annotations: the text in their brackets names axes and is no annotation itself."""

_TOGETHER: Final = re.compile(
    r"^(?P<room> +)(?P<names>\*{0,2}\w+(?:, \*{0,2}\w+)+): (?P<text>.*(?:\n(?P=room) +.*)*)", re.M
)
"""A line that explains several names at once, with the lines that go on with it."""

_SECTIONS: Final = re.compile(r"(?<=\n)(Args|Attributes|Raises):\n(?P<lines>(?:[ \t]+\S.*\n?|\n(?=[ \t]+\S))+)")


class Docstrings(griffe.Extension):
    """Rewrites each docstring and annotation before it is shown."""

    def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
        """Called for every module, class, function and attribute."""
        if obj.docstring is not None:
            obj.docstring.value = readable(obj.docstring.value)
        if isinstance(obj, griffe.Function):
            _quote_axes(obj.returns)
            for parameter in obj.parameters:
                _quote_axes(parameter.annotation)
        if isinstance(obj, griffe.Attribute):
            _quote_axes(obj.annotation)
            _quote_axes(obj.value)


def readable(docstring: str) -> str:
    """A docstring without our habits."""
    text = re.sub(r"^( *)Example:$", r"\1Examples:", docstring, flags=re.MULTILINE)
    text = re.sub(r"^( *)::$\n\n", r"\n", text, flags=re.MULTILINE)
    text = re.sub(r"(?<=\w)::\n\n(?=    )", ":\n\n", text)
    return _SECTIONS.sub(lambda found: _TOGETHER.sub(_apart, found[0]), text)


def _apart(found: re.Match[str]) -> str:
    return "\n".join(f"{found['room']}{name}: {found['text']}" for name in found["names"].split(", "))


def _quote_axes(expression: object) -> None:
    """Put the axes of jaxtyping back into quotes: a single one, such as ``"b"``, was read as a name."""
    if not isinstance(expression, griffe.Expr):
        return
    if (
        isinstance(expression, griffe.ExprSubscript)
        and str(expression.left) in _SHAPED
        and isinstance(expression.slice, griffe.ExprTuple)
    ):
        kind, *axes = expression.slice.elements
        expression.slice.elements = [kind, *(f'"{str(one).strip(chr(39) + chr(34)).strip()}"' for one in axes)]
        return
    for field in dataclasses.fields(expression):
        part = getattr(expression, field.name)
        for one in part if isinstance(part, list | tuple) else [part]:
            _quote_axes(one)
