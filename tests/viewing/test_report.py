"""A report in the scene of its run: figures, curves, and the episodes that tell most."""

from __future__ import annotations

import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from made_up_report import figure, write_made_up
from rrd_contents import static, tabs_of

from dmotion_bench.api.viewing import scene_of_targets
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.report import REPORT_FOLDER
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.report import report_tab, telling_episodes
from dmotion_bench.viewing.run import run_scene
from dmotion_bench.viewing.scene import application_id, write_scene
from dmotion_bench.viewing.target import Target
from dmotion_bench.workspace import Workspace

MSE = {1: [10.0, 30.0], 4: [90.0, 10.0], 5: [1.0, 3.0]}  # of the triplets of each episode


@pytest.fixture
def scored(run: Run) -> Iterator[Path]:
    folder = write_made_up(run, MSE)
    yield run.path
    shutil.rmtree(folder)


def test_worst_middle_and_best_by_the_mean_of_an_episodes_steps(scored: Path) -> None:
    assert telling_episodes(scored) == {4: "worst, MSE 50.0", 1: "middle, MSE 20.0", 5: "best, MSE 2.00"}


@pytest.mark.parametrize(
    ("mse", "told"),
    [
        ({1: [10.0], 4: [90.0]}, {4: "worst, MSE 90.0", 1: "best, MSE 10.0"}),
        ({3: [2450.0, 2550.0]}, {3: "MSE 2,500"}),
    ],
)
def test_of_two_episodes_none_is_in_the_middle_and_one_is_not_compared(
    run: Run, mse: dict[int, list[float]], told: dict[int, str]
) -> None:
    folder = write_made_up(run, mse)
    try:
        assert telling_episodes(run.path) == told
    finally:
        shutil.rmtree(folder)


def test_where_actions_are_not_known_it_is_the_error_with_the_true_motion(
    run: Run, dataset: Dataset, rrd: Path
) -> None:
    folder = write_made_up(run, MSE, "mse_true_motion")
    try:
        assert telling_episodes(run.path) == {4: "worst, MSE 50.0", 1: "middle, MSE 20.0", 5: "best, MSE 2.00"}
        write_scene(run_scene(run, dataset, []), rrd)
    finally:
        shutil.rmtree(folder)
    assert "| MSE with the true motion | 24.0 ± 2.00 |" in static(rrd, "/report/figures", "TextDocument:text")[0]


@pytest.mark.slow
def test_a_report_on_validation_episodes_is_shown_in_place_of_the_plain_one(
    scored: Path, run: Run, dataset: Dataset, rrd: Path
) -> None:
    folder = scored / REPORT_FOLDER / "validation"
    folder.mkdir()
    for file in ("report.json", "samples.parquet"):
        (scored / REPORT_FOLDER / file).rename(folder / file)
    target = Target("report", run.path, report=folder)
    write_scene(scene_of_targets([target], [], None, None, Workspace(run.path.parent.parent)), rrd)
    assert tabs_of(rrd)[0] == "Episode 4 (worst, MSE 50.0)"
    assert "| MSE | 24.0 ± 2.00 |" in static(rrd, "/report/figures", "TextDocument:text")[0]


def test_rerun_takes_the_name_as_it_is() -> None:
    assert application_id("dmotion-grid-epochs_0.5-s0 ö") == "dmbench dmotion-grid-epochs_0_5-s0 _"


def test_samples_that_the_report_does_not_vouch_for_tell_nothing(scored: Path) -> None:
    with (scored / REPORT_FOLDER / "samples.parquet").open("ab") as file:
        file.write(b"more")
    assert telling_episodes(scored) == {}


def test_without_a_report_there_is_nothing_to_tell(run: Run) -> None:
    assert telling_episodes(run.path) == {}
    assert report_tab(run.path) is None


def test_the_report_has_a_page_of_its_own(scored: Path, run: Run, dataset: Dataset, rrd: Path) -> None:
    write_scene(run_scene(run, dataset, [4], {4: "worst, MSE 50"}), rrd)
    assert tabs_of(rrd) == ["Episode 4 (worst, MSE 50)", "Report", "Training"]
    (text,) = static(rrd, "/report/figures", "TextDocument:text")
    assert "| MSE | 24.0 ± 2.00 | 23.0 to 25.0 | 99.0 |" in text
    (line,) = static(rrd, "/report/rollout_mse/dmotion", "LineStrips2D:strips")
    heights = [height for _, height in line]
    assert heights[0] - heights[1] == pytest.approx(heights[1] - heights[2])  # ten times each, logarithmic


def test_gain_and_control_have_a_table_of_their_own_and_control_a_chart_from_the_start_on(
    run: Run, dataset: Dataset, rrd: Path
) -> None:
    def distances(*left: float) -> dict[str, Any]:
        return {f"control_distance[{step}]": figure(one) for step, one in enumerate(left, start=1)}

    own = distances(0.75, 0.5) | {"control_success": figure(0.25), "planning_gain": figure(0.7)}
    planned = {"dmotion": own, "idle": distances(1.0, 1.0), "oracle": {"planning_gain": figure(0.9)}}
    folder = write_made_up(run, MSE, planned=planned)
    try:
        write_scene(run_scene(run, dataset, [4]), rrd)
    finally:
        shutil.rmtree(folder)
    (text,) = static(rrd, "/report/figures", "TextDocument:text")
    first, second = (part.splitlines() for part in text.split("\n\n") if part.startswith("|"))

    assert [row.count("|") for row in first] == [5] * 3
    assert second[0] == "|  | mean ± std | 95% interval | oracle | idle |"
    assert second[1] == "| --- | --- | --- | --- | --- |"
    assert second[2] == "| gain captured | 0.700 ± 2.00 | -0.300 to 1.70 | 0.900 |  |"
    assert second[3] == "| control, distance after 2 steps | 0.500 ± 2.00 | -0.500 to 1.50 |  | 1.00 |"
    (line,) = static(rrd, "/report/control_distance/dmotion", "LineStrips2D:strips")
    (still,) = static(rrd, "/report/control_distance/idle", "LineStrips2D:strips")
    heights = [height for _, height in line]
    assert len(heights) == 3
    assert heights[0] == still[0][1] == still[2][1]  # both begin at 1
    assert heights[1] - heights[0] == pytest.approx(heights[2] - heights[1])  # as far each step, linear
    assert heights[0] < heights[1]  # downward is larger in a picture


def test_a_report_without_single_steps_names_no_worst_episode(run: Run, dataset: Dataset, rrd: Path) -> None:
    folder = write_made_up(run, MSE, "psnr", planned={"dmotion": {"control_distance[1]": figure(0.5)}})
    try:
        write_scene(run_scene(run, dataset, [4]), rrd)
    finally:
        shutil.rmtree(folder)
    assert "worst" not in static(rrd, "/report/figures", "TextDocument:text")[0]
