"""Standings: seeds, paired differences to the best, published rows and references beside them."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import EntryInvalid
from leaderboard.board import Board, make_boards
from leaderboard.chart import COLORS
from leaderboard.curves import assign_styles, legend
from leaderboard.entry import Entry
from leaderboard.page import make_page
from leaderboard.row import Row
from leaderboard.standings import control_standings

Changed = Callable[..., Entry]
EPISODES = list(range(40))
FRAMES = 25


@pytest.fixture
def result(sound: Entry) -> Callable[..., Entry]:
    """Makes an entry whose error in each episode is given."""

    def make(model: str, errors: np.ndarray, *, seed: int = 0, labels: Any = "one-shot", **content: Any) -> Entry:
        made = copy.deepcopy(dict(sound.content))
        figure = {"mean": float(errors.mean()), "std": 1.0, "low": None, "high": None, "n": FRAMES * len(EPISODES)}
        sums = {"episode": EPISODES, "n": [FRAMES] * len(EPISODES), "sum": (errors * FRAMES).tolist()}
        told = labels if isinstance(labels, dict) else {"asked": labels, "given": {}, "total": 4}
        made |= {"model": model, "seed": seed, "run": f"{model}-{told['asked']}-s{seed}", "weights": f"{seed:064x}"}
        made |= {"figures": made["figures"] | {"mse": figure}, "by_episode": {"mse": sums}}
        made["labels"] = told
        return Entry(made | content)

    return make


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


def _row(board: Board, name: str) -> Row:
    (row,) = (row for row in board.rows if row.name == name and row.kind == "measured")
    return row


@pytest.mark.slow
def test_seeds_are_one_row_with_their_range(result: Callable[..., Entry]) -> None:
    errors = np.linspace(1, 3, 40)
    entries = [result("a", errors * factor, seed=seed) for seed, factor in ((1, 2.0), (0, 1.0), (2, 1.5))]

    (board,) = make_boards(entries)
    row = _row(board, "a")
    value = row.figures["mse"]

    assert (row.seeds, [entry.content["seed"] for entry in row.entries]) == (3, [0, 1, 2])
    assert (value.mean, value.low, value.high) == pytest.approx((3.0, 2.0, 4.0))


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
    row = _row(board, "two")
    value = row.figures["control_distance[100]"]

    assert (row.seeds, row.figures["mse"].seeds, value.seeds) == (2, 2, 1)
    assert (value.mean, value.low, value.high) == pytest.approx((0.5, 0.4, 0.6))
    assert "control_distance[100]" in _row(board, "other").leads
    assert "control_distance[100]" not in row.leads
    assert "1 of 2 seeds" in (control_standings(board, "b") or "")


def test_a_row_is_bold_only_where_it_cannot_be_told_from_the_best(result: Callable[..., Entry]) -> None:
    generator = np.random.default_rng(0)
    hard = generator.gamma(2, 10, 40)
    entries = [
        result("best", hard),
        result("same", hard + generator.normal(0.01, 1, 40)),
        result("worse", hard + 1 + generator.normal(0, 0.5, 40)),  # far less than the episodes' own spread
    ]

    (board,) = make_boards(entries)

    assert _row(board, "best").is_best
    assert _row(board, "same").ties
    worse = _row(board, "worse")
    assert worse.behind is not None
    assert worse.behind.low is not None
    assert 0.5 < worse.behind.low < worse.behind.mean < 1.5
    assert not worse.ties


def test_entries_that_cannot_be_paired_are_not_compared(result: Callable[..., Entry]) -> None:
    one = result("one", np.ones(40))
    other = result("other", np.full(40, 2.0), by_episode={})

    (board,) = make_boards([one, other])

    assert _row(board, "other").behind is None
    assert not _row(board, "other").ties


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


def test_runs_of_the_same_model_and_budget_are_told_apart_by_their_names(result: Callable[..., Entry]) -> None:
    entries = [result("a", np.ones(40), run="a-affine-s0"), result("a", np.ones(40), run="a-plain-s0")]

    (board,) = make_boards(entries)

    assert {row.variant for row in board.rows if row.kind == "measured"} == {"a-affine", "a-plain"}


@pytest.mark.parametrize(
    ("use", "words"),
    [(None, ""), ("during", "few labels during the training"), ("finetuned", "fine-tuned on its labels")],
)
def test_an_unusual_use_of_labels_stands_on_the_row(result: Callable[..., Entry], use: str | None, words: str) -> None:
    given = {"asked": "64", "given": {"demonstrations": 64}, "total": 64} | ({"use": use} if use else {})
    other = result("b", np.ones(40), labels="64")

    (board,) = make_boards([other, result("a", np.ones(40), labels=given)])

    assert _row(board, "a").variant == words
    assert _row(board, "b").variant == ""
    with pytest.raises(EntryInvalid, match=r"labels\.use"):
        result("a", np.ones(40), labels=given | {"use": "never"})


def test_a_model_has_one_colour_and_the_models_of_most_boards_share_theirs_with_nobody(
    result: Callable[..., Entry],
) -> None:
    names = [f"m{number}" for number in range(COLORS + 3)]
    second = {"dataset": result("y", np.ones(40)).content["dataset"] | {"fingerprint": "f" * 64}}
    entries = [result(name, np.ones(40)) for name in (*names, "y", "z")]
    entries += [result(name, np.ones(40), **second) for name in ("y", "z")]
    entries += [result("z", np.ones(40), run="z-affine-s0", weights="1" * 64)]
    boards = make_boards(entries)
    styles = assign_styles(boards)

    colors: dict[str, set[str]] = {}
    for (model, _), style in styles.items():
        colors.setdefault(model, set()).add(style.color)
    assert {len(own) for own in colors.values()} == {1}
    for first in ("y", "z"):
        assert not any(colors[first] & own for model, own in colors.items() if model != first)
    for board in boards:
        lines = {(row.model, row.variant) for row in board.rows if row.model}
        assert len({(styles[line].color, styles[line].marker) for line in lines}) == len(lines)


def test_a_variant_of_a_model_has_its_own_colour_and_marker(result: Callable[..., Entry]) -> None:
    entries = [result("a", np.ones(40), run="a-affine-s0"), result("a", np.ones(40), run="a-plain-s0")]
    (board,) = make_boards(entries)

    styles = assign_styles([board])

    looks = [(one.color, one.marker) for one in styles.values()]
    assert set(styles) == {("a", "a-affine"), ("a", "a-plain")}
    assert looks[0] != looks[1]
    assert all(f"a ({variant})" in str(legend(board, styles)) for _, variant in styles)


@pytest.mark.parametrize(
    ("run", "variant"),
    [
        ("a-DATASET-s0", ""),
        ("a-DATASET-epochs_3-s0", "epochs 3"),
        ("a-DATASET-5-shot-epochs_3-s1", "epochs 3"),
        ("a-DATASET-epochs_3-threads_1-s1", "epochs 3"),
        ("a-DATASETx-s0", "a-DATASETx"),
    ],
)
def test_what_a_run_s_name_says_beyond_model_data_and_budget(
    result: Callable[..., Entry], run: str, variant: str
) -> None:
    one = result("a", np.ones(40))
    name, variant = (words.replace("DATASET", str(one.content["dataset"]["name"])) for words in (run, variant))
    entries = [result("a", np.ones(40), run=own, labels="5-shot") for own in (name, "another-s0")]

    (board,) = make_boards(entries)

    assert {row.variant for row in board.rows if row.kind == "measured"} == {variant, "another"}


@pytest.mark.parametrize(
    ("run", "variant"),
    [
        ("a-DATASET-s0", ""),
        ("a-DATASET-threads_1-s0", ""),
        ("a-DATASET-epochs_3-threads_1-s0", "epochs 3"),
        ("a-DATASET-warp_True-learning_rate_1e-3-s0", "learning rate 0.001, warp true"),
        ("a-DATASET-learning_rate_0.001-warp_true-s0", "learning rate 0.001, warp true"),
        ("a-ENVIRONMENT-PRESET-epochs_3-s0", "epochs 3"),  # of a data set that was given another name since
        ("my-own-s0", ""),
    ],
)
def test_unusual_settings_stand_on_the_only_row_of_a_model(
    result: Callable[..., Entry], run: str, variant: str
) -> None:
    sample = result("a", np.ones(40))
    name = run.replace("DATASET", str(sample.content["dataset"]["name"]))
    name = name.replace("ENVIRONMENT", sample.environment).replace("PRESET", str(sample.content["preset"]))

    (board,) = make_boards([result("a", np.ones(40), run=name)])

    assert _row(board, "a").variant == variant


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
    monkeypatch.setattr("leaderboard.board.CONTROL_VERSION", 7)
    entries = [
        planned("both", 0.9, "0.1.0+2140d529a1bd"),
        planned("both", 0.5, 7, seed=1),
        planned("old", 0.3, "0.1.0+2140d529a1bd"),
        planned("old", 0.2, "0.1.0+2140d529a1bd", seed=1),
    ]

    (board,) = make_boards(entries)

    both, old = _row(board, "both"), _row(board, "old")
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

    both, usual, apart = (_row(board, name) for name in ("both", "usual", "other"))
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
        content = dict(changed(run=name, model=name).content)
        figures = dict(content["figures"]) | {figure: dict(content["figures"]["mse"]) | {"mean": mean}}
        return Entry(content | {"figures": figures, "settings": content["settings"] | {"gain_seed": 0} | other})

    (board,) = make_boards([of("a", 0.5), of("b", 0.6), of("c", 0.9, **settings)])

    assert {row.name: figure in row.figures for row in board.rows if row.kind == "measured"} == {
        "a": True,
        "b": True,
        "c": False,
    }


def test_an_oracle_of_another_planner_is_marked(planned: Callable[..., Entry], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("leaderboard.board.CONTROL_VERSION", 7)
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


def test_another_s_run_of_the_same_name_and_seed_is_a_row_of_its_own(
    sound: Entry, changed: Callable[..., Entry]
) -> None:
    theirs = changed(weights="9" * 64)

    (board,) = [board for board in make_boards([sound, theirs]) if board.dataset]

    measured = [row for row in board.rows if row.kind == "measured"]
    assert [row.seeds for row in measured] == [1, 1]
    assert {row.variant for row in measured} == {f"weights {sound.content['weights'][:8]}", "weights 99999999"}


def test_the_number_of_threads_tells_rows_apart_only_where_nothing_else_does(result: Callable[..., Entry]) -> None:
    dataset = str(result("a", np.ones(40)).content["dataset"]["name"])

    def variants(*settings: str) -> set[str]:
        runs = [f"a-{dataset}-{one}-s0" for one in settings]
        (board,) = make_boards([result("a", np.ones(40), run=run) for run in runs])
        return {row.variant for row in board.rows if row.kind == "measured"}

    assert variants("threads_1", "epochs_3") == {"", "epochs 3"}
    assert variants("epochs_3-threads_1", "epochs_3-threads_2") == {"epochs 3, threads 1", "epochs 3, threads 2"}
