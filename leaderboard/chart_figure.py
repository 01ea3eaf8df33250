"""What the charts of a board share: a chart with its numbers as a table, and the points and guides of its rows."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from leaderboard.board import Board
from leaderboard.chart import Guide, Point, Style
from leaderboard.markup import Markup, element, joined
from leaderboard.row import Row

Styles = Mapping[tuple[str, str], Style]
"""By model and variant."""


def chart_figure(chart: Markup, title: str, numbers: Markup, note: str = "") -> Markup:
    """A chart under its title, with its numbers folded away; the board's name behind the title's colon is left out."""
    kind = title.partition(":")[0]
    return element(
        "figure",
        element("figcaption", element("b", kind), f" {note}" if note else None),
        chart,
        element("details", element("summary", "The numbers"), numbers),
    )


def chart_numbers(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> Markup:
    """The numbers of a chart as a table; the first of each row is what the row is called."""
    head = element("tr", *(element("th", heading, scope="col") for heading in headings))
    body = [
        element("tr", element("th", first, scope="row"), *(element("td", text) for text in rest))
        for first, *rest in rows
    ]
    table = element("table", element("thead", head), element("tbody", joined(body)))
    return element("div", table, class_="scroll", tabindex=0, role="region", aria_label="Numbers of the chart")


def point_of(x: float, row: Row, figure: str) -> Point:
    """A figure of a row as a point; its bar is the 95% interval, where that is known."""
    value = row.figures[figure]
    low, high = value.interval or (None, None)
    return Point(x=x, y=value.mean, low=low, high=high)


def reference_guides(board: Board, figure: str) -> list[Guide]:
    """A figure of each reference as a line to measure by."""
    return [
        Guide(row.name, row.figures[figure].mean)
        for row in board.rows
        if row.kind == "reference" and figure in row.figures
    ]
