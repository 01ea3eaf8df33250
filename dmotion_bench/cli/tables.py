"""Tables on stdout, for a terminal and for a pipe."""

from __future__ import annotations

from collections.abc import Iterable

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.table import Table

ENDLESS = 10_000
"""Columns of what has no edge."""


def stdout_console() -> Console:
    """A console that takes every text as it is, and neither folds nor cuts what goes to a file or a pipe."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = ENDLESS
    return console


def plain_table(title: str | None = None) -> Table:
    """A table without columns yet, with a line under its head alone."""
    return Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)


def show_rows(headings: Iterable[str], rows: Iterable[Iterable[str]], *, right: frozenset[str] = frozenset()) -> None:
    """Print rows of text under their headings; on a narrow terminal cells are folded, so that names stay whole.

    Args:
        headings: Of the columns.
        rows: A text for each column.
        right: Headings whose columns are set to the right.
    """
    table = plain_table()
    for heading in headings:
        table.add_column(heading, justify="right" if heading in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    stdout_console().print(table)
