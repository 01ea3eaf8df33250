"""Writes the results into documentation pages, so that no figure there is typed by hand.

A page asks for results by a pair of comments, which a reader does not see; what stands between them is replaced::

    <!-- results:boards -->      every board with its tables, then what was published
    <!-- results:summary -->     the summary across worlds
    <!-- results:model:NAME -->  the rows of one model on all boards; its charts become files of ``curves/`` beside it
    <!-- results:chosen -->      the table of the chosen rows (``chosen.py``)
    <!-- results:NAME.interval -->   one number of a chosen row, within a sentence
    <!-- /results -->            the end of each
"""

from __future__ import annotations

import re
import textwrap
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Final

from dmotion_bench.errors import UnknownName, UsageError
from dmotion_bench.registry import model_names
from dmotion_bench.storage.atomic import write_atomically
from leaderboard.board import Board, make_boards
from leaderboard.board_tables import board_section, published_section
from leaderboard.chosen import chosen_table, find_rows, numbers, read_choices
from leaderboard.entry_file import read_entries
from leaderboard.layout import CHOSEN, ENTRIES
from leaderboard.markdown import WIDTH
from leaderboard.model_results import CURVES, model_charts, model_lines
from leaderboard.row import EACH_MEANING
from leaderboard.summary import summarise
from leaderboard.summary_section import summary_lines

_ASKED: Final = re.compile(r"(<!-- results:(\S+) -->)(.*?)(<!-- /results -->)", re.DOTALL)
_OF_MODEL: Final = "model:"
_OPENED: Final = re.compile(r"<!-- /?results\b")


def write_results(folder: Path, pages: Sequence[Path], *, check: bool = False) -> list[Path]:
    """Write the results of a leaderboard into pages.

    Args:
        folder: Of the leaderboard: its entries, and which rows are chosen.
        pages: Markdown files that ask for results.
        check: Write nothing.

    Returns:
        The pages and charts that were changed or, of a check, that differ from the entries.

    Raises:
        UsageError: A page cannot be read, asks for nothing, or leaves a comment open; the chosen rows are not there.
        UnknownName: A page asks for something that there is not.
        EntryInvalid: An entry cannot be read.
    """
    entries = read_entries(folder / ENTRIES)
    if not entries:
        raise UsageError(f"{str(folder)!r} holds no entries; make them with 'dmbench leaderboard build'.")
    boards = make_boards(entries)
    rows = find_rows(read_choices(folder / CHOSEN), boards) if (folder / CHOSEN).is_file() else []
    summary = summarise(boards)
    blocks = {"boards": _every_board(boards)} | ({"chosen": chosen_table(rows)} if rows else {})
    blocks |= {} if summary is None else {"summary": summary_lines(summary)}
    blocks |= {f"{_OF_MODEL}{model}": model_lines(model, boards) for model in model_names()}
    found = {name: f"\n{chr(10).join(lines)}\n" for name, lines in blocks.items()} | dict(numbers(rows))
    changed = []
    for page in pages:
        text = _read(page)
        for file, old, new in [(page, text, filled(text, found, str(page))), *_charts(page, text, boards)]:
            if new != old:
                changed.append(file)
                if not check:
                    file.parent.mkdir(exist_ok=True)
                    write_atomically(file, new.encode())
    return changed


def _charts(page: Path, text: str, boards: Sequence[Board]) -> list[tuple[Path, str, str]]:
    """The charts that a page shows: where each is, what is there, and what has to be there."""
    models = [found[2].removeprefix(_OF_MODEL) for found in _ASKED.finditer(text) if found[2].startswith(_OF_MODEL)]
    made = {name: chart for model in models for name, chart in model_charts(model, boards).items()}
    files = {page.parent / CURVES / name: chart for name, chart in made.items()}
    return [(file, file.read_text() if file.is_file() else "", chart) for file, chart in files.items()]


def filled(text: str, found: Mapping[str, str], page: str) -> str:
    """A page's text with results in the places that ask for them.

    Args:
        text: Of the page.
        found: What there is to ask for, by name.
        page: Its name, for errors.

    Raises:
        UsageError: It asks for nothing, or leaves a comment open.
        UnknownName: It asks for something that there is not.
    """
    places = list(_ASKED.finditer(text))
    if not places or len(_OPENED.findall(text)) != 2 * len(places):
        raise UsageError(
            f"{page!r} has no place for results, or one that does not end: a place begins with "
            "'<!-- results:NAME -->' and ends with '<!-- /results -->'."
        )
    for place in places:
        if place[2] not in found:
            raise UnknownName("result", place[2], found)
    return _ASKED.sub(lambda place: f"{place[1]}{found[place[2]]}{place[4]}", text)


def _read(page: Path) -> str:
    try:
        return page.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise UsageError(f"the page {str(page)!r} cannot be read: {error}.") from None


def _every_board(boards: Sequence[Board]) -> list[str]:
    lines = ["", *textwrap.wrap(EACH_MEANING, WIDTH)]
    for board in boards:
        if board.measured or board.control is not None:
            lines += ["", *board_section(board)]
    published = {board.environment: board for board in boards if any(row.kind == "published" for row in board.rows)}
    for board in published.values():
        lines += ["", *published_section(board)]
    return [*lines, ""]
