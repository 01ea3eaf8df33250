"""Entries that look like results and would be ranked first, or hide others, if a board believed them."""

from __future__ import annotations

import copy
import shutil
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import RunMismatch
from dmotion_bench.pairing import compare_runs
from dmotion_bench.workspace import Workspace
from leaderboard.board import make_boards
from leaderboard.board_tables import board_section
from leaderboard.entry import Entry
from leaderboard.gallery import gallery
from leaderboard.model_results import model_lines
from leaderboard.page import make_page
from leaderboard.verdict import Verdict, copies_found

from .conftest import EPISODES, FRAMES, TASK_EPISODES, figure_over, row_named

MakeEntry = Callable[..., Entry]
HARD = np.random.default_rng(0).gamma(2, 10, len(EPISODES))


def _with(entry: Entry, **parts: dict[str, Any]) -> Entry:
    """The entry with some parts replaced, each by the figures, settings ... that are given and its others."""
    content = copy.deepcopy(dict(entry.content))
    return Entry(content | {name: content[name] | own for name, own in parts.items()})


def _over(entry: Entry, errors: np.ndarray, episodes: list[int]) -> Entry:
    """The entry with errors on some episodes alone."""
    count = len(episodes)
    figure = {"mean": float(errors[episodes].mean()), "std": 1.0, "low": None, "high": None, "n": FRAMES * count}
    sums = {"episode": episodes, "n": [FRAMES] * count, "sum": (errors[episodes] * FRAMES).tolist()}
    return _with(entry, figures={"mse": figure}, by_episode={"mse": sums})


def _unpaired(entry: Entry) -> Entry:
    return Entry(dict(entry.content) | {"by_episode": {}})


def _of_less(entry: Entry) -> Entry:
    """A mean that is not that of the errors by episode."""
    return _with(entry, figures={"mse": dict(entry.figures["mse"]) | {"mean": 1e-3}})


@pytest.mark.parametrize(
    "unfair",
    [
        lambda entry: _over(entry, HARD, [5, 39]),
        _unpaired,
        _of_less,
        lambda entry: _with(entry, figures={"mse": dict(entry.figures["mse"]) | {"n": 10**9}}),
    ],
    ids=["easy episodes", "no errors by episode", "another mean", "another number of frames"],
)
def test_errors_of_other_frames_are_neither_the_best_nor_hide_who_is(
    result: MakeEntry, unfair: Callable[[Entry], Entry]
) -> None:
    honest = [result("a", HARD, weights="a" * 64), result("b", HARD + 5, weights="b" * 64)]
    entries = [*honest, unfair(result("odd", HARD / 4, weights="c" * 64))]
    (board,) = make_boards(entries)

    assert row_named(board, "a").is_best
    behind = row_named(board, "b").behind
    assert behind is not None
    assert behind.mean == pytest.approx(5)
    odd = row_named(board, "odd")
    assert (odd.is_best, odd.ties, odd.behind) == (False, False, None)
    assert odd.variant == "scored on other frames"
    assert "**" not in next(line for line in board_section(board) if "odd" in line)
    assert board.triplets == FRAMES * len(EPISODES)


def test_a_training_on_other_frames_is_not_averaged(result: MakeEntry) -> None:
    few = _over(result("a", HARD, seed=2, weights="2" * 64), HARD, list(range(5)))
    entries = [result("a", HARD, seed=seed, weights=f"{seed}" * 64) for seed in range(2)]
    (board,) = make_boards([*entries, few])

    assert sorted((row.variant, row.seeds) for row in board.rows if row.kind == "measured") == [
        ("", 2),
        ("scored on other frames", 1),
    ]


def test_a_precision_of_its_own_is_not_compared(result: MakeEntry) -> None:
    """Not even where most have it: models predict in float32."""
    coarse = [_with(result(name, HARD / 2, weights=name * 64), settings={"precision": "bf16"}) for name in "bc"]
    (board,) = make_boards([result("a", HARD, weights="a" * 64), *coarse])

    assert row_named(board, "a").is_best
    assert [(row_named(board, name).ties, row_named(board, name).behind) for name in "bc"] == [(False, None)] * 2
    (alone,) = make_boards(coarse)
    assert [row_named(alone, name).ties for name in "bc"] == [True, True]


def test_copies_of_one_training_are_no_further_trainings(result: MakeEntry) -> None:
    """And change neither the name nor the place of the row that has the training."""
    copies = [result("a", HARD, seed=seed, weights="a" * 64) for seed in range(3)]
    (board,) = make_boards([*copies, result("a", HARD + 1, seed=3), result("b", HARD, weights="b" * 64)])

    assert {row.variant: (row.seeds, row.ties) for row in board.rows if row.name == "a"} == {
        "": (2, True),
        "the weights of seed 0 as seed 1": (1, False),
        "the weights of seed 0 as seed 2": (1, False),
    }


@pytest.mark.parametrize("controlled_by", [None, "generic"])
def test_one_entry_does_not_say_how_many_labels_a_row_has(
    result: MakeEntry, controlled: MakeEntry, controlled_by: str | None
) -> None:
    def of(seed: int, total: int) -> Entry:
        labels = {"asked": "100%", "given": {}, "total": total}
        if controlled_by is not None:
            return controlled("a", LEFT, seed=seed, labels=labels)
        return result("a", HARD, seed=seed, labels=labels)

    (board,) = make_boards([of(0, 4), of(1, 20_000), of(2, 20_000)])
    table = board.control
    rows = board.rows if table is None else table.rows

    assert {row.label_count for row in rows if row.entries} == {20_000}


def test_what_references_do_is_not_what_one_entry_says(result: MakeEntry) -> None:
    """Whose name comes first: with a worse copying everybody would look better, and with a better one worse."""
    honest = [result(name, HARD, weights=f"{place}" * 64) for place, name in enumerate(("b", "c"))]
    copied = honest[0].content["reference"]["copy_last"]
    liar = result("a", HARD, weights="f" * 64)
    liar = _with(liar, reference={"copy_last": {**copied, "mse": dict(copied["mse"]) | {"mean": 1e-3}}})
    (board,) = make_boards([liar, *honest])

    assert board.reference("copy_last")["mse"].mean == copied["mse"]["mean"]


def test_many_entries_of_one_training_have_one_vote(result: MakeEntry) -> None:
    few = list(range(5))
    loud = [_over(result(f"loud{place}", HARD, weights="f" * 64), HARD / 9, few) for place in range(5)]
    (board,) = make_boards([*loud, *(result(name, HARD, weights=name * 64) for name in "ab")])

    assert board.triplets == FRAMES * len(EPISODES)
    assert {row.name for row in board.rows if row.ties} == {"a", "b"}


LEFT = np.linspace(0.1, 0.9, len(TASK_EPISODES))


def _claiming(entry: Entry, tasks: int, steps: int = 2) -> Entry:
    """An entry that says it solved so many tasks in so many steps."""
    figure = f"control_distance[{steps}]"
    sums = {"episode": list(range(tasks)), "n": [1] * tasks, "sum": [0.0] * tasks}
    figures = {figure: figure_over(0.0, tasks), "control_success": figure_over(1.0, tasks)}
    return _with(entry, figures=figures, by_episode={figure: sums})


@pytest.mark.parametrize(("tasks", "steps"), [(1000, 2), (3, 2), (len(LEFT), 50), (len(LEFT) - 1, 2)])
def test_other_tasks_or_steps_hide_nobody_and_rank_nowhere(controlled: MakeEntry, tasks: int, steps: int) -> None:
    honest = [controlled("a", LEFT), controlled("a", LEFT, seed=1), controlled("b", LEFT / 2)]
    odd = _claiming(controlled("odd", LEFT, seed=7), tasks, steps)
    (board,), (without,) = make_boards([*honest, odd]), make_boards(honest)

    assert board.control is not None
    assert without.control is not None
    left, left_without = (
        [(row.title, {name: cell.left for name, cell in row.cells.items()}) for row in rows]
        for rows in (board.control.compared, without.control.rows)
    )
    assert left == left_without
    assert board.control.detectable == without.control.detectable
    assert board.control.steps == 2
    assert [row.name for row in board.control.rows if row.entries] == ["b", "a", "odd"]
    told = f"not compared: {tasks:,} tasks of the episodes 0 to {tasks - 1}, {steps} steps"
    assert f"| odd ({told}) |" in "\n".join(board_section(board))
    assert f"<small>{told}</small>" in make_page([*honest, odd])
    assert told in "\n".join(model_lines("odd", [board]))
    assert [row.name for row in board.by_column["generic"].rows if row.kind == "measured"] == ["b", "a"]


def test_an_odd_training_under_an_honest_name_hides_no_training_of_it(controlled: MakeEntry) -> None:
    honest = [controlled("a", LEFT, seed=seed) for seed in range(2)]
    (board,) = make_boards([*honest, _claiming(controlled("a", LEFT, seed=7), 1000)])

    assert board.control is not None
    assert [(row.cells["generic"].trainings, bool(row.extent)) for row in board.control.rows if row.entries] == [
        (2, False),
        (1, True),
    ]


def test_copies_of_one_training_count_once_in_control(controlled: MakeEntry) -> None:
    copies = [controlled("a", LEFT, seed=seed, weights="a" * 64) for seed in range(3)]
    (board,) = make_boards(copies)

    assert board.control is not None
    assert board.control.rows[0].cells["generic"].trainings == 1


def test_the_references_of_control_are_not_what_one_entry_says(controlled: MakeEntry) -> None:
    liar = controlled("0-first", LEFT, seed=7)
    idle = {**liar.content["reference"]["idle"], "control_distance[2]": figure_over(0.01, len(LEFT))}
    honest = [controlled("a", LEFT, seed=seed) for seed in range(2)]
    (board,) = make_boards([_with(liar, reference={"idle": idle}), *honest])

    assert board.control is not None
    (row,) = (row for row in board.control.rows if row.name == "idle")
    assert row.cells["generic"].left.mean == 1.0


def test_control_of_fewer_tasks_than_its_settings_say_does_not_lead(result: MakeEntry) -> None:
    def of(name: str, distances: np.ndarray, weights: str) -> Entry:
        count = len(distances)
        figure = {"mean": float(distances.mean()), "std": 0.1, "low": None, "high": None, "n": count}
        sums = {"episode": list(range(count)), "n": [1] * count, "sum": distances.tolist()}
        entry = result(name, HARD, weights=weights * 64)
        figures = {"control_distance[100]": figure, "control_success": figure_over(0.5, count)}
        return _with(
            entry,
            figures=figures,
            by_episode={"control_distance[100]": sums},
            settings={"control_version": 1, "control_tasks": 25},
        )

    (board,) = make_boards([of("a", LEFT, "a"), of("b", LEFT + 0.3, "b"), of("odd", LEFT[:3], "c")])

    assert {row.name for row in board.rows if row.leads} == {"a"}
    assert row_named(board, "odd").planned_otherwise


def test_one_training_under_two_names_is_told_of() -> None:
    def verdict(run: str, weights: str, seed: int = 0) -> Verdict:
        return Verdict(entry=run, findings=(), weights=weights, seed=seed, run=run)

    first, second, other = copies_found([verdict("a-s0", "1"), verdict("best-s0", "1"), verdict("b-s0", "2")])

    assert first.remarks == ("weights: the run best-s0 has the same; they are one training under two names",)
    assert second.remarks == ("weights: the run a-s0 has the same; they are one training under two names",)
    assert (first.holds, other.remarks) == (True, ())


def test_pictures_of_other_steps_hide_nobody_s(sound: Entry, result: MakeEntry) -> None:
    """The entry with the least error is the first, and would say which steps are shown."""
    own = sound.content["pictures"]
    others = [dict(picture) | {"step": picture["step"] + 1} for picture in own]
    honest = [result(name, HARD) for name in ("a", "b")]
    (board,) = make_boards([*honest, result("odd", HARD / 4, pictures=others)])

    shown = str(gallery(board, len(own)))

    assert own
    assert board.rows[0].name == "odd"
    assert shown.count("<span>a</span>") == shown.count("<span>b</span>") == len(own)
    assert "<span>odd</span>" not in shown


def test_copies_of_one_training_are_not_several(workspace: Workspace) -> None:
    """The mean of copies would have the interval of trainings that all agree."""
    first, other = (workspace.runs / f"dmotion-grid_world-tiny-s{seed}" for seed in (0, 1))
    copied = first.with_name(first.name.replace("-s0", "-s2"))
    shutil.copytree(first, copied)
    for name in ("run.json", "report/report.json"):
        text = (copied / name).read_text()
        (copied / name).write_text(text.replace('"seed": 0,', '"seed": 2,', 1).replace(first.name, copied.name))

    with pytest.raises(
        RunMismatch, match=f"{first.name}' and '{copied.name}' have the same weights, so they are one training"
    ):
        compare_runs([first, copied], other)
