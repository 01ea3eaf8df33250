"""Control on a board: who leads, and what other planners or other settings brought about."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from leaderboard.board import make_boards
from leaderboard.entry import Entry
from leaderboard.standings import control_standings

from .conftest import EPISODES, row_named


def test_what_one_seed_alone_was_scored_on_stays_in_the_row(result: Callable[..., Entry]) -> None:
    def controlled(entry: Entry, distance: float) -> Entry:
        figures = entry.content["figures"] | {
            "control_distance[100]": {
                "mean": distance,
                "std": 0.1,
                "low": distance - 0.1,
                "high": distance + 0.1,
                "n": 20,
            }
        }
        tasks = {"episode": EPISODES, "n": [1] * len(EPISODES), "sum": [distance] * len(EPISODES)}
        by_episode = entry.content["by_episode"] | {"control_distance[100]": tasks}
        return Entry(dict(entry.content) | {"figures": figures, "by_episode": by_episode})

    errors = np.linspace(1, 3, 40)
    two = [controlled(result("two", errors), 0.5), result("two", 2 * errors, seed=1)]
    other = controlled(result("other", errors * 3), 0.4)

    (board,) = make_boards([*two, other])
    row = row_named(board, "two")
    value = row.figures["control_distance[100]"]

    assert (row.seeds, row.figures["mse"].seeds, value.seeds) == (2, 2, 1)
    assert (value.mean, value.low, value.high) == pytest.approx((0.5, 0.4, 0.6))
    assert "control_distance[100]" in row_named(board, "other").leads
    assert "control_distance[100]" not in row.leads
    assert "1 of 2 seeds" in (control_standings(board, "b") or "")


def test_in_control_those_lead_that_cannot_be_told_from_the_best(result: Callable[..., Entry]) -> None:
    generator = np.random.default_rng(0)
    hardness = generator.normal(0, 0.2, len(EPISODES))  # of the tasks: the same for all

    def controlled(model: str, distance: np.ndarray) -> Entry:
        entry = result(model, np.ones(len(EPISODES)))
        figure = {"mean": float(distance.mean()), "std": 0.2, "low": None, "high": None, "n": len(EPISODES)}
        sums = {"episode": EPISODES, "n": [1] * len(EPISODES), "sum": distance.tolist()}
        figures = {**entry.figures, "control_distance[40]": figure, "control_distance[100]": figure}
        return Entry(
            dict(entry.content)
            | {"figures": figures, "by_episode": {**entry.by_episode, "control_distance[100]": sums}}
        )

    close = 0.505 + hardness + 0.05 * (-1) ** np.arange(len(EPISODES))
    (board,) = make_boards(
        [
            controlled("best", 0.5 + hardness),
            controlled("close", close),
            controlled("far", 0.55 + hardness),
            result("uncontrolled", np.ones(len(EPISODES))),
        ]
    )

    leads = {row.name: row.leads for row in board.rows if row.kind == "measured"}
    assert leads["best"] == leads["close"] == {"control_distance[100]"}
    assert leads["far"] == leads["uncontrolled"] == set()  # .05 behind, of .2 between the tasks nothing is left


@pytest.fixture
def planned(result: Callable[..., Entry]) -> Callable[..., Entry]:
    """Makes an entry whose distance a version of the planner brought about."""

    def make(model: str, distance: float, by: int | str, *, seed: int = 0) -> Entry:
        entry = result(model, np.ones(len(EPISODES)), seed=seed)
        figure = {"mean": distance, "std": 0.2, "low": None, "high": None, "n": len(EPISODES)}
        sums = {"episode": EPISODES, "n": [1] * len(EPISODES), "sum": [distance] * len(EPISODES)}
        content = dict(entry.content) | {"figures": {**entry.figures, "control_distance[100]": figure}}
        content |= {"by_episode": {**entry.by_episode, "control_distance[100]": sums}}
        content |= {"settings": content["settings"] | {f"control_{'version' if isinstance(by, int) else 'code'}": by}}
        return Entry(content | {"reference": content["reference"] | {"oracle": {"control_distance[100]": figure}}})

    return make


def test_what_different_planners_did_is_neither_averaged_nor_compared(
    planned: Callable[..., Entry], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("leaderboard.usual.CONTROL_VERSION", 7)
    entries = [
        planned("both", 0.9, "0.1.0+2140d529a1bd"),
        planned("both", 0.5, 7, seed=1),
        planned("old", 0.3, "0.1.0+2140d529a1bd"),
        planned("old", 0.2, "0.1.0+2140d529a1bd", seed=1),
    ]

    (board,) = make_boards(entries)

    both, old = row_named(board, "both"), row_named(board, "old")
    assert (both.figures["control_distance[100]"].mean, both.figures["mse"].seeds) == (0.5, 2)
    assert (both.leads, both.planned_otherwise) == ({"control_distance[100]"}, False)
    assert old.figures["control_distance[100]"].mean == pytest.approx(0.25)
    assert (old.leads, old.planned_otherwise) == (set(), True)
    (oracle,) = (row for row in board.rows if row.kind == "reference" and "simulator" in row.name)
    assert oracle.figures["control_distance[100]"].mean == 0.5
    table = str(control_standings(board, "b"))
    assert table.count("another planner") == 2  # of the row, and in the note


def test_what_another_planner_did_is_not_correlated_with_the_gain(planned: Callable[..., Entry]) -> None:
    def gaining(model: str, gain: float, distance: float, by: int | str) -> Entry:
        content = dict(planned(model, distance, by).content)
        mean, error = (content["figures"]["control_distance[100]"] | {"mean": one} for one in (gain, 10 - gain))
        return Entry(content | {"figures": content["figures"] | {"planning_gain": mean, "mse": error}})

    entries = [gaining(name, 0.1 * place, 1 - 0.1 * place, 1) for place, name in enumerate("abcdefgh")]
    (board,) = make_boards([*entries, gaining("old", 0.9, 2.0, "0.1.0+2140d529a1bd")])
    found = {one.figure: one.correlation for one in board.agreement}

    left = found["distance left after 100 steps"]
    assert (left.n, left.mean) == (8, pytest.approx(-1.0))
    assert found["MSE"].n == 9  # what it predicted is compared


@pytest.mark.parametrize("other", [{"planner": "cem"}, {"objective": "tabletop"}, {"tasks": 7}, {"seed": 17}])
def test_other_settings_are_another_planner(planned: Callable[..., Entry], other: dict[str, Any]) -> None:
    def of(name: str, distance: float, training: int, settings: dict[str, Any]) -> Entry:
        content = dict(planned(name, distance, 1, seed=training).content)
        own = {f"control_{key}": value for key, value in ({"planner": "icem", "seed": 0} | settings).items()}
        return Entry(content | {"settings": content["settings"] | own})

    usual_ones = [of("both", 0.9, 0, {}), of("usual", 0.8, 0, {}), of("usual", 0.8, 1, {})]
    (board,) = make_boards([*usual_ones, of("both", 0.3, 1, other), of("other", 0.1, 0, other)])

    both, usual, apart = (row_named(board, name) for name in ("both", "usual", "other"))
    assert both.figures["control_distance[100]"].mean == 0.9
    assert usual.leads == {"control_distance[100]"}
    assert (apart.leads, apart.planned_otherwise) == (set(), True)


@pytest.mark.parametrize(
    ("figure", "settings"), [("planning_gain", {"gain_seed": 9}), ("rollout_mse[1]", {"horizon": 1})]
)
def test_a_figure_measured_with_unusual_settings_is_left_out(
    changed: Callable[..., Entry], figure: str, settings: dict[str, Any]
) -> None:
    def of(name: str, mean: float, **other: Any) -> Entry:
        content = dict(changed(run=name, model=name, weights=name * 64).content)
        figures = dict(content["figures"]) | {figure: dict(content["figures"]["mse"]) | {"mean": mean}}
        return Entry(content | {"figures": figures, "settings": content["settings"] | {"gain_seed": 0} | other})

    (board,) = make_boards([of("a", 0.5), of("b", 0.6), of("c", 0.9, **settings)])

    assert {row.name: figure in row.figures for row in board.rows if row.kind == "measured"} == {
        "a": True,
        "b": True,
        "c": False,
    }


def test_an_oracle_of_another_planner_is_marked(planned: Callable[..., Entry], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leaderboard.usual.CONTROL_VERSION", 7)
    present = planned("new", 0.5, 7)
    references = {name: one for name, one in present.content["reference"].items() if name != "oracle"}
    blind = Entry(dict(present.content) | {"reference": references})

    for entries, marked in (
        ([present, planned("old", 0.3, "0.1.0+2140d529a1bd")], False),
        ([blind, planned("old", 0.3, "0.1.0+2140d529a1bd")], True),
    ):
        (board,) = make_boards(entries)
        (oracle,) = (row for row in board.rows if row.kind == "reference" and "simulator" in row.name)
        assert oracle.planned_otherwise is marked
        assert ("reference, another planner" in str(control_standings(board, "b"))) is marked
        (idle,) = (row for row in board.rows if row.name == "copy the last frame")
        assert not idle.planned_otherwise


def test_where_nothing_is_of_this_planner_the_most_used_one_s_is_compared(planned: Callable[..., Entry]) -> None:
    (board,) = make_boards([planned("a", 0.5, "one"), planned("b", 0.6, "one"), planned("c", 0.4, "other")])

    assert {row.name: row.planned_otherwise for row in board.rows if row.kind == "measured"} == {
        "a": False,
        "b": False,
        "c": True,
    }
    assert [row.name for row in board.rows if row.leads] == ["a"]
