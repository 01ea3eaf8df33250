"""Tables on stdout, for a terminal and for a pipe."""

from __future__ import annotations

import textwrap
from collections.abc import Iterable, Sequence

from rich.box import SIMPLE_HEAD
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table

ENDLESS = 10_000
"""Columns of what has no edge."""
HEADING = 16
"""Columns from which on a figure's heading takes several lines on a terminal."""


def stdout_console() -> Console:
    """A console that takes every text as it is, and neither folds nor cuts what goes to a file or a pipe."""
    console = Console(highlight=False, markup=False)
    if not console.is_terminal:
        console.width = ENDLESS
    return console


def _table(title: str | None = None) -> Table:
    """A table without columns yet, with a line under its head alone."""
    return Table(title=title, title_justify="left", box=SIMPLE_HEAD, pad_edge=False)


def show_figures(title: str, headings: Sequence[str], rows: Sequence[Sequence[str]], *, below: int = 0) -> None:
    """Print rows of figures, which are never cut nor folded, under the names of their columns.

    What is wider than the terminal is printed in parts, one below the other, each with the first column.

    Args:
        title: Of the table.
        headings: Of the columns, the first that of the rows' names.
        rows: A text for each column.
        below: So many of the last rows are set apart.
    """
    console = stdout_console()
    first = 1
    while first < len(headings):
        last = len(headings)
        while last > first + 1 and not _fits(console, _figures(console, headings, rows, range(first, last), below)):
            last -= 1
        table = _figures(console, headings, rows, range(first, last), below)
        table.title = title if first == 1 else None
        console.print(table)
        first = last


def _figures(
    console: Console, headings: Sequence[str], rows: Sequence[Sequence[str]], columns: range, below: int
) -> Table:
    """A table of some of the columns, after the first, which folds where it would take more than half the room."""
    table = _table()
    table.add_column(headings[0], overflow="fold", max_width=console.width // 2)
    widest = min(HEADING if console.is_terminal else ENDLESS, console.width)
    for column in columns:
        table.add_column("\n".join(textwrap.wrap(headings[column], widest)), justify="right", no_wrap=True)
    for place, row in enumerate(rows):
        if below and place == len(rows) - below:
            table.add_section()
        figures = [row[column] for column in columns]
        if any(figures):
            table.add_row(row[0], *figures)
    return table


def _fits(console: Console, table: Table) -> bool:
    endless = console.options.update_width(ENDLESS)
    return Measurement.get(console, endless, table).maximum <= console.width


def show_rows(headings: Iterable[str], rows: Iterable[Iterable[str]], *, right: frozenset[str] = frozenset()) -> None:
    """Print rows of text under their headings; on a narrow terminal cells are folded, so that names stay whole.

    Args:
        headings: Of the columns.
        rows: A text for each column.
        right: Headings whose columns are set to the right.
    """
    table = _table()
    for heading in headings:
        table.add_column(heading, justify="right" if heading in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*row)
    stdout_console().print(table)
