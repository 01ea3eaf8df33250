"""Pictures of predictions: the same held-out steps for every model of a board, one row per model."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, Final

from dmotion_bench.errors import EntryInvalid
from leaderboard.board import Board
from leaderboard.entry import Entry
from leaderboard.markup import Markup, element, joined
from leaderboard.pictures import identity, shown
from leaderboard.row import Row
from leaderboard.usual import most_common

BUDGET: Final = 1_800_000
"""Characters of pictures on a page."""
LEFT_OUT: Final = "left out, for the size of the page"


def fitting_steps(boards: Sequence[Board], budget: int) -> tuple[list[int], int]:
    """How many steps of each board fit, and the characters that they take.

    Every board gets its first step before one gets its second. Where not all fit, those that take least go first.

    Args:
        boards: Of the page.
        budget: Characters for all pictures.
    """
    sizes = [_sizes(board) for board in boards]
    counts, taken = [0] * len(boards), 0
    for step in range(max(map(len, sizes), default=0)):
        waiting = [place for place, own in enumerate(sizes) if counts[place] == step < len(own)]
        for place in sorted(waiting, key=lambda place: sizes[place][step]):
            if taken + sizes[place][step] <= budget:
                counts[place] += 1
                taken += sizes[place][step]
    return counts, taken


def _sizes(board: Board) -> list[int]:
    """The characters of the pictures of each step."""
    rows = _pictured(board)
    return [
        len(step["current"])
        + len(step["truth"])
        + sum(len(own["predicted"]) for row in rows for own in _of(row.entries[0], [step]) if own)
        for step in _steps(board)
    ]


def gallery(board: Board, steps: int) -> Markup | None:
    """The first steps of the pictures of a board, and how many are left out; None where no entry has any."""
    shown_by, rows = _shown_by(board), _pictured(board)
    if shown_by is None:
        return None
    every = _steps(board)
    chosen = every[:steps]
    missing = "The pictures are" if not chosen else f"{len(every) - steps} of {len(every)} steps are"
    left_out = f"{missing} {LEFT_OUT}; the entries hold them." if len(chosen) < len(every) else ""
    steps_shown = [_step(picture, shown_by, rows) for picture in chosen]
    return element(
        "section",
        element("h3", "What the models predict"),
        element(
            "p",
            "The same held-out steps for every model, chosen by the data set alone. "
            "Of several seeds the first is shown. "
            if chosen
            else None,
            left_out,
            class_="note",
        ),
        joined(steps_shown),
    )


def _step(picture: Mapping[str, Any], shown_by: Entry, rows: Sequence[Row]) -> Markup:
    """One step: the frame before, the truth, and what each model makes of it."""
    what = f"{picture['action']}, {'an object is pushed' if picture['pushed'] else 'nothing is pushed'}"
    where = f"episode {picture['episode']}, step {picture['step']}"
    tiles = [
        _tile("frame before", "", where, picture["current"], shown_by),
        _tile("true next frame", "", where, picture["truth"], shown_by),
    ]
    for row in rows:
        own = _of(row.entries[0], [picture])[0]
        if own is not None:
            tiles.append(_tile(row.name, _told(row), where, own["predicted"], row.entries[0]))
    return element(
        "div", element("h4", what, element("small", where)), element("ul", *tiles, class_="tiles"), class_="step"
    )


def _told(row: Row) -> str:
    return ", ".join(part for part in (row.variant, row.labels) if part)


def _tile(name: str, small: str, where: str, png: str, entry: Entry) -> Markup:
    """A picture of an entry, with what it shows.

    Raises:
        EntryInvalid: It cannot be read; says in which file.
    """
    told = f"{name}{f' ({small})' if small else ''}: {where}"
    try:
        source = shown(png)
    except EntryInvalid as error:
        raise EntryInvalid(f"the entry {entry.slug}.json cannot be shown: {error}") from None
    return element(
        "li",
        element("img", src=source, alt=told, width=112, height=112, loading="lazy"),
        element("span", name),
        element("small", small) if small else None,
    )


def _shown_by(board: Board) -> Entry | None:
    """The first entry with the steps and the true frames that most trainings have; None where no entry has pictures."""
    votes = [
        (row.entries[0], tuple((identity(one), one["current"], one["truth"]) for one in row.entries[0].pictures))
        for row in _pictured(board)
    ]
    usual = most_common(votes)
    return next((entry for entry, own in votes if own == usual), None)


def _steps(board: Board) -> list[Mapping[str, Any]]:
    """The steps of the pictures, pushes and other steps in turn."""
    shown_by = _shown_by(board)
    pictures = [] if shown_by is None else shown_by.pictures
    pushes, others = ([one for one in pictures if one["pushed"] is wanted] for wanted in (True, False))
    mixed: list[Mapping[str, Any]] = []
    while pushes or others:
        mixed += [own.pop(0) for own in (pushes, others) if own]
    return mixed


def _pictured(board: Board) -> list[Row]:
    return [row for row in board.rows if row.kind == "measured" and row.entries[0].pictures]


def _of(entry: Entry, chosen: Sequence[Mapping[str, Any]]) -> list[Mapping[str, Any] | None]:
    own = {identity(picture): picture for picture in entry.pictures}
    return [own.get(identity(picture)) for picture in chosen]
