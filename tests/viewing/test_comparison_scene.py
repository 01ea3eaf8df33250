"""What an .rrd of several runs holds: each model's own predictions of the same episodes, and their errors plotted."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from made_up_report import write_made_up
from rrd_contents import curve, layout_of, static, tabs_of, values

from dmotion_bench.api.viewing import beside
from dmotion_bench.errors import UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.comparison import comparable, comparison_scene, contrasting_episodes
from dmotion_bench.viewing.imagination import imagine
from dmotion_bench.viewing.scene import write_scene
from dmotion_bench.viewing.target import Target
from dmotion_bench.workspace import Workspace

EPISODE = 2
ONE = {1: [10.0, 30.0], 4: [90.0, 10.0], 5: [1.0, 3.0], 6: [9.0, 9.0]}
OTHER = {1: [11.0, 31.0], 4: [91.0, 13.0], 5: [2.0, 2.0], 6: [0.1, 0.1]}


@pytest.fixture(scope="module")
def written(run: Run, other_run: Run, dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("comparison") / "scene.rrd"
    write_scene(comparison_scene([run, other_run], dataset, [EPISODE], {EPISODE: "worst, mean MSE 50"}), path)
    return path


@pytest.fixture
def scored(run: Run, other_run: Run) -> Iterator[list[Path]]:
    folders = [write_made_up(run, ONE), write_made_up(other_run, OTHER)]
    yield [run.path, other_run.path]
    for folder in folders:
        shutil.rmtree(folder)


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["one_step", "imagined"])
@pytest.mark.parametrize("number", [0, 1])
def test_every_model_is_shown_its_own_frames(
    written: Path, run: Run, other_run: Run, dataset: Dataset, number: int, kind: str
) -> None:
    model = (run, other_run)[number].model
    expected = getattr(imagine(model, dataset.video(EPISODE), dataset.labels(EPISODE), dataset.spec), kind)
    column = values(written, f"/episode_{EPISODE}/model_{number}/{kind}/frame", "Image:buffer")
    shown = np.array([buffer for _, (buffer,) in column], np.uint8).reshape(8, 64, 64, 3)
    np.testing.assert_array_equal(shown[2:], expected.frames)
    points = curve(written, f"/episode_{EPISODE}/mse_{kind}/model_{number}")
    np.testing.assert_allclose([value for _, value in points], expected.mse)
    (name,) = static(written, f"/episode_{EPISODE}/mse_{kind}/model_{number}", "SeriesLines:names")
    assert name == f"dmotion seed {number}"


@pytest.mark.parametrize("kind", ["one_step", "imagined"])
def test_the_mark_is_on_the_worst_frame_of_all(written: Path, kind: str) -> None:
    points = {number: curve(written, f"/episode_{EPISODE}/mse_{kind}/model_{number}") for number in (0, 1)}
    worst = max(points, key=lambda number: max(value for _, value in points[number]))
    at = max(points[worst], key=lambda point: point[1])
    assert curve(written, f"/episode_{EPISODE}/mse_{kind}/worst") == [at]
    assert static(written, f"/episode_{EPISODE}/mse_{kind}/worst", "SeriesPoints:names") == [
        f"worst: dmotion seed {worst}"
    ]


def test_a_view_of_each_prediction_and_each_error(written: Path) -> None:
    origins = {
        parts["ViewBlueprint:space_origin"][0]
        for parts in layout_of(written).values()
        if "ViewBlueprint:space_origin" in parts
    }
    root = f"/episode_{EPISODE}"
    pictures = {
        f"{root}/model_{n}/{kind}/{part}"
        for n in (0, 1)
        for kind in ("one_step", "imagined")
        for part in ("frame", "difference")
    }
    assert pictures | {f"{root}/camera", f"{root}/mse_one_step", f"{root}/mse_imagined", f"{root}/about"} <= origins
    assert tabs_of(written) == [f"Episode {EPISODE} (worst, mean MSE 50)"]


def test_the_episodes_that_tell_most_of_all_models(scored: list[Path]) -> None:
    assert contrasting_episodes(scored) == {
        4: "worst, mean MSE 51.0",
        5: "best, mean MSE 2.00",
        6: "differ most, mean MSE 4.55",
    }
    (scored[1] / "report" / "samples.parquet").write_bytes(b"")
    assert contrasting_episodes(scored) == {}


def test_the_figures_are_told_with_their_paired_difference(
    scored: list[Path], run: Run, other_run: Run, dataset: Dataset, rrd: Path
) -> None:
    write_scene(comparison_scene([run, other_run], dataset, [EPISODE]), rrd)
    assert tabs_of(rrd) == [f"Episode {EPISODE}", "Figures"]
    (text,) = static(rrd, "/comparison/figures", "TextDocument:text")
    first, second = (line for line in text.splitlines() if line.startswith("| dmotion"))
    assert first == "| dmotion seed 1 | 18.8 | best |"
    assert second.startswith("| dmotion seed 0 | 20.2 | unknown: 4 episodes |")


def test_a_report_stands_beside_the_others_of_its_data_set(scored: list[Path], workspace: Workspace) -> None:
    assert beside(Target("report", scored[0]), workspace) == scored
    assert beside(Target("report", scored[1]), workspace) == scored[::-1]


def test_errors_of_other_frames_are_not_compared(
    scored: list[Path], run: Run, other_run: Run, dataset: Dataset, rrd: Path, workspace: Workspace
) -> None:
    """Two splits of one data set share some frames; their errors are means over different ones."""
    path = scored[0] / "report/report.json"
    report = json.loads(path.read_text())
    path.write_text(json.dumps(report | {"settings": report["settings"] | {"protocol": "paper"}}))

    assert beside(Target("report", scored[1]), workspace) == [scored[1]]
    write_scene(comparison_scene([run, other_run], dataset, [EPISODE]), rrd)
    (text,) = static(rrd, "/comparison/figures", "TextDocument:text")
    assert "| dmotion seed 1 | 18.8 | best |" in text
    assert "| dmotion seed 0 | 20.2 | other frames |" in text


def test_what_cannot_be_compared_is_said(run: Run, other_run: Run, dataset: Dataset) -> None:
    other = Run(other_run.path, {**other_run.manifest, "spec": {**other_run.manifest["spec"], "fingerprint": "0"}})
    with pytest.raises(UsageError, match="trained on different data sets"):
        comparable([run, other])
    with pytest.raises(UsageError, match="11 runs are too many"):
        comparable([run] * 11)
    with pytest.raises(UsageError, match="named twice"):
        comparison_scene([run, run], dataset, [EPISODE])
    assert comparable([run, other_run]) == [run, other_run]
