"""A notebook as a page: its text, its code, and what the code gave."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


def as_markdown(notebook: Path) -> str:
    """The cells of a notebook, in order."""
    return "\n\n".join(_cell(cell) for cell in json.loads(notebook.read_text())["cells"]) + "\n"


def _cell(cell: dict[str, Any]) -> str:
    source = _text(cell["source"])
    if cell["cell_type"] != "code":
        return source
    return "\n\n".join([_fenced(source, "python"), *map(_output, cell.get("outputs", []))])


def _output(output: dict[str, Any]) -> str:
    data = output.get("data", {})
    for kind in ("image/png", "image/jpeg"):
        if kind in data:
            return f"![What the code above shows](data:{kind};base64,{''.join(_text(data[kind]).split())})"
    if "text/markdown" in data:
        return _text(data["text/markdown"])
    said = output.get("text") or data.get("text/plain") or output.get("evalue", "")
    return _fenced(_text(said), "text")


def _text(value: str | list[str]) -> str:
    return value if isinstance(value, str) else "".join(value)


def _fenced(text: str, language: str) -> str:
    return f"````{language}\n{text.rstrip()}\n````"
