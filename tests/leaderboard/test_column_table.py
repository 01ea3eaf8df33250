"""The table of control by columns, made of entries whose every distance is known."""

from __future__ import annotations

import copy
import json
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.errors import UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.statistics import wilson
from dmotion_bench.scoring.trainings import detectable_difference, over_trainings
from dmotion_bench.scoring.transfer import transfer_folders
from dmotion_bench.sharing.run_share import share_of
from dmotion_bench.specs import DatasetRecipe, SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import rounded
from dmotion_bench.workspace import Workspace
from leaderboard import sources
from leaderboard.board import Board, make_boards
from leaderboard.board_tables import board_section
from leaderboard.build import entry_of_run
from leaderboard.check import check_entry
from leaderboard.chosen import chosen_table, find_rows, read_choices
from leaderboard.entry import Entry
from leaderboard.model_results import model_lines
from leaderboard.page import make_page

from .conftest import TASK_EPISODES, figure_over

MakeEntry = Callable[..., Entry]


@pytest.fixture
def left() -> dict[tuple[str, int], np.ndarray]:
    """What two models leave: three trainings of one, two of the other."""
    generator = np.random.default_rng(0)
    task = generator.random(len(TASK_EPISODES)) * 0.4
    seeds = [("dmotion", seed) for seed in range(3)] + [("ed-cnn", seed) for seed in range(2)]
    return {
        key: task + 0.1 * generator.random(len(TASK_EPISODES)) + (0.0 if key[0] == "dmotion" else 0.2) for key in seeds
    }


@pytest.fixture
def board(controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]) -> Board:
    entries = [controlled(model, own, seed=seed) for (model, seed), own in left.items()]
    entries.append(controlled("dmotion", left["dmotion", 0] + 0.3, column="paper"))
    (found,) = make_boards(entries)
    return found


@pytest.mark.slow
def test_each_model_is_a_row_and_each_column_a_cell(board: Board, left: dict[tuple[str, int], np.ndarray]) -> None:
    table = board.control
    assert table is not None
    assert table.columns == ("generic", "paper")
    assert [row.title for row in table.rows] == ["dmotion", "ed-cnn", "idle", "true simulator as the model"]

    cell = table.rows[0].cells["generic"]
    own = np.stack([left["dmotion", seed] for seed in range(3)])
    assert (cell.tasks, cell.trainings, table.steps) == (25, 3, 2)
    assert cell.left == over_trainings(own, np.ones(25))
    assert cell.left.mean == pytest.approx(own.mean())
    share = float(np.mean([(one <= 0.2).mean() for one in own]))
    assert cell.solved == pytest.approx((share, *wilson(share, 25)))
    assert table.rows[0].cells["paper"].trainings == 1
    assert "paper" not in table.rows[1].cells


@pytest.mark.parametrize(
    ("data", "run", "variant"),
    [
        ("grid", "dmotion-grid-small-s0", ""),
        ("grid-small", "dmotion-grid-small-s0", ""),
        ("grid-small", "dmotion-grid-small-threads_1-s0", ""),
        ("grid-small", "dmotion-grid-small-5-shot-warp_True-epochs_3.0-threads_2-s0", "epochs 3, warp true"),
        ("grid", "dmotion-grid-small-5-shot-warp_true-s0", "warp true"),
        ("grid-small", "of-another-kind-s0", "of-another-kind"),
    ],
)
def test_a_rows_variant_is_what_its_run_was_set_to(
    controlled: MakeEntry, data: str, run: str, variant: str, left: dict[tuple[str, int], np.ndarray]
) -> None:
    trained_on = {"name": data, "fingerprint": "0" * 64}
    dataset = {"name": "grid-test", "environment": "grid_world", "fingerprint": "1" * 64, "trained_on": trained_on}
    entry = controlled(
        "dmotion",
        left["dmotion", 0],
        run=run,
        preset="small",
        dataset=dataset,
        labels="5-shot" if "5-shot" in run else "one-shot",
    )
    (board,) = make_boards([entry])
    assert board.control is not None
    assert board.control.rows[0].variant == variant


def test_trainings_that_differ_beyond_their_names_are_rows_of_their_own(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    def trained_on(name: str, digit: str) -> dict[str, Any]:
        origin = {"name": name, "fingerprint": digit * 64}
        return {"name": "grid-test", "environment": "grid_world", "fingerprint": "1" * 64, "trained_on": origin}

    def entry(name: str, digit: str, seed: int = 0) -> Entry:
        run = f"dmotion-{name}-small-s{seed}"
        data = trained_on(name, digit)
        return controlled("dmotion", left["dmotion", seed], seed=seed, run=run, preset="small", dataset=data)

    tuned = copy.deepcopy(dict(entry("grid", "2").content))
    tuned["labels"] |= {"use": "finetuned"}
    both = [entry("grid", "2"), entry("grid", "2", seed=1), entry("large", "3"), entry("large", "4"), Entry(tuned)]
    (board,) = make_boards(both)

    assert board.control is not None
    assert {row.variant: row.cells["generic"].trainings for row in board.control.rows if row.entries} == {
        "trained on grid, preset small": 2,
        "trained on large, preset small, 33333333": 1,
        "trained on large, preset small, 44444444": 1,
        "fine-tuned on its labels": 1,
    }


def test_the_oracle_has_a_cell_for_each_column_and_idle_the_same(board: Board) -> None:
    assert board.control is not None
    idle, oracle = board.control.rows[-2:]

    assert [idle.cells[name].left.mean for name in ("generic", "paper")] == [1.0, 1.0]
    assert [oracle.cells[name].left.mean for name in ("generic", "paper")] == [0.05, 0.1]


def test_what_the_table_can_show_follows_from_the_measured_spread(
    board: Board, left: dict[tuple[str, int], np.ndarray]
) -> None:
    assert board.control is not None
    one, other = (
        np.stack([own for (model, _), own in left.items() if model == name]) for name in ("dmotion", "ed-cnn")
    )

    assert board.control.detectable == {"generic": pytest.approx(detectable_difference([(one, other, np.ones(25))]))}


def test_a_training_on_other_tasks_is_not_averaged(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    fewer = controlled("dmotion", left["dmotion", 1], seed=1)
    content = copy.deepcopy(dict(fewer.content))
    content["by_episode"]["control_distance[2]"] = {"episode": [0, 1], "n": [1, 1], "sum": [0.1, 0.2]}
    (board,) = make_boards([controlled("dmotion", left["dmotion", 0]), Entry(content)])

    assert board.control is not None
    assert board.control.rows[0].cells["generic"].trainings == 1
    assert board.control.rows[0].cells["generic"].left.mean == pytest.approx(left["dmotion", 0].mean())


def test_a_trial_with_other_settings_is_not_compared(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    """Planned with another seed or over more steps than a column has, it is left out; over a few tasks it is marked."""
    honest = [controlled(model, own, seed=seed) for (model, seed), own in left.items()]
    best = np.zeros(len(TASK_EPISODES))
    lucky = controlled("lucky", best)
    lucky = Entry(dict(lucky.content) | {"settings": lucky.content["settings"] | {"control_seed": 17}})
    sums = {"control_distance[2]": {"episode": TASK_EPISODES[:7], "n": [1] * 7, "sum": [0.0] * 7}}
    few = controlled("few", best[:7], by_episode=sums)
    long = controlled("long", best)
    farther = {"control_distance[101]": figure_over(0.0, len(best)), "control_distance[2]": figure_over(0.0, len(best))}
    long = Entry(dict(long.content) | {"figures": dict(long.content["figures"]) | farther})

    (board,) = make_boards([*honest, lucky, few, long])

    assert board.control is not None
    assert [row.name for row in board.control.compared if row.entries] == ["dmotion", "ed-cnn"]
    assert [row.name for row in board.control.rows if row.extent] == ["few"]
    assert board.control.steps == 2


def test_what_was_published_is_no_row_among_frozen_planners(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    """A report on the run's own data has the paper's figures beside its own, another planner's in other tasks."""
    entry = controlled("dmotion", left["dmotion", 0])
    published = {"control_distance[2]": figure_over(0.7, 25) | {"low": None, "high": None, "n": None}}
    both = Entry(dict(entry.content) | {"reference": dict(entry.content["reference"]) | {"paper": published}})

    (with_paper,), (without,) = make_boards([both]), make_boards([entry])

    assert with_paper.control is not None
    assert without.control is not None
    assert [row.name for row in with_paper.control.rows] == [row.name for row in without.control.rows]
    assert make_page([both])


@pytest.mark.parametrize("where", ["model", "idle"])
@pytest.mark.parametrize(
    ("figure", "change"),
    [
        ("control_success", None),
        ("control_lost", None),
        ("control_success", {"mean": None}),
        ("control_success", {"mean": 5.0}),
        ("control_distance[2]", {"mean": None}),
        ("control_distance[2]", {"n": None}),
        ("control_distance[2]", {"n": 0}),
    ],
)
def test_what_lacks_a_figure_of_the_table_is_left_out_of_it(
    board: Board,
    controlled: MakeEntry,
    left: dict[tuple[str, int], np.ndarray],
    where: str,
    figure: str,
    change: dict[str, Any] | None,
) -> None:
    """Entries come from anybody; one that is damaged must not keep the others from being shown."""
    entry = controlled("damaged", left["dmotion", 0])
    content = copy.deepcopy(dict(entry.content))
    figures = content["figures"] if where == "model" else content["reference"][where]
    if change is None:
        del figures[figure]
    else:
        figures[figure] |= change

    assert board.control is not None
    (found,) = make_boards([*board.entries, Entry(content)])

    assert found.control is not None
    names = [row.name for row in board.control.rows]
    expected = names if where == "model" else ["damaged", *names]
    assert sorted(row.name for row in found.control.rows) == sorted(expected)
    assert make_page([*board.entries, Entry(content)])


def test_control_of_the_earlier_protocol_stands_apart(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    old = controlled("dmotion", left["dmotion", 0] - 0.05, column=None)
    new = controlled("dmotion", left["dmotion", 0])
    (board,) = make_boards([old, new])
    lines = "\n".join(board_section(board))
    page = make_page([old, new])

    assert board.control is not None
    assert [entry.column for entry in board.control.entries] == ["generic"]
    assert [entry.column for entry in board.measured] == [None]
    assert "Protocols dmbench-1 and dmbench-2" in lines
    assert "Control of protocol dmbench-1, by planners that were tuned on some of its tasks" in lines
    assert "Control, protocol dmbench-1" in page
    assert "Control, protocol dmbench-2" in page


def test_a_front_page_can_show_a_cell(board: Board, tmp_path: Path) -> None:
    (tmp_path / "chosen.toml").write_text(
        '[[row]]\nname = "control"\ntitle = "control tasks"\nmodel_title = "DMotion"\nboard = "grid-test"\n'
        'model = "dmotion"\nlabels = "one-shot"\nfigure = "control_distance[2]"\ncolumn = "generic"\n'
        'baseline = "idle"\n'
    )
    (found,) = find_rows(read_choices(tmp_path / "chosen.toml"), [board])
    assert board.control is not None
    cell = board.control.rows[0].cells["generic"]
    assert found.value.mean == cell.left.mean
    assert found.value.interval == (cell.left.low, cell.left.high)
    assert (found.value.samples, found.value.seeds, found.baseline.mean) == (25, 3, 1.0)
    (line,) = [line for line in chosen_table([found]) if "DMotion" in line]
    assert "| 25 control tasks |" in line
    (tmp_path / "chosen.toml").write_text((tmp_path / "chosen.toml").read_text().replace("generic", "tuned"))
    with pytest.raises(UsageError, match="asks for the row"):
        find_rows(read_choices(tmp_path / "chosen.toml"), [board])


def test_the_page_and_the_tables_show_it(board: Board) -> None:
    assert board.control is not None
    lines = "\n".join(board_section(board))
    page = make_page(board.entries)
    mean = rounded(board.control.rows[0].cells["generic"].left.mean)

    assert "Generic: left" in lines
    assert f"| {mean} (" in lines
    assert (
        f"Generic: the table shows a true difference of {rounded(board.control.detectable['generic'])} between" in lines
    )
    assert "in 80% of cases, a smaller one less often" in page
    table, _, _ = page.partition('<div class="charts">')
    assert table.count(">true simulator as the model<") == 1
    (row,) = (line for line in lines.splitlines() if line.startswith("| dmotion |"))
    assert row.startswith("| dmotion | 4 (1 each) | 3 / 1 | 25 |")
    assert "tasks, 3 trainings" in page
    assert "tasks, one training" in page
    said = r"(?!(?:<small></small>)?</td>)"
    sortable = re.findall(rf'<(?:td|th scope="row")( data-value="[^"]+")?>{said}', table.partition("<tbody>")[2])
    assert len(sortable) >= 5 * 2  # cells that say something, of two models, the oracle and idle
    assert all(sortable)


def test_of_single_trainings_the_table_does_not_say_which_difference_it_can_show(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    (board,) = make_boards([controlled(model, left[model, 0]) for model in ("dmotion", "ed-cnn")])

    assert board.control is not None
    assert [row.cells["generic"].trainings for row in board.control.rows[:2]] == [1, 1]
    assert not board.control.detectable


def test_a_model_s_page_has_its_control_by_frozen_planners_first(
    controlled: MakeEntry, left: dict[tuple[str, int], np.ndarray]
) -> None:
    old, new = (controlled("dmotion", left["dmotion", 0], column=column) for column in (None, "generic"))
    predicted = {"figures": {**old.figures, "mse": figure_over(1.0, 9)}}
    boards = make_boards([Entry(dict(old.content) | predicted), new])
    lines = model_lines("dmotion", boards)
    heads = [line for line in lines if line.startswith("| Data set")]
    wanted = ("MSE", "Generic: left", "Distance left")
    assert all(name in head for name, head in zip(wanted, heads, strict=True))
    assert "Generic: left" in "\n".join(model_lines("dmotion", make_boards([new])))


@pytest.mark.slow
def test_a_columns_report_is_an_entry_that_can_be_checked(
    scored_workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """From the score to the board: the simulator repeats the actions, and the model plans the first ones again."""
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", seed=5, episodes=20, frames=32, tasks=2
    )
    copied = Workspace(tmp_path)
    shutil.copytree(scored_workspace.root, copied.root, dirs_exist_ok=True)
    path = copied.runs / "dmotion-grid_world-tiny-s0"
    manifest = json.loads((path / "run.json").read_text())
    manifest["dataset_path"] = str(copied.data / "grid_world-tiny")
    (path / "run.json").write_text(json.dumps(manifest))
    record_dataset(copied.data / "grid-test", recipe)
    few = ScoreSettings(resamples=100, control=ControlScoring(column="paper", tasks=2, steps=2, group=2))
    score_run(path, metrics=None, settings=few, data=copied.data / "grid-test")

    (folder,) = transfer_folders(path)
    entry = entry_of_run(path, folder)
    asked: list[str | None] = []
    as_it_is = sources.transferable

    def watched(run: Run, dataset: Dataset, split: SplitName, column: str | None = None) -> Dataset:
        asked.append(column)
        return as_it_is(run, dataset, split, column)

    monkeypatch.setattr(sources, "transferable", watched)
    verdict = check_entry(entry, copied)
    (board,) = make_boards([entry])
    published = set(share_of(Run.open(path)).files)

    assert asked == ["paper"]  # the episodes of the tasks must be new to the run, not those of the test split
    assert {f"report/on/grid-test/paper/{name}" for name in ("report.json", "samples.parquet")} <= published

    assert (entry.column, entry.content["protocol"]) == ("paper", "dmbench-2")
    assert verdict.findings == ()
    assert verdict.holds
    assert board.control is not None
    assert board.control.columns == ("paper",)
    assert board.control.rows[0].cells["paper"].tasks == 2
    forged = copy.deepcopy(dict(entry.content))
    forged["settings"]["control_column"] = "generic"
    assert not check_entry(Entry(forged), copied).holds
