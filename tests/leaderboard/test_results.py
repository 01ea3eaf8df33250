"""Results in pages: every number is that of the entries, rows say what they are of, and odd input breaks nothing."""

from __future__ import annotations

import copy
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from dmbench_command import dmbench

from dmotion_bench.errors import UnknownName, UsageError
from dmotion_bench.scoring.statistics import EpisodeBootstrap
from leaderboard import planners
from leaderboard.board import Board, make_boards
from leaderboard.board_tables import board_section, published_section
from leaderboard.chosen import TUNED_NOTE, chosen_table, find_rows, numbers, read_choices
from leaderboard.entry import Entry
from leaderboard.entry_file import write_entry
from leaderboard.markdown_numbers import TO
from leaderboard.model_results import model_lines
from leaderboard.page import make_page
from leaderboard.results import filled, write_results
from leaderboard.usual import OTHER_FRAMES

from .conftest import weights_of

EPISODES = 12
CHOSEN = """
[[row]]
name = "mse"
title = "next frame"
model_title = "A model"
board = "grid_world-tiny"
model = "a"
labels = "one-shot"
figure = "mse"
baseline = "copy_last"

[[row]]
name = "control"
title = "control"
model_title = "A model"
board = "grid_world-tiny"
model = "a"
labels = "one-shot"
figure = "control_distance[50]"
baseline = "idle"
"""


@pytest.fixture
def result(sound: Entry) -> Callable[..., Entry]:
    """Makes an entry of which the error and the distance of control in each episode are given."""

    def make(model: str, errors: np.ndarray, distances: np.ndarray | None = None, **content: Any) -> Entry:
        made = copy.deepcopy(dict(sound.content)) | {"model": model, "run": f"{model}-{content}"}
        made["weights"] = weights_of(model, content.get("seed", 0))
        made["figures"], made["by_episode"] = {}, {}
        figures = {"mse": (errors, 7), "control_distance[50]": (distances, 2), "control_success": (distances, 2)}
        for name, (values, count) in figures.items():
            if values is not None:
                low, high = _interval(values)
                mean = float(values.mean())
                made["figures"][name] = {"mean": mean, "std": 1.0, "low": low, "high": high, "n": count * EPISODES}
                counts = {"episode": list(range(EPISODES)), "n": [count] * EPISODES}
                made["by_episode"][name] = counts | {"sum": (values * count).tolist()}
        if distances is not None:
            made["settings"] = made["settings"] | {"control_code": "planner-1", "control_tasks": 2 * EPISODES}
            idle = {"mean": 1.0, "std": 0.0, "low": 1.0, "high": 1.0, "n": 2 * EPISODES}
            made["reference"] = made["reference"] | {"idle": {"control_distance[50]": idle}}
        made["labels"] = {"asked": "one-shot", "given": {}, "total": 4}
        return Entry(made | content)

    return make


def _interval(values: np.ndarray) -> tuple[float, float]:
    estimate = EpisodeBootstrap(np.arange(len(values))).mean(values)
    assert estimate is not None
    assert estimate.low is not None
    assert estimate.high is not None
    return estimate.low, estimate.high


@pytest.fixture
def errors() -> list[np.ndarray]:
    return [np.random.default_rng(seed).gamma(2.0, 3.0, EPISODES) for seed in range(2)]


@pytest.fixture
def board(result: Callable[..., Entry], errors: list[np.ndarray]) -> Board:
    entries = [result("a", one, one / 20, seed=seed, run=f"a-s{seed}") for seed, one in enumerate(errors)]
    published = {"format": "dmbench-entry/1", "kind": "published", "source": "A paper", "note": "A note."}
    figures = {"mse": {"mean": 14.3, "std": 99.8, "low": None, "high": None, "n": None}}
    own = {"model": "a", "environment": "grid_world", "labels": {"asked": "one-shot", "total": 4}, "figures": figures}
    (made,) = make_boards([*entries, Entry(published | own)])
    return made


def _cells(lines: list[str], first: str) -> list[str]:
    (line,) = (line for line in lines if line.startswith(f"| {first} |"))
    return [cell.strip() for cell in line.strip("|").split("|")]


def test_several_trainings_have_their_mean_its_interval_over_episodes_and_their_range(
    board: Board, errors: list[np.ndarray]
) -> None:
    mean = np.mean(errors, axis=0)
    low, high = _interval(mean)
    (row,) = (row for row in board.rows if row.kind == "measured")
    value = row.figures["mse"]
    assert value.mean == pytest.approx(mean.mean())
    assert value.interval == pytest.approx((low, high))
    assert (value.low, value.high) == pytest.approx(sorted(one.mean() for one in errors))
    assert value.samples == 7 * EPISODES

    section = board_section(board)
    cells = _cells(section[: section.index("", 4)], "a")
    assert cells[1] == "4 (1 each)"
    assert cells[2] == f"2: {value.low:.2f} to {value.high:.2f}"
    assert cells[3] == f"**{mean.mean():.2f}** ({low:#.2g}{TO}{high:#.2g})"
    assert cells[4] == "14.3"


def test_trainings_that_were_scored_on_other_samples_are_not_averaged(
    result: Callable[..., Entry], errors: list[np.ndarray]
) -> None:
    entries = [result("a", one, seed=seed, run=f"a-s{seed}") for seed, one in enumerate(errors)]
    entries[1].content["by_episode"]["mse"]["n"][0] += 1
    rows = {row.variant: row for row in make_boards(entries)[0].rows if row.kind == "measured"}
    assert [row.figures["mse"].seeds for row in rows.values()] == [1, 1]
    assert rows[OTHER_FRAMES].apart


@pytest.mark.parametrize(
    ("tuned_on", "word", "is_marked"),
    [({"tiny": 24}, "yes", True), ({"tiny": 6}, "25%", True), ({"other": 24}, "no", False), (None, "not known", True)],
)
def test_rows_say_whether_their_planner_was_tuned_on_their_tasks(
    board: Board,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    tuned_on: dict[str, int] | None,
    word: str,
    is_marked: bool,
) -> None:
    known = {name.replace("tiny", board.fingerprint): tasks for name, tasks in (tuned_on or {}).items()}
    monkeypatch.setattr(planners, "_tuned_tasks", lambda: {"planner-1": known} if tuned_on else {"planner-2": {}})
    section = board_section(board)
    control = section[next(place for place, line in enumerate(section) if "Tasks" in line) :]
    assert _cells(control, "a")[3] == f"{2 * EPISODES}"
    assert _cells(control, "a")[-1] == word
    assert _cells(control, "idle")[-1] == ""

    (tmp_path / "chosen.toml").write_text(CHOSEN)
    lines = chosen_table(find_rows(read_choices(tmp_path / "chosen.toml"), [board]))
    prediction, controlled = lines[2:4]
    assert "†" not in prediction
    assert ("†" in controlled) == is_marked
    assert (lines[-1] == TUNED_NOTE) == is_marked


def test_the_present_planner_is_known() -> None:
    assert (
        planners.tuned_share(
            "0.1.0+4fa30b762c67", "0753d8847a52700745819203ce966e32f92abab62f1469f46f8c5e36e6f48f6a", 40
        )
        == 0.5
    )
    assert planners.tuned_share("0.1.0+4fa30b762c67", "f" * 64, 20) == 0
    assert planners.tuned_share("someone's", "f" * 64, 20) is None


def test_a_board_says_which_version_of_the_environment_recorded_its_data(
    result: Callable[..., Entry], errors: list[np.ndarray]
) -> None:
    second = result("a", errors[0])  # the conftest records version 2
    unnamed = {name: value for name, value in second.content["dataset"].items() if name != "version"}
    heads = [board_section(make_boards([entry])[0])[0] for entry in (result("a", errors[0], dataset=unnamed), second)]
    assert heads[0].startswith("### Grid World v1: grid_world-tiny (")
    assert heads[1].startswith("### Grid World v2: grid_world-tiny (")


def test_published_rows_say_where_they_were_printed(board: Board) -> None:
    lines = published_section(board)
    assert lines[0] == "### Grid World: as published"
    assert "A paper. A note." in lines
    assert _cells(lines, "a") == ["a", "4 (1 each)", "14.3 ± 99.8"]


def test_a_name_cannot_break_out_of_its_cell(result: Callable[..., Entry], errors: list[np.ndarray]) -> None:
    (board,) = make_boards([result("a|b`<img>[x](y)", errors[0])])
    lines = board_section(board)
    assert any(line.startswith("| a\\|b\\`\\<img\\>\\[x\\](y) |") for line in lines)


def test_numbers_stand_in_sentences(board: Board, errors: list[np.ndarray], tmp_path: Path) -> None:
    (tmp_path / "chosen.toml").write_text(CHOSEN)
    found = numbers(find_rows(read_choices(tmp_path / "chosen.toml"), [board]))
    assert found["mse"] == f"{np.mean(errors):.2f}"
    assert (found["mse.paper"], found["mse.labels"], found["mse.trainings"]) == ("14.3", "4", "2")
    assert found["mse.samples"] == f"{7 * EPISODES}"
    assert found["control.baseline"] == "1.00"
    assert "control.paper" not in found
    text = "It is <!-- results:mse -->old\nnumber<!-- /results -->, <!-- results:mse.paper --><!-- /results --> there."
    assert filled(text, found, "page") == (
        f"It is <!-- results:mse -->{found['mse']}<!-- /results -->, "
        "<!-- results:mse.paper -->14.3<!-- /results --> there."
    )


def test_the_chosen_rows_show_what_moving_the_agent_alone_reaches_where_that_is_known(
    result: Callable[..., Entry], errors: list[np.ndarray], tmp_path: Path
) -> None:
    (tmp_path / "chosen.toml").write_text(CHOSEN)
    entry = result("a", errors[0], errors[0] / 20)
    shown = []
    for more in ({}, {"agent_moves": {"mse": entry.content["reference"]["copy_last"]["mse"] | {"mean": 45.6}}}):
        reference = {name: value for name, value in entry.content["reference"].items() if name != "agent_moves"} | more
        head, _, *rows = chosen_table(
            find_rows(
                read_choices(tmp_path / "chosen.toml"), make_boards([Entry(entry.content | {"reference": reference})])
            )
        )
        column = head.split(" | ").index("Agent alone")
        shown.append([row.split("|")[1:-1][column].strip() for row in rows[:2]])
    assert shown == [["", ""], ["45.6", ""]]


def test_a_figure_for_sentences_alone_needs_no_reference_and_no_row(board: Board, tmp_path: Path) -> None:
    own = '[[row]]\nname = "shift"\ntitle = "t"\nmodel_title = "A model"\nboard = "grid_world-tiny"\nmodel = "a"\n'
    own += 'labels = "one-shot"\nfigure = "control_distance[50]"\nin_table = false\n'
    (tmp_path / "chosen.toml").write_text(CHOSEN)
    without = find_rows(read_choices(tmp_path / "chosen.toml"), [board])
    (tmp_path / "chosen.toml").write_text(CHOSEN + own)
    rows = find_rows(read_choices(tmp_path / "chosen.toml"), [board])
    assert chosen_table(rows) == chosen_table(without)
    found = numbers(rows)
    assert found["shift"] == found["control"]
    assert "shift.baseline" not in found
    assert found.items() >= numbers(without).items()


@pytest.mark.parametrize(
    ("text", "error", "sentence"),
    [
        ("no place", UsageError, "has no place for results"),
        ("<!-- results:a --> open", UsageError, "does not end"),
        ("<!-- results:a --><!-- /results --><!-- results:a -->", UsageError, "does not end"),
        ("<!-- results:aa --><!-- /results -->", UnknownName, "did you mean 'a'"),
    ],
)
def test_places_that_cannot_be_filled_are_told(text: str, error: type[Exception], sentence: str) -> None:
    with pytest.raises(error, match=sentence):
        filled(text, {"a": "1"}, "page.md")


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ('board = "grid_world-tiny"', 'board = "grid_world-tiny@0"', "asks for the board 'grid_world-tiny@0'"),
        ('model = "a"', 'model = "b"', r"asks for the row \('b', '', 'one-shot'\), and none is there"),
        ('baseline = "copy_last"', 'baseline = "nothing"', "asks for the baseline 'nothing'.*copy the last frame"),
        ('title = "next frame"', 'titel = "next frame"', "names no rows to show"),
        ('title = "next frame"', 'title = "next frame"\nin_table = "no"', "in_table is true or false"),
        ("[[row]]", "[[rows]]", "names no rows to show"),
        ("[[row]]", "[[row", "names no rows to show"),
    ],
)
def test_choices_that_are_not_there_are_told(board: Board, tmp_path: Path, old: str, new: str, sentence: str) -> None:
    (tmp_path / "chosen.toml").write_text(CHOSEN.replace(old, new))
    with pytest.raises(UsageError, match=sentence):
        find_rows(read_choices(tmp_path / "chosen.toml"), [board])


def test_the_command_writes_pages_and_notices_what_differs(
    board: Board, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    for entry in [entry for row in board.rows for entry in row.entries]:
        write_entry(entry, tmp_path / "entries")
    page = tmp_path / "page.md"
    page.write_text("# Page\n\n<!-- results:boards -->\n<!-- /results -->\n")
    words = ["leaderboard", "results", str(page), "--from", str(tmp_path)]

    said = dmbench([*words, "--check"], capsys, monkeypatch)
    assert said.code == 1
    assert "without --check" in said.sentence()
    assert page.read_text().count("\n") == 4
    assert dmbench(words, capsys, monkeypatch).out == f"{page}: written\n"
    assert "\n".join(board_section(board)) in page.read_text()
    assert dmbench([*words, "--check"], capsys, monkeypatch).out == f"{page}: as it was\n"
    assert write_results(tmp_path, [page]) == []


def test_a_figure_of_fewer_trainings_than_the_row_has_says_of_how_many(
    result: Callable[..., Entry], errors: list[np.ndarray]
) -> None:
    entries = [result("dmotion", one, run=f"dmotion-s{seed}", seed=seed) for seed, one in enumerate(errors)]
    known = {"mean": 0.5, "std": 1.0, "low": 0.4, "high": 0.6, "n": 9}
    lone = dict.fromkeys(("planning_gain", "mse_push", "position_error_paper", "control_distance[50]"), known)
    entries[0] = Entry(dict(entries[0].content) | {"figures": entries[0].content["figures"] | lone})
    boards = make_boards(entries)

    lines = [line.split("|")[1:-1] for line in board_section(boards[0]) if line.startswith("|")]
    row = next(line for line in lines if line[0].strip() == "dmotion")
    cells = {head.strip(): cell.strip() for head, cell in zip(lines[0], row, strict=True)}
    assert cells["Gain captured"] == "0.50 (1 of 2)"
    assert cells["pushes"] == "0.500 (1 of 2)"
    assert cells["Position error, missing charged [px]"] == f"0.500 (0.40{TO}0.60) (1 of 2)"
    assert "of" not in cells["MSE"]
    own = "\n".join(model_lines("dmotion", boards))
    assert own.count(f"0.500 (0.40{TO}0.60) (1 of 2)") == 1
    assert f"**0.500** (0.40{TO}0.60) (1 of 2)" in own  # the distance that is left
    assert "1 of 2 seeds" in make_page(entries)
