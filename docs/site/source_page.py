"""The page of a file that other pages link to: its lines, highlighted, each with an anchor such as ``#L41``."""

from __future__ import annotations

import html
from pathlib import Path
from typing import Final

from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import TextLexer, get_lexer_for_filename
from pygments.util import ClassNotFound

MOST_BYTES: Final = 400_000
"""A larger file is not shown: its page says where it is."""


def source_html(file: Path) -> str:
    """A file's lines as HTML; what is no text, or too long, is named only."""
    try:
        text = file.read_text() if file.stat().st_size <= MOST_BYTES else None
    except UnicodeDecodeError:
        text = None
    if text is None:
        return f"<p>A file of {file.stat().st_size:,} bytes, in the repository.</p>"
    try:
        lexer = get_lexer_for_filename(file.name, stripnl=False)
    except ClassNotFound:
        lexer = TextLexer(stripnl=False)
    lines = highlight(text, lexer, HtmlFormatter(nowrap=True)).rstrip("\n").split("\n")
    shown = "".join(
        f'<span class="line" id="L{number}"><a href="#L{number}" data-line="{number}" aria-label="Line {number}"></a>'
        f"{line}\n</span>"
        for number, line in enumerate(lines, start=1)
    )
    return f'<div class="highlight source"><pre><code>{shown}</code></pre></div>'


def folder_html(folder: Path, names: list[str], known: dict[str, str]) -> str:
    """A folder's files as a list.

    Args:
        folder: The folder.
        names: The paths of its files below it.
        known: Addresses of those that have a page.
    """
    items = [
        f'<li><a href="{html.escape(known[name])}"><code>{html.escape(name)}</code></a></li>'
        if name in known
        else f"<li><code>{html.escape(name)}</code></li>"
        for name in names
    ]
    return f"<p>{len(names)} files of the folder <code>{html.escape(folder.name)}</code>:</p><ul>{''.join(items)}</ul>"
