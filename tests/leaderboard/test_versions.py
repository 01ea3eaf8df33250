"""Two versions of scoring, or of control, in one folder: each has boards of its own, and nothing mixes them."""

from __future__ import annotations

import copy
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import UsageError
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.workspace import Workspace
from leaderboard.board import Board, make_boards
from leaderboard.board_tables import board_section
from leaderboard.check import CheckSettings, check_entry
from leaderboard.chosen import find_rows, read_choices
from leaderboard.entry import Entry
from leaderboard.entry_file import write_entry
from leaderboard.model_results import model_lines
from leaderboard.page import make_page
from leaderboard.results import write_results
from leaderboard.summary import summarise

from .conftest import TASK_EPISODES, row_named

MakeEntry = Callable[..., Entry]
QUICK = CheckSettings(score=False)
ERRORS = np.random.default_rng(0).gamma(2, 10, 40)


@pytest.fixture
def entries(result: MakeEntry) -> list[Entry]:
    """Of one model two trainings that this version scored, and two that the next one did, with half of the error."""
    now = [result("a", ERRORS + seed, seed=seed, weights=f"{seed:064x}") for seed in range(2)]
    then = [
        result("a", ERRORS / 2 + seed, seed=seed, weights=f"{seed:064x}", scoring_version=2) for seed in range(2, 4)
    ]
    return [*now, *then, result("b", ERRORS + 5)]


def test_what_another_version_scored_is_neither_averaged_nor_ranked_with_the_rest(entries: list[Entry]) -> None:
    now, then = make_boards(entries)

    assert (now.title, then.title) == ("Grid World, version 2", "Grid World, version 2, scored by version 2")
    assert row_named(now, "a").figures["mse"].mean == pytest.approx(ERRORS.mean() + 0.5)
    assert row_named(now, "a").is_best
    behind = row_named(now, "b").behind
    assert behind is not None
    assert behind.mean == pytest.approx(4.5)
    assert [row.seeds for row in then.rows if row.kind == "measured"] == [2]


def test_page_and_tables_name_the_other_version(entries: list[Entry]) -> None:
    now, then = make_boards(entries)
    page = make_page(entries)

    assert page.count("<h2>Grid World, version 2, scored by version 2") == 1
    assert page.count("<h2>Grid World, version 2<") == 1
    assert board_section(then)[0] == f"{board_section(now)[0]}, scored by version 2"
    lines = [line for line in model_lines("a", [now, then]) if line.startswith("| grid")]
    assert [", scored by version 2 |" in line for line in lines] == [False, True]


def test_sentences_of_a_page_take_this_version(entries: list[Entry], tmp_path: Path) -> None:
    for entry in entries:
        write_entry(entry, tmp_path / "entries")
    (tmp_path / "chosen.toml").write_text(
        '[[row]]\nname = "a"\ntitle = "frames"\nmodel_title = "A"\nboard = "grid_world-tiny"\nmodel = "a"\n'
        'labels = "one-shot"\nfigure = "mse"\n'
    )
    page = tmp_path / "page.md"
    page.write_text("It is <!-- results:a -->?<!-- /results -->.\n")
    write_results(tmp_path, [page])

    (found,) = re.findall(r"-->([\d.]+)<!--", page.read_text())
    assert float(found) == pytest.approx(ERRORS.mean() + 0.5, rel=0.01)


def test_a_row_of_another_version_alone_is_not_chosen(entries: list[Entry], tmp_path: Path) -> None:
    (tmp_path / "chosen.toml").write_text(
        '[[row]]\nname = "a"\ntitle = "frames"\nmodel_title = "A"\nboard = "grid_world-tiny"\nmodel = "a"\n'
        'labels = "one-shot"\nfigure = "mse"\n'
    )
    later = [entry for entry in entries if entry.content["scoring_version"] == 2]

    with pytest.raises(UsageError, match="asks for the board 'grid_world-tiny', and none is there"):
        find_rows(read_choices(tmp_path / "chosen.toml"), make_boards(later))


def test_a_summary_over_worlds_is_of_one_version(result: MakeEntry) -> None:
    def world(name: str, digit: str, **more: Any) -> list[Entry]:
        dataset = {"name": f"{name}-small", "environment": name, "fingerprint": digit * 64}
        return [
            result(model, ERRORS + place, run=f"{model}-{name}-small-s0", preset="small", dataset=dataset, **more)
            for place, model in enumerate("abc")
        ]

    apart = summarise(make_boards([*world("grid_world", "1"), *world("robot_push", "2", scoring_version=2)]))
    together = summarise(make_boards([*world("grid_world", "1"), *world("robot_push", "2")]))

    assert apart is None
    assert together is not None
    assert len(together.boards) == 2


@pytest.fixture
def planned(controlled: MakeEntry) -> list[Entry]:
    """Of one model's control a training of this version, and one of the next, which leaves nothing."""
    left = np.linspace(0.1, 0.9, len(TASK_EPISODES))
    now, later = controlled("a", left), controlled("a", left * 0, seed=1)
    settings = later.content["settings"] | {"control_version": 2}
    return [now, Entry(dict(later.content) | {"settings": settings})]


def test_control_of_another_version_has_a_table_of_its_own(planned: list[Entry]) -> None:
    now, then = make_boards(planned)

    for board, left in ((now, 0.5), (then, 0.0)):
        assert board.control is not None
        (row,) = (row for row in board.control.rows if row.entries)
        assert (row.cells["generic"].left.mean, row.cells["generic"].trainings) == (pytest.approx(left), 1)
    assert (now.made_by, then.made_by) == ("", "control of version 2")
    assert "control of version 2" in make_page(planned)


def test_control_is_not_set_apart_by_the_version_of_scoring(planned: list[Entry]) -> None:
    """Which decides predictions alone."""
    later = Entry(dict(planned[0].content) | {"scoring_version": 2, "seed": 1, "weights": "f" * 64})
    (board,) = make_boards([planned[0], later])

    assert board.control is not None
    assert board.control.rows[0].cells["generic"].trainings == 2


def test_of_two_versions_of_the_gain_this_one_s_is_compared(result: MakeEntry) -> None:
    """However many entries have the other one."""
    figure = {"mean": 0.5, "std": 0.1, "low": None, "high": None, "n": 40}

    def of(model: str, version: int, seed: int) -> Entry:
        entry = result(model, ERRORS, seed=seed)
        settings = entry.content["settings"] | {"gain_version": version}
        return Entry(
            dict(entry.content) | {"figures": {**entry.figures, "planning_gain": figure}, "settings": settings}
        )

    (board,) = make_boards([of("a", 1, 0), *(of("b", 2, seed) for seed in range(1, 4))])

    assert ["planning_gain" in row_named(board, name).figures for name in "ab"] == [True, False]


@pytest.mark.slow
@pytest.mark.parametrize("settings", [QUICK, CheckSettings()])
def test_figures_of_another_version_are_not_held_against_this_one_s(
    workspace: Workspace, sound: Entry, shared: SharedSamples, settings: CheckSettings
) -> None:
    content = copy.deepcopy(dict(sound.content)) | {"scoring_version": 2}
    content["figures"]["mse"]["mean"] *= 2

    verdict = check_entry(Entry(content), workspace, settings, shared=shared)

    assert verdict.findings == ()
    (said,) = verdict.missing
    assert said.startswith("version: the entry was scored by version 2, this is version 1; its figures were not")


def test_boards_of_one_page_have_different_keys(entries: list[Entry], planned: list[Entry]) -> None:
    boards: list[Board] = make_boards([*entries, *planned])

    assert len({board.key for board in boards}) == len(boards) == 4
