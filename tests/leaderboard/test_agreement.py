"""The gain captured beside other figures: rows are ranked alike or not, within a board and across two data sets."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import numpy as np
import pytest

from dmotion_bench.planning.columns import COLUMNS, HEADLINE
from leaderboard.board import make_boards
from leaderboard.board_tables import board_section
from leaderboard.entry import Entry
from leaderboard.page import make_page

from .conftest import TASK_EPISODES, figure_over

MakeEntry = Callable[..., Entry]
LEFT = np.linspace(0.1, 0.5, len(TASK_EPISODES))
MODELS = "abcdefgh"
ON_TEST = f"distance left after 2 steps on grid-test ({HEADLINE.title})"


def test_the_gain_agrees_with_control_of_its_own_data_set_as_the_ranks_do(controlled: MakeEntry) -> None:
    entries = []
    whole = {"labels": {"asked": "100%", "given": {}, "total": 64}}
    for place, name in enumerate(MODELS):
        entries.append(Entry(dict(controlled(name, LEFT + 0.1 * place, column=HEADLINE.name).content) | whole))
        predicted = controlled(name, LEFT, column=None)
        figures = {"planning_gain": figure_over(0.9 - 0.1 * place, 9), "mse": figure_over(10.0 - place, 9)}
        made = dict(predicted.content) | {"figures": figures, "by_episode": {}}
        entries.append(Entry(made | whole))
        for labels in ("8", "16", "5-shot"):  # a model's other budgets are no further rows
            budget = {"labels": {"asked": labels, "given": {}, "total": 20}, "run": f"{name}-{labels}-s0"}
            worse = {"figures": {"planning_gain": figure_over(0.9, 9), "mse": figure_over(90.0, 9)}}
            entries.append(Entry(made | budget | worse))
    (board,) = make_boards(entries)
    found = {one.figure: one.correlation for one in board.agreement}

    assert found[ON_TEST].mean == pytest.approx(-1.0)
    assert found["MSE"].mean == pytest.approx(1.0)
    assert found["MSE"].n == 8
    assert (found["MSE"].low, found["MSE"].high) == (None, None)  # all draws are ordered as the rows are
    assert "MSE 1.00 (8 rows)" in make_page(entries)
    assert "| MSE | 8 | 1.00 |" in board_section(board)
    assert "Spearman" in "\n".join(board_section(board))
    assert "Rank correlation of the gain captured" in make_page(entries)
    assert "Gain captured" in next(line for line in board_section(board) if line.startswith("| Model"))
    (smaller,) = make_boards([entry for entry in entries if entry.model != "h"])
    assert smaller.agreement == ()  # seven rows say too little


@pytest.fixture
def gaining(controlled: MakeEntry) -> MakeEntry:
    """Makes an entry of a model's gain on the data set that ``controlled`` says it was trained on."""

    def make(model: str, gain: float, **more: Any) -> Entry:
        content = dict(controlled(model, LEFT, column=None).content)
        own = {name: value for name, value in content["dataset"].items() if name != "trained_on"}
        figures = {"planning_gain": figure_over(gain, 9)}
        dataset = {"dataset": own | content["dataset"]["trained_on"]}
        return Entry(content | {"figures": figures, "by_episode": {}, "reference": {}} | dataset | more)

    return make


def _correlations(entries: Iterable[Entry]) -> dict[str, dict[str, tuple[int, float]]]:
    """By board and figure: the rows, and how they are correlated."""
    return {
        board.dataset: {one.figure: (one.correlation.n, one.correlation.mean) for one in board.agreement}
        for board in make_boards(entries)
    }


def test_control_on_test_tasks_is_beside_the_gain_on_the_board_of_the_training(
    controlled: MakeEntry, gaining: MakeEntry
) -> None:
    gains = [gaining(name, 0.9 - 0.1 * place) for place, name in enumerate(MODELS)]
    control = [  # of other trainings with the same settings
        controlled(name, LEFT + 0.1 * place, column=HEADLINE.name, seed=7) for place, name in enumerate(MODELS)
    ]
    (board, _) = make_boards([*gains, *control])

    assert _correlations([*gains, *control]) == {"grid": {ON_TEST: (8, pytest.approx(-1.0))}, "grid-test": {}}
    (line,) = (line for line in board_section(board) if ON_TEST in line)
    assert line.startswith(f"| {ON_TEST} | 8 | -1.00 |")
    assert "rows are compared, not trainings" in " ".join(board_section(board))
    assert f"{ON_TEST} -1.00 (" in make_page([*gains, *control])
    assert "rows are compared, not trainings" in make_page([*gains, *control])
    assert _correlations([*gains[1:], *control])["grid"] == {}  # seven rows say too little


def test_only_the_headline_s_control_of_the_same_settings_budget_and_training_is_joined(
    controlled: MakeEntry, gaining: MakeEntry
) -> None:
    gains = [gaining(name, 0.9 - 0.1 * place) for place, name in enumerate(MODELS)]
    last = COLUMNS["generic"]

    def with_last(**changes: Any) -> list[Entry]:
        own = {"column": HEADLINE.name} | {name: changes.pop(name) for name in ("column", "labels") if name in changes}
        rows = [controlled(name, LEFT + 0.1 * place, column=HEADLINE.name) for place, name in enumerate(MODELS[:-1])]
        return [*gains, *rows, Entry(dict(controlled("h", LEFT, **own).content) | changes)]

    elsewhere = dict(controlled("h", LEFT).content["dataset"]) | {
        "trained_on": {"name": "grid", "fingerprint": "1" * 64}
    }
    clustered = {"asked": "one-shot", "given": {}, "total": 4, "use": "clustered"}
    assert _correlations(with_last())["grid"][ON_TEST][0] == 8
    for changes in (
        {"column": last.name},
        {"labels": "16"},
        {"run": "h-grid-tiny-width_2-s0"},
        {"dataset": elsewhere},
        {"arch": "another"},
    ):
        assert _correlations(with_last(**changes))["grid"] == {}, changes
    used = Entry(dict(controlled("h", LEFT, column=HEADLINE.name).content) | {"labels": clustered})
    assert _correlations([*with_last()[:-1], used])["grid"] == {}
