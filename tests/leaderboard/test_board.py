"""Standings: seeds, paired differences to the best, published rows and references beside them."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from leaderboard.board import make_boards
from leaderboard.entry import Entry
from leaderboard.page import make_page

from .conftest import row_named


def _published(model: str = "dmotion", mse: float = 14.3) -> Entry:
    figures = {"mse": {"mean": mse, "std": 99.8, "low": None, "high": None, "n": None}}
    return Entry(
        {
            "format": "dmbench-entry/1",
            "kind": "published",
            "model": model,
            "environment": "grid_world",
            "labels": {"asked": "one-shot", "total": 4},
            "figures": figures,
            "source": "somebody",
            "note": "somewhere",
        }
    )


@pytest.mark.slow
def test_versions_of_an_environment_have_boards_of_their_own(result: Callable[..., Entry]) -> None:
    errors = np.linspace(1, 3, 40)
    later = result("new", errors)  # the conftest records version 2
    first = {name: value for name, value in later.content["dataset"].items() if name != "version"}
    old = result("old", errors, dataset=first)

    boards = make_boards([old, later, _published()])

    assert [board.title for board in boards] == ["Grid World, version 2", "Grid World, version 1"]
    measured = [[row.name for row in board.rows if row.kind == "measured"] for board in boards]
    assert measured == [["new"], ["old"]]
    page = make_page([old, later, _published()])
    assert page.count("is of version 1 of grid_world (drawn on the 128 x 128 pixels themselves)") == 1
    assert "records version 2 (drawn as the paper&#x27;s published code does" in page
    assert "is of version" not in make_page([later, _published()])


@pytest.mark.slow
def test_seeds_are_one_row_with_their_range(result: Callable[..., Entry]) -> None:
    errors = np.linspace(1, 3, 40)
    entries = [result("a", errors * factor, seed=seed) for seed, factor in ((1, 2.0), (0, 1.0), (2, 1.5))]

    (board,) = make_boards(entries)
    row = row_named(board, "a")
    value = row.figures["mse"]

    assert (row.seeds, [entry.content["seed"] for entry in row.entries]) == (3, [0, 1, 2])
    assert (value.mean, value.low, value.high) == pytest.approx((3.0, 2.0, 4.0))


def test_a_row_is_bold_only_where_it_cannot_be_told_from_the_best(result: Callable[..., Entry]) -> None:
    generator = np.random.default_rng(0)
    hard = generator.gamma(2, 10, 40)
    entries = [
        result("best", hard),
        result("same", hard + generator.normal(0.01, 1, 40)),
        result("worse", hard + 1 + generator.normal(0, 0.5, 40)),  # far less than the episodes' own spread
    ]

    (board,) = make_boards(entries)

    assert row_named(board, "best").is_best
    assert row_named(board, "same").ties
    worse = row_named(board, "worse")
    assert worse.behind is not None
    assert worse.behind.low is not None
    assert 0.5 < worse.behind.low < worse.behind.mean < 1.5
    assert not worse.ties


def test_a_model_that_breaks_the_contract_is_neither_the_best_nor_tied(result: Callable[..., Entry]) -> None:
    hard = np.random.default_rng(0).gamma(2, 10, 40)
    remarks = {"contract": "the model breaks it: predict differs from one call to the next"}
    (board,) = make_boards([result("sound", hard), result("broken", hard - 1e-6, remarks=remarks)])

    assert row_named(board, "sound").is_best
    broken = row_named(board, "broken")
    assert (broken.unsound, broken.ties, broken.is_best) == (True, False, False)
    assert "breaks the contract" in broken.variant


def test_entries_that_cannot_be_paired_are_not_compared(result: Callable[..., Entry]) -> None:
    one = result("one", np.ones(40))
    other = result("other", np.full(40, 2.0), by_episode={})

    (board,) = make_boards([one, other])

    assert row_named(board, "other").behind is None
    assert not row_named(board, "other").ties


def test_published_rows_and_references_stand_between_ours(result: Callable[..., Entry]) -> None:
    reference = {"copy_last": {"mse": {"mean": 1848.0, "std": 1.0, "low": 1.0, "high": 2.0, "n": 5}}, "paper": {}}
    entries = [result("a", np.full(40, 100.0), reference=reference), _published()]

    (board,) = make_boards(entries)

    assert [(row.kind, row.name) for row in board.rows] == [
        ("published", "dmotion"),
        ("measured", "a"),
        ("reference", "copy the last frame"),
    ]
    assert board.rows[0].figures["mse"].std == 99.8


def test_data_sets_and_leaking_splits_have_boards_of_their_own(result: Callable[..., Entry]) -> None:
    one = result("a", np.ones(40))
    dataset, settings = one.content["dataset"], one.content["settings"]
    entries = [
        one,
        result("a", np.ones(40), dataset=dataset | {"fingerprint": "1" * 64}),
        result("a", np.ones(40), settings=settings | {"protocol": "paper"}),
    ]

    assert len(make_boards(entries)) == 3


def test_published_rows_alone_make_a_board() -> None:
    (board,) = make_boards([_published(), _published("cswm", 18.2)])

    assert (board.environment, board.fingerprint, board.triplets) == ("grid_world", "", None)
    assert [row.name for row in board.rows] == ["dmotion", "cswm"]


def test_published_rows_do_not_stand_beside_continuous_actions(result: Callable[..., Entry]) -> None:
    discrete = result("a", np.ones(40))
    continuous = result("a", np.ones(40), dataset={**discrete.content["dataset"], "actions": "continuous"})

    counts = [
        len([row for row in board.rows if row.kind == "published"]) for board in make_boards([discrete, _published()])
    ]
    (board,) = make_boards([continuous, _published()])

    assert counts == [1]
    assert not [row for row in board.rows if row.kind == "published"]
