"""The summary across worlds: rliable's values, and which boards, budgets and trainings are taken."""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.scoring.report import LABEL_USES, FigureJson
from dmotion_bench.specs import Preset
from leaderboard.board import Board, make_boards
from leaderboard.entry import Entry
from leaderboard.entry_file import read_entries
from leaderboard.page import make_page
from leaderboard.row import Row
from leaderboard.summary import (
    Standing,
    Summary,
    interquartile_mean,
    interval,
    probability_of_improvement,
    summarise,
)
from leaderboard.summary_section import shows, summary_lines
from leaderboard.value import values_of

from .rliable_values import ENTRIES, SHAPES, VALUES, random_scores

RLIABLE = json.loads(VALUES.read_text())
"""Made by ``rliable_values.py`` where rliable is installed; it says how."""


@pytest.mark.slow
@pytest.mark.parametrize("number", range(len(SHAPES)), ids=str)
def test_random_scores_give_rliable_s_values(number: int) -> None:
    pair, said = random_scores()[number], RLIABLE["random"][number]
    assert said["shape"] == list(pair[0].shape)
    assert [interquartile_mean(one) for one in pair] == pytest.approx(said["iqm"], abs=1e-12)
    assert probability_of_improvement(pair[1], pair[0]) == pytest.approx(said["improvement"], abs=1e-12)
    for one, bounds in zip(pair, said["interval"], strict=True):
        width = bounds[1] - bounds[0]
        assert interval(interquartile_mean, one) == pytest.approx(bounds, abs=0.06 * width + 1e-9)


@pytest.mark.slow
def test_the_interval_of_an_improvement_is_rliable_s() -> None:
    (first, second), said = random_scores()[3], RLIABLE["random"][3]["improvement_interval"]
    found = interval(probability_of_improvement, second, first, resamples=300)
    assert found == pytest.approx(said, abs=0.04)


def test_equal_scores_are_an_even_chance() -> None:
    scores = np.array([[0.5, 0.2], [0.5, 0.3]])
    assert probability_of_improvement(scores, scores) == 0.5
    assert probability_of_improvement(scores + 1, scores) == 1.0


@pytest.fixture(scope="module")
def entries() -> list[Entry]:
    """Those of this project."""
    return read_entries(ENTRIES)


@pytest.fixture(scope="module")
def published(entries: list[Entry]) -> Summary:
    found = summarise(make_boards(entries))
    assert found is not None
    return found


@pytest.mark.slow
def test_the_published_entries_give_rliable_s_values(published: Summary) -> None:
    said = RLIABLE["published"]
    known = {one.model: one for one in published.standings}
    for model, scores in said["scores"].items():
        np.testing.assert_allclose(known[model].scores, scores, rtol=0, atol=1e-12)
        assert known[model].iqm == pytest.approx(said["iqm"][model], abs=1e-12)
    assert {one.model: one.over_next for one in published.standings[:-1]} == pytest.approx(said["over_next"])
    for model, one in known.items():
        assert (one.interval is None) == (len(said["scores"][model]) == 1)
        if one.interval is not None:
            bounds = said["interval"][model]  # the lowest and the highest that were found, of other draws than ours
            room = 0.06 * (bounds[1][1] - bounds[0][0])
            for found, (least, most) in zip(one.interval, bounds, strict=True):
                assert least - room <= found <= most + room


@pytest.mark.slow
def test_published_entries_have_these_models(published: Summary) -> None:
    """A new result may change this; the values of rliable are to be made again then."""
    assert {one.model for one in published.standings} == set(RLIABLE["published"]["scores"])


def _figures(mse: float) -> dict[str, FigureJson]:
    return {"mse": {"mean": mse, "std": 1.0, "low": mse, "high": mse, "n": 10}}


class _Training:
    """What a row needs of an entry."""

    def __init__(self, mse: float, actions: str = "discrete") -> None:
        self.figures, self.slug, self.actions = _figures(mse), f"slug-{mse}", actions


def _row(model: str, errors: Sequence[float], labels: str = "one-shot", variant: str = "") -> Row:
    trainings = tuple(_Training(one) for one in errors)
    return Row(
        kind="measured",
        name=model,
        model=model,
        variant=variant,
        labels=labels,
        label_count=4,
        entries=trainings,  # type: ignore[arg-type]
        figures=values_of([one.figures for one in trainings]),
    )


def _board(environment: str, rows: Sequence[Row], copy_last: float = 100.0, dataset: str = "") -> Board:
    last = Row(kind="reference", name="copy the last frame", figures=values_of([_figures(copy_last)]))
    return Board(
        environment=environment,
        dataset=dataset or environment,
        fingerprint=f"{environment}{dataset}",
        protocol="episode",
        split="test",
        rows=(*rows, last),
    )


def test_scores_are_the_share_of_the_error_of_copying_that_is_gone() -> None:
    found = summarise([
        _board("a", [_row("x", [10, 20]), _row("y", [50])], copy_last=100),
        _board("b", [_row("x", [8, 0, 4]), _row("y", [16])], copy_last=8),
    ])  # fmt: skip
    assert found is not None
    x, y = found.standings
    np.testing.assert_allclose(x.scores, [[0.9, 0.0], [0.8, 1.0]])  # the third training of one world is not taken
    np.testing.assert_allclose(y.scores, [[0.5, -1.0]])
    assert (x.iqm, y.iqm) == (pytest.approx(0.85), pytest.approx(-0.25))
    assert (x.trainings, y.trainings, y.interval) == (2, 1, None)
    assert x.interval is not None
    assert 0.0 <= x.interval[0] < x.interval[1] <= 1.0
    assert (x.over_next, y.over_next) == (1.0, None)


def _taken(found: Summary | None) -> list[tuple[str, str]]:
    assert found is not None
    return [(one.model, one.labels) for one in found.standings]


def test_the_usual_budget_and_the_usual_settings_are_taken() -> None:
    rows = [
        _row("x", [1], "20-shot"), _row("x", [3]), _row("x", [0.5], variant="warp true"), _row("y", [4], "100%"),
        _row("y", [9], "10%"), _row("z", [2], "64"), _row("v", [2]),
    ]  # fmt: skip
    other = [_row("x", [3]), _row("y", [4], "100%"), _row("v", [2], "100%")]
    found = summarise([_board("a", rows), _board("b", other)])
    assert _taken(found) == [("x", "one-shot"), ("y", "100%")]
    assert found is not None
    assert found.left_out == ("v", "z")


def test_a_model_that_always_learns_with_a_few_labels_is_in_the_table_or_left_out_by_name() -> None:
    few, tuned = LABEL_USES["during"], LABEL_USES["during, finetuned"]
    rows = [_row("x", [1]), _row("y", [2]), _row("few", [3], variant=few), _row("tuned", [4], variant=tuned)]
    lacking = [_row("x", [1]), _row("y", [2]), _row("other", [3], variant=few)]

    found = summarise([_board("a", rows), _board("b", rows)])
    assert _taken(found) == [("x", "one-shot"), ("y", "one-shot"), ("few", "one-shot")]
    found = summarise([_board("a", rows), _board("b", lacking)])
    assert found is not None
    assert found.left_out == ("few", "other", "tuned")


def test_a_world_is_its_board_of_most_models_and_a_world_of_few_is_not_counted() -> None:
    many = [_row(name, [place]) for place, name in enumerate("pqrst", 1)]
    found = summarise([
        _board("a", many[:2], dataset="small"), _board("a", many, dataset="large"), _board("b", many[:4]),
        _board("c", many[:2]), _board("d", [], dataset="empty"), _board("e", [_row("p", [1], variant="epochs 3")]),
    ])  # fmt: skip
    assert found is not None
    assert [board.dataset for board in found.boards] == ["large", "b"]
    assert (found.left_out, found.too_small, found.unusual) == (("t",), ("C",), ("E",))
    said = " ".join(summary_lines(found))
    assert "lack a result with their usual labels and settings in one of these worlds: t." in said
    assert "half as many models, which are not counted: C." in said
    assert "with its usual settings, which are not counted: E." in said


def test_a_world_is_what_its_usual_recipe_makes_however_many_models_other_data_have() -> None:
    few = [_row(name, [place]) for place, name in enumerate("pqr", 1)]
    many = [*few, _row("s", [4]), _row("t", [5])]
    usual = replace(_board("grid_world", few, dataset="usual"), recipe=recipe_for("grid_world", Preset.PAPER))
    other = replace(_board("grid_world", many, dataset="other"), recipe=recipe_for("grid_world", Preset.PAPER, seed=1))
    unknown = _board("grid_world", many, dataset="unknown")
    second = _board("b", many)
    for boards in ([usual, other, unknown, second], [unknown, second, other, usual]):
        found = summarise(boards)
        assert found is not None
        assert {board.dataset for board in found.boards} == {"usual", "b"}


@pytest.mark.parametrize("boards", [[], [_board("a", [_row("x", [1]), _row("y", [2])])]], ids=["nothing", "one world"])
def test_nothing_is_summed_up_where_there_is_one_world(boards: list[Board]) -> None:
    assert summarise(boards) is None


def test_one_training_has_no_interval_anywhere(published: Summary) -> None:
    lines = {line.split(" | ")[0].strip("| "): line for line in summary_lines(published)}
    for one in published.standings:
        cells = lines[one.model].strip("| ").split(" | ")
        assert ("to" in cells[1]) == (one.trainings > 1)
        assert cells[-1] == str(one.trainings)


def test_the_page_opens_with_it_and_each_board_says_what_it_shows(entries: list[Entry]) -> None:
    two = ("ed-cnn", "dmotion")
    page = make_page([one for one in entries if one.is_measured and one.model in two and "small-s0" in one.name])
    main = page[page.index("<main>") :]
    assert main.startswith("<main><section")
    assert 0 < main.index("All worlds together") < main.index('class="board"')
    headings = re.findall(r'class="board".*?<h2>.*?<small>(.*?)</small></h2><p class="(\w+)">(.*?)</p>', page)
    assert {kind for _, kind, _ in headings} == {"shows"}
    assert len(headings) == page.count('class="board"')
    for data, _, sentence in headings:
        assert ("frozen planners" if data.endswith("-test") else "next frame") in sentence
    assert any(data == "robot_push-test" for data, _, _ in headings)
    assert re.search(r'<a href="#board-\d">Grid World, version [12]</a>', page)


def test_what_a_board_shows_in_a_sentence(sound: Entry) -> None:
    (board,) = make_boards([sound])
    assert shows(board) == (
        "A square pushes circles and triangles over a grid, and off it: how far each model's next frame is from the "
        "true one."
    )
    elsewhere = Entry(dict(sound.content) | {"dataset": dict(sound.content["dataset"]) | {"environment": "my_arm"}})
    assert shows(make_boards([elsewhere])[0]) == "How far each model's next frame is from the true one."


def test_standings_are_plain_values(published: Summary) -> None:
    assert all(isinstance(one, Standing) and np.isfinite(one.scores).all() for one in published.standings)


def test_a_model_that_has_the_reference_s_name_is_not_what_the_others_are_compared_with() -> None:
    rows = [_row("copy the last frame", [1]), _row("x", [10]), _row("y", [50])]
    found = summarise([_board("a", rows), _board("b", rows)])

    assert found is not None
    assert {one.model: one.worlds for one in found.standings}["x"] == pytest.approx([0.9, 0.9])
