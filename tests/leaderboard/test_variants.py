"""Variants of a model: what tells their rows apart, in words, colours and markers."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from dmotion_bench.errors import EntryInvalid
from leaderboard.board import make_boards
from leaderboard.chart import COLORS
from leaderboard.curves import assign_styles, legend
from leaderboard.entry import Entry

from .conftest import row_named


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

    assert row_named(board, "a").variant == words
    assert row_named(board, "b").variant == ""
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

    assert row_named(board, "a").variant == variant


def test_another_s_run_of_the_same_name_and_seed_is_a_row_of_its_own(
    sound: Entry, changed: Callable[..., Entry]
) -> None:
    theirs = changed(weights="9" * 64)

    (board,) = [board for board in make_boards([sound, theirs]) if board.dataset]

    measured = [row for row in board.rows if row.kind == "measured"]
    assert [row.seeds for row in measured] == [1, 1]
    assert {row.variant for row in measured} == {f"weights {sound.content['weights'][:8]}", "weights 99999999"}


def test_one_entry_renames_no_row_of_several_trainings(sound: Entry, changed: Callable[..., Entry]) -> None:
    """Its settings, threads and preset may be others, or it may be the same training, repeated elsewhere."""
    ours = [sound, *(changed(seed=seed, run=f"{sound.name[:-1]}{seed}", weights=f"{seed}" * 64) for seed in (1, 2))]
    repeated = changed(weights="9" * 64)
    longer = changed(weights="8" * 64, preset="small", run=f"{sound.name[:-3]}-small-s0")

    (board,) = [board for board in make_boards([*ours, repeated, longer]) if board.dataset]

    measured = {row.variant: row.seeds for row in board.rows if row.kind == "measured"}
    assert measured[""] == 3
    assert sorted(measured.values()) == [1, 1, 3]
    assert "small" in measured


def test_a_name_that_says_no_settings_is_told_however_many_trainings_have_it(result: Callable[..., Entry]) -> None:
    """Their row would else be called as that of the usual settings is."""
    usual = f"a-{result('a', np.ones(40)).content['dataset']['name']}"
    own = [result("a", np.ones(40), run=f"own-s{seed}", seed=seed, weights=f"{seed}" * 64) for seed in range(3)]

    (board,) = make_boards([result("a", np.ones(40), run=f"{usual}-s0"), *own])

    assert {row.variant: row.seeds for row in board.rows if row.kind == "measured"} == {"": 1, "own": 3}


def test_the_number_of_threads_tells_rows_apart_only_where_nothing_else_does(result: Callable[..., Entry]) -> None:
    dataset = str(result("a", np.ones(40)).content["dataset"]["name"])

    def variants(*settings: str) -> set[str]:
        runs = [f"a-{dataset}-{one}-s0" for one in settings]
        (board,) = make_boards([result("a", np.ones(40), run=run) for run in runs])
        return {row.variant for row in board.rows if row.kind == "measured"}

    assert variants("threads_1", "epochs_3") == {"", "epochs 3"}
    assert variants("epochs_3-threads_1", "epochs_3-threads_2") == {"epochs 3, threads 1", "epochs 3, threads 2"}
