"""``docs/worlds.md``: every world has a card, with its command, picture and figures as they were measured."""

from __future__ import annotations

import re
import shlex

import numpy as np
import pytest
from PIL import Image

from recorders.gymnasium_env.worlds import WORLDS
from tests.worlds.measure import MOMENTS, OWN, documented, strip
from tests.worlds.page import DOCS, PAGE, figures, titles, with_table

MOST_BYTES = 40_000


def test_the_table_holds_what_was_measured() -> None:
    assert with_table(PAGE.read_text()) == PAGE.read_text(), "write it with 'python -m tests.worlds.page'"


def test_every_world_that_ships_has_a_card() -> None:
    assert set(titles(PAGE.read_text())) == {*OWN, *(f"gym:{name}" for name in WORLDS)}


@pytest.mark.parametrize("name", figures())
def test_a_card_has_the_command_that_was_measured_and_its_picture(name: str) -> None:
    found = figures()[name]
    assert shlex.split(found["command"]) == documented(name)
    (card,) = [
        one for one in re.split(r"^## ", PAGE.read_text(), flags=re.MULTILINE) if f"dmbench record {name}" in one
    ]
    assert f"\n{found['command']}\n" in card
    assert f"](images/worlds/{found['name']}.webp)" in card
    picture = DOCS / "images" / "worlds" / f"{found['name']}.webp"
    assert picture.stat().st_size < MOST_BYTES
    with Image.open(picture) as opened:
        assert opened.size == (MOMENTS * 132 - 4, 128)


def test_a_strip_shows_the_first_frame_the_last_and_some_between() -> None:
    video = np.broadcast_to(np.arange(11, dtype=np.uint8)[:, None, None, None] * 20, (11, 128, 128, 3))
    shown = np.asarray(strip(video))
    assert [int(shown[64, place * 132 + 64, 0]) // 20 for place in range(6)] == [0, 2, 4, 6, 8, 10]
