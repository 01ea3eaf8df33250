"""Control by the headline's frozen planner over its steps, as the page and the models' pages draw it."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pytest

from dmotion_bench.planning.columns import COLUMNS, HEADLINE
from leaderboard.board import Board, make_boards
from leaderboard.columns import number
from leaderboard.entry import Entry
from leaderboard.model_results import OF_HEADLINE, model_charts, model_lines
from leaderboard.page import make_page

from .conftest import TASK_EPISODES, figure_over

MakeEntry = Callable[..., Entry]
LEFT = np.linspace(0.2, 0.6, len(TASK_EPISODES))
TITLE = f"Control by the frozen planner {HEADLINE.title}"


@pytest.fixture
def of_headline(controlled: MakeEntry) -> MakeEntry:
    """Makes an entry of the headline's column whose distance after the first of two steps is given, too."""

    def make(model: str, first: float, left: np.ndarray, **more: Any) -> Entry:
        content = dict(controlled(model, left, column=HEADLINE.name, **more).content)
        figures = content["figures"] | {"control_distance[1]": figure_over(first, len(left))}
        return Entry(content | {"figures": figures})

    return make


@pytest.fixture
def entries(of_headline: MakeEntry, controlled: MakeEntry) -> list[Entry]:
    return [
        of_headline("dmotion", 0.9, LEFT),
        of_headline("dmotion", 0.7, LEFT + 0.2, seed=1),
        of_headline("ed-cnn", 0.6, LEFT + 0.3, labels="100%"),
        controlled("lapo", LEFT, column="generic"),
    ]


def _chart(page: str, title: str = TITLE) -> tuple[ElementTree.Element, list[list[str]]]:
    """The chart of a page, and the cells of its numbers."""
    found = re.search(rf"<figure><figcaption><b>{re.escape(title)}</b>.*?(<svg.*?</svg>).*?</figure>", page, re.DOTALL)
    assert found is not None
    rows = [re.findall(r"<t[hd][^>]*>([^<]*)", row) for row in re.findall(r"<tr>.*?</tr>", found[0], re.DOTALL)]
    return ElementTree.fromstring(found[1]), rows


def test_the_page_draws_the_mean_over_trainings_after_each_step_beside_the_references(entries: list[Entry]) -> None:
    picture, (head, *numbers) = _chart(make_page(entries))
    lines = {
        str(group.findtext("title")): [
            path.get("d", "") for path in group.iter("path") if "line" in path.attrib["class"]
        ]
        for group in picture.iter("g")
        if "series" in group.get("class", "")
    }

    assert head == ["model", "labels", "0", "1", "2"]
    ends = [number(float(one.mean())) for one in (LEFT + 0.1, LEFT + 0.3)]
    assert numbers[:2] == [
        ["dmotion", "one-shot", "1.00", "0.800", ends[0]],
        ["ed-cnn", "100%", "1.00", "0.600", ends[1]],
    ]
    assert {row[0] for row in numbers[2:]} == {"idle", "true simulator as the model"}
    assert lines.keys() == {
        "dmotion, labels one-shot",
        "ed-cnn, labels 100%",
        "idle",
        "true simulator as the model",
    }  # not what another column planned
    heights = [float(place.split(" ")[1]) for place in lines["dmotion, labels one-shot"][0][1:].split("L")]
    assert heights[1] - heights[0] == pytest.approx((heights[2] - heights[0]) * 0.2 / 0.5, abs=0.2)


def test_its_models_are_in_the_legend_with_the_colours_that_they_have_on_other_boards(
    entries: list[Entry], sound: Entry
) -> None:
    page = make_page([*entries, sound])
    buttons = re.findall(r'<button[^>]*data-model="(\d+)"[^>]*>.*?</svg>([^<]*)<', page, re.DOTALL)

    assert {name for _, name in buttons} >= {"dmotion", "ed-cnn"}
    assert len({index for index, name in buttons if name == "dmotion"}) == 1


def test_each_frozen_planner_that_planned_for_a_model_has_a_chart(entries: list[Entry], controlled: MakeEntry) -> None:
    other = TITLE.replace(HEADLINE.title, COLUMNS["generic"].title)
    page = make_page([*entries, controlled("jepa", LEFT, column="generic")])
    _, (_, *numbers) = _chart(page, other)

    assert {row[0] for row in numbers} == {"jepa", "lapo", "idle", "true simulator as the model"}
    assert page.count("<b>Control by the frozen planner") == 2
    assert {"jepa", "lapo"} <= set(re.findall(r'<button[^>]*data-model="\d+"[^>]*>.*?</svg>([^<]*)<', page, re.DOTALL))


def test_the_legend_tells_of_dashed_lines_where_there_are_some(entries: list[Entry], of_headline: MakeEntry) -> None:
    assert "Dashed: a share" not in make_page(entries)
    assert "Dashed: a share" in make_page([*entries, of_headline("ed-cnn", 0.8, LEFT + 0.4, labels="50%")])


def test_where_another_column_planned_alone_only_that_is_drawn(controlled: MakeEntry) -> None:
    entries = [controlled("dmotion", LEFT, column="generic")]
    assert make_boards(entries)[0].by_headline is None
    assert TITLE not in make_page(entries)
    assert TITLE.replace(HEADLINE.title, COLUMNS["generic"].title) in make_page(entries)


def _named(boards: list[Board]) -> list[str]:
    picture = model_charts("dmotion", boards)["dmotion-control.svg"]
    return [title.text or "" for title in ElementTree.fromstring(picture).iter("{http://www.w3.org/2000/svg}title")][1:]


def test_a_model_s_page_draws_it_instead_of_control_by_other_planners(
    entries: list[Entry], of_headline: MakeEntry, controlled: MakeEntry
) -> None:
    old = dict(controlled("dmotion", LEFT, column=None).content)
    own = {"dataset": {name: value for name, value in old["dataset"].items() if name != "trained_on"}}
    predicted = Entry(old | own | {"figures": {**old["figures"], "mse": figure_over(1.0, 9)}})
    worse = of_headline("dmotion", 0.9, LEFT + 0.5, run="dmotion-grid-tiny-width_2-s0")
    words = f"control step, frozen planner {HEADLINE.title}"

    boards = make_boards([*entries, worse, predicted])
    assert _named(boards) == ["grid-test, one-shot", "idle", "true simulator as the model"]
    assert words in "\n".join(model_lines("dmotion", boards))
    assert OF_HEADLINE in " ".join(model_lines("dmotion", boards))
    before = make_boards([predicted, *entries[2:]])
    assert _named(before)[0] == "grid-test, one-shot"
    assert words not in "\n".join(model_lines("dmotion", before))
    assert OF_HEADLINE not in " ".join(model_lines("dmotion", before))
    alone = make_boards(entries)  # without any error of prediction
    assert "](curves/dmotion-control.svg)" in "\n".join(model_lines("dmotion", alone))


def test_a_reference_that_only_one_of_the_data_sets_has_says_whose_it_is(
    entries: list[Entry], of_headline: MakeEntry
) -> None:
    content = dict(of_headline("dmotion", 0.9, LEFT).content)
    second = content["dataset"] | {"name": "other-test", "fingerprint": "f" * 64}
    idle = {"idle": content["reference"]["idle"]}
    boards = make_boards([*entries, Entry(content | {"dataset": second, "reference": idle})])

    assert {"idle", "true simulator as the model, grid-test"} < set(_named(boards))
