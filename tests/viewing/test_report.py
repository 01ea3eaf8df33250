"""A report in the scene of its run: figures, curves, and the episodes that tell most."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from rrd_contents import static, tabs_of

from dmotion_bench.learning.run import Run
from dmotion_bench.scoring.report import REPORT_FOLDER, Report, write_report
from dmotion_bench.scoring.samples import SampleRows
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.report import report_tab, telling_episodes
from dmotion_bench.viewing.run import run_scene
from dmotion_bench.viewing.scene import write_scene

MSE = {1: [10.0, 30.0], 4: [90.0, 10.0], 5: [1.0, 3.0]}  # of the triplets of each episode


def figure(mean: float) -> dict[str, float | int | None]:
    return {"mean": mean, "std": 2.0, "low": mean - 1, "high": mean + 1, "n": 6}


@pytest.fixture
def scored(run: Run, tmp_path: Path) -> Iterator[Path]:
    """A report of made-up figures beside the run; rows of rollouts and references must not count."""
    rows = SampleRows("prediction", "model")
    for episode, values in MSE.items():
        rows.add({"episode": np.full(len(values), episode), "mse": np.array(values, np.float32)})
    for metric, predictor in (("rollout", "model"), ("prediction", "copy_last")):
        other = SampleRows(metric, predictor)
        other.add({"episode": np.array([7]), "mse": np.array([1e6], np.float32)})
        rows._batches.extend(other._batches)
    figures = {"mse": figure(24.0), **{f"rollout_mse[{ahead}]": figure(10.0**ahead) for ahead in (1, 2, 3)}}
    report = Report(
        run=run.name,
        model="dmotion",
        arch="compact",
        preset="tiny",
        seed=0,
        labels={"asked": "one-shot", "total": 4},
        dataset={"name": "squares-tiny"},
        weights="",
        settings={"split": "test", "metrics": ["prediction", "rollout"]},
        training={},
        versions={},
        code="",
        figures=figures,
        reference={"copy_last": {"mse": figure(99.0)}},
    )
    folder = run.path / REPORT_FOLDER
    write_report(folder, report, rows.table())
    yield run.path
    for file in folder.iterdir():
        file.unlink()
    folder.rmdir()


def test_worst_middle_and_best_by_the_mean_of_an_episodes_steps(scored: Path) -> None:
    assert telling_episodes(scored) == {4: "worst, MSE 50", 1: "middle, MSE 20", 5: "best, MSE 2"}


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
    assert "| mse | 24 ± 2 | 23 ... 25 | 99 |" in text
    (line,) = static(rrd, "/report/rollout/dmotion", "LineStrips2D:strips")
    heights = [height for _, height in line]
    assert heights[0] - heights[1] == pytest.approx(heights[1] - heights[2])  # ten times each, logarithmic
