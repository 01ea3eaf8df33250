"""Tables on stdout, for a terminal and for a pipe."""

from __future__ import annotations

import os
import textwrap
from collections.abc import Iterable, Sequence

import typer
from rich.box import SIMPLE_HEAD
from rich.cells import cell_len
from rich.console import Console
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from dmotion_bench.wording import printable

ENDLESS = 10_000
"""Columns of what has no edge."""
_BETWEEN, _EDGES = 3, 2
"""Terminal columns between two columns of a table, and at its edges together."""
HEADING = 16
"""Columns from which on a figure's heading takes several lines on a terminal."""


def stdout_console() -> Console:
    """A console that takes every text as it is, and neither folds nor cuts what goes to a file or a pipe.

    Where the variable COLUMNS says how wide a file or a pipe is, it is taken for a terminal of that width.
    """
    console = Console(highlight=False, markup=False)
    if not (console.is_terminal or os.environ.get("COLUMNS", "").isdigit()):
        console.width = ENDLESS
    return console


def _printable(row: Iterable[str]) -> list[str]:
    return [printable(cell) for cell in row]


def _print(console: Console, table: Table) -> None:
    """Print a table; outside a terminal without blanks at the ends of its lines."""
    if console.is_terminal:
        console.print(table)
        return
    with console.capture() as captured:
        console.print(table)
    for line in captured.get().splitlines():
        typer.echo(line.rstrip())


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
    headings, rows = _printable(headings), [_printable(row) for row in rows]
    first = 1
    while first < len(headings):
        last = len(headings)
        while last > first + 1 and not _fits(console, _figures(console, headings, rows, range(first, last), below)):
            last -= 1
        table = _figures(console, headings, rows, range(first, last), below)
        table.title = printable(title) if first == 1 else None
        _print(console, table)
        first = last


def _figures(
    console: Console, headings: Sequence[str], rows: Sequence[Sequence[str]], columns: range, below: int
) -> Table:
    """A table of some of the columns, after the first, which folds where it would take more than half the room."""
    table = _table()
    table.add_column(headings[0], overflow="fold", max_width=console.width // 2)
    widest = HEADING if console.width < ENDLESS else ENDLESS
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
    """Print rows of text under their headings.

    On a narrow terminal cells take several lines, and where not even the longest words fit beside each other, each row
    becomes lines of its own. So names stay whole.

    Args:
        headings: Of the columns.
        rows: A text for each column.
        right: Headings whose columns are set to the right.
    """
    console, names, cells = stdout_console(), _printable(headings), [_printable(row) for row in rows]
    columns = [[name, *column] for name, column in zip(names, zip(*cells, strict=True), strict=True)]
    widths = _widths(columns, console.width - _EDGES - _BETWEEN * (len(names) - 1))
    if widths is None:
        _show_records(console, names, cells)
        return
    table = _table()
    for name, width in zip(names, widths, strict=True):
        table.add_column(name, justify="right" if name in right else "left", width=width)
    for row in cells:
        table.add_row(*row)
    _print(console, table)


def _widths(columns: Sequence[Sequence[str]], room: int) -> list[int] | None:
    """The widths of columns of text in so much room, by narrowing the widest; None if their words do not fit."""
    least = [max((cell_len(word) for text in column for word in text.split()), default=0) for column in columns]
    widths = [max(cell_len(text) for text in column) for column in columns]
    while sum(widths) > room:
        spare = [width if width > enough else 0 for width, enough in zip(widths, least, strict=True)]
        if not any(spare):
            return None
        widths[spare.index(max(spare))] -= 1
    return widths


def _show_records(console: Console, headings: Sequence[str], rows: Sequence[Sequence[str]]) -> None:
    """Print each row as a line with its name, and a line for each other cell below it."""
    for row in rows:
        table = Table.grid(padding=(0, 2))
        table.add_column()
        table.add_column(overflow="fold")
        for heading, cell in zip(headings[1:], row[1:], strict=True):
            table.add_row(f"  {heading}", cell)
        console.print(Text(row[0], overflow="fold"))
        _print(console, table)
