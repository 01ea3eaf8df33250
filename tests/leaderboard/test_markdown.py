"""Text of entries in Markdown pages: it stays words, and makes no heading, list, rule, table or markup."""

from __future__ import annotations

from typing import Any

import pytest

from leaderboard.board import make_boards
from leaderboard.board_tables import board_section, published_section
from leaderboard.entry import Entry
from leaderboard.markdown import WIDTH, paragraph


@pytest.mark.parametrize(
    ("text", "line"),
    [
        ("# Results", r"\# Results"),
        ("- one", r"\- one"),
        ("+ one", r"\+ one"),
        ("---", r"\---"),
        ("===", r"\==="),
        ("___", r"\___"),
        ("12. one", r"12\. one"),
        ("3) one", r"3\) one"),
        ("* one", r"\* one"),
        ("> one", r"\> one"),
        ("0.5 of it, -1 and #3", "0.5 of it, -1 and #3"),
    ],
)
def test_no_line_begins_anything_but_words(text: str, line: str) -> None:
    assert paragraph(text) == [line]
    assert paragraph(f"{'w' * WIDTH} {text}") == ["w" * WIDTH, line]


def _published(**content: Any) -> Entry:
    figures = {"mse": {"mean": 1.0, "std": None, "low": None, "high": None, "n": None}}
    plain = {"model": "m", "environment": "e", "labels": {"asked": "none", "total": 0}, "source": "s", "note": "n"}
    return Entry({"format": "dmbench-entry/1", "kind": "published", "figures": figures} | plain | content)


def test_a_published_row_of_anybody_makes_no_markup() -> None:
    note = f"{'w' * (WIDTH - len('Me.') - 1)} ## Results"
    entry = _published(environment="x:<img src=y> | [z](http://z)", source="Me", note=note)
    (board,) = make_boards([entry])

    lines = published_section(board)

    assert lines[0] == r"### x:\<img src=y\> \| \[z\](http://z): as published"
    assert r"\## Results" in lines
    assert sum(line.startswith("#") for line in lines) == 1


def test_the_name_of_an_environment_makes_no_markup(sound: Entry) -> None:
    dataset = dict(sound.content["dataset"]) | {"environment": "x:<script>"}
    (board,) = make_boards([Entry(dict(sound.content) | {"dataset": dataset})])

    assert board_section(board)[0].startswith(r"### x:\<script\> v")
