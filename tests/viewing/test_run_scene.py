"""What an .rrd of a run holds, compared with what its model predicts and with its metrics."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import rerun.blueprint as rrb
import torch
from made_up_report import write_made_up
from pushed_squares import SPEC, write_squares
from rrd_contents import curve, read, static, tabs_of, values

from dmotion_bench.api.viewing import scene_of
from dmotion_bench.errors import RunCorrupt, RunMissing
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, Losses, TripletBatch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.training.samples import samples_of, write_sample
from dmotion_bench.scoring.transfer import report_folder
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.chart import Curve, log_chart
from dmotion_bench.viewing.curves import training_tab
from dmotion_bench.viewing.live import recording_to
from dmotion_bench.viewing.maps import brightest, tiles
from dmotion_bench.viewing.run import AMPLIFIED, _of_training, run_scene
from dmotion_bench.viewing.scene import write_scene
from dmotion_bench.viewing.target import Target


class Blind(ForwardModel[None]):
    """Predicts as another model does, and shows nothing of what is inside."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    paper: ClassVar[str] = "nobody"

    def __init__(self, inner: ForwardModel[Any]) -> None:
        super().__init__(None, inner.inputs)
        self.inner = inner

    def losses(self, batch: TripletBatch) -> Losses:
        raise NotImplementedError

    def predict(self, previous: torch.Tensor, current: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return self.inner.predict(previous, current, action)


@pytest.fixture(scope="module")
def episode(dataset: Dataset) -> int:
    return int(dataset.split("test")[0])


@pytest.fixture(scope="module")
def written(run: Run, dataset: Dataset, episode: int, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("run") / "scene.rrd"
    write_scene(run_scene(run, dataset, [episode], {episode: "worst"}), path)
    return path


@pytest.fixture(scope="module")
def predicted(run: Run, dataset: Dataset, episode: int) -> dict[str, np.ndarray]:
    """Frames 2 ... 7, one by one and as a rollout, without the code that is tested."""
    images = to_model(torch.from_numpy(dataset.video(episode)))
    actions = torch.from_numpy(dataset.labels(episode).actions.astype(np.int64))
    with torch.no_grad():
        steps = [run.model.predict(images[t - 1 : t], images[t : t + 1], actions[t : t + 1]) for t in range(1, 7)]
        imagined = run.model.rollout(images[:1], images[1:2], actions[None, 1:])[0]
    return {"one_step": to_pixels(torch.cat(steps)).numpy(), "imagined": to_pixels(imagined).numpy()}


def pictures(rrd: Path, entity: str) -> np.ndarray:
    column = values(rrd, entity, "Image:buffer")
    assert [frame for frame, _ in column] == list(range(8))
    return np.array([buffer for _, (buffer,) in column], np.uint8).reshape(8, 64, 64, 3)


@pytest.mark.parametrize("kind", ["one_step", "imagined"])
def test_predictions_are_the_models(
    written: Path, dataset: Dataset, episode: int, predicted: dict[str, np.ndarray], kind: str
) -> None:
    shown, truth = pictures(written, f"/episode_{episode}/{kind}/frame"), dataset.video(episode)
    np.testing.assert_array_equal(shown[:2], truth[:2])  # given
    assert np.abs(shown[2:].astype(int) - predicted[kind]).max() <= 1  # other batches round otherwise
    errors = np.abs(shown.astype(int) - truth) * AMPLIFIED
    np.testing.assert_array_equal(pictures(written, f"/episode_{episode}/{kind}/difference"), np.minimum(errors, 255))


@pytest.mark.parametrize("kind", ["one_step", "imagined"])
def test_the_plotted_error_is_that_of_the_frame_shown(written: Path, dataset: Dataset, episode: int, kind: str) -> None:
    shown = pictures(written, f"/episode_{episode}/{kind}/frame").astype(float)
    expected = ((shown - dataset.video(episode)) ** 2).mean((1, 2, 3))
    points = curve(written, f"/episode_{episode}/mse/{kind}")
    assert [frame for frame, _ in points] == list(range(2, 8))
    np.testing.assert_allclose([value for _, value in points], expected[2:])


def test_repeating_the_frame_before_stands_beside_them(written: Path, dataset: Dataset, episode: int) -> None:
    truth = dataset.video(episode).astype(float)
    expected = ((truth[2:] - truth[1:-1]) ** 2).mean((1, 2, 3))
    np.testing.assert_allclose([value for _, value in curve(written, f"/episode_{episode}/mse/copied")], expected)


def test_the_training_curves_are_the_metrics(written: Path) -> None:
    assert curve(written, "/training/losses/loss") == [(2, 1.5), (4, 0.75)]
    assert curve(written, "/training/losses/prediction") == [(2, 0.5), (4, 0.25)]
    assert curve(written, "/training/losses/validation_loss") == [(4, 0.8)]
    assert curve(written, "/training/learning_rate")[:2] == [(2, 0.003), (4, 0.001)]


def test_the_chart_is_logarithmic(written: Path) -> None:
    """0.5 -> 0.25 falls as far as 1.5 -> 0.75."""
    falls = []
    for name in ("loss", "prediction"):
        (line,) = static(written, f"/training/chart/{name}", "LineStrips2D:strips")
        falls.append(line[1][1] - line[0][1])
    assert falls[0] == pytest.approx(falls[1])
    assert falls[0] > 0  # downward is larger in a picture


def test_curves_of_names_without_latin_letters_stand_beside_each_other(rrd: Path) -> None:
    names = ["実験", "比較", "10%", "10 %", "a/b"]
    curves = {name: Curve(np.array([1, 2]), np.array([1.0, 2.0 + number])) for number, name in enumerate(names)}
    with recording_to("chart", rrb.Blueprint(), file=rrd) as recording:
        log_chart(recording, "/chart", curves, dict.fromkeys(names, (1, 2, 3)), dict.fromkeys(names, 1.0), "steps")
    assert len([path for path in read(rrd) if path.endswith("/name")]) == len(names)


def test_maps_are_shown_before_and_after_they_move(written: Path, run: Run, dataset: Dataset, episode: int) -> None:
    images = to_model(torch.from_numpy(dataset.video(episode)))
    with torch.no_grad():
        maps = run.model.feature_maps(images[:-1]).numpy()
        moved = run.model.moved_maps(images[:-1], images[1:]).numpy()
    white = brightest(maps, moved)
    for name, expected in (("maps", tiles(maps, white)), ("moved_maps", tiles(moved, white))):
        column = values(written, f"/episode_{episode}/{name}", "Image:buffer")
        sheet = np.array([buffer for _, (buffer,) in column], int)
        assert np.abs(sheet.reshape(expected.shape) - expected).max() <= 1
    assert static(written, f"/episode_{episode}/maps/names", "Points2D:labels")[0] == "0, the agent's"


def test_arrows_are_the_agents_true_motion_and_the_models(
    written: Path, run: Run, dataset: Dataset, episode: int
) -> None:
    step = np.diff(dataset.labels(episode).agent.pixel[:, 0], axis=0)
    true = [vectors[0] for _, vectors in values(written, f"/episode_{episode}/camera/true_motion", "Arrows2D:vectors")]
    np.testing.assert_allclose(true, step)
    seen = [vectors[0] for _, vectors in values(written, f"/episode_{episode}/camera/motion_seen", "Arrows2D:vectors")]
    images = to_model(torch.from_numpy(dataset.video(episode)))
    with torch.no_grad():
        expected = run.model.pixel_shift(run.model.motion(images[:-1], images[1:])).numpy()
    np.testing.assert_allclose(seen, expected, atol=1e-3)


def test_the_text_names_model_data_and_labels(written: Path, run: Run, episode: int) -> None:
    (text,) = static(written, f"/episode_{episode}/about", "TextDocument:text")
    for word in (run.name, "dmotion", "squares-tiny", "one-shot (4 labels)", "test split"):
        assert word in text


def test_pictures_of_a_training_are_told_of_only_where_there_are_some(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    for samples in ({}, {1: run.path / "1.png"}):
        monkeypatch.setattr("dmotion_bench.viewing.run.samples_of", lambda path, samples=samples: samples)
        assert ("that the run has labels of" in _of_training(run)) == bool(samples)


def test_pages(written: Path, episode: int) -> None:
    assert tabs_of(written) == [f"Episode {episode} (worst)", "Training"]


def test_models_without_maps_or_motion_are_shown_too(run: Run, dataset: Dataset, episode: int, rrd: Path) -> None:
    other = Run(run.path, run.manifest)
    other.__dict__["model"] = Blind(run.model)
    write_scene(run_scene(other, dataset, [episode]), rrd)
    entities = {path.removeprefix(f"/episode_{episode}/") for path in read(rrd)}
    assert {"camera", "one_step/frame", "imagined/frame", "mse/one_step"} <= entities
    assert not {"maps", "moved_maps", "camera/motion_seen"} & entities


def test_an_unfinished_run_says_so(run: Run, dataset: Dataset, episode: int) -> None:
    unfinished = Run(run.path, {**run.manifest, "result": None})
    with pytest.raises(RunMissing, match="not finished"):
        run_scene(unfinished, dataset, [episode])


def test_things_without_colour_have_no_position_error(run: Run, dataset: Dataset, episode: int, rrd: Path) -> None:
    dataset = Dataset(dataset.path, dataset.manifest, dataset.rows)
    dataset.spec = replace(SPEC, agent_has_color=False)
    write_scene(run_scene(run, dataset, [episode]), rrd)
    assert len(values(rrd, f"/episode_{episode}/camera/places", "Ellipses2D:centers")[0][1]) == 4  # two rings each


@pytest.mark.slow
def test_a_run_is_shown_on_another_data_set_with_the_report_on_it(run: Run, tmp_path: Path, rrd: Path) -> None:
    other = write_squares(tmp_path / "data/others", frames=9)
    folder = report_folder(run.path, run.spec.fingerprint, other)
    assert folder == run.path / "report/on/others"
    made_up = write_made_up(run, {1: [10.0], 4: [90.0], 5: [1.0]})
    folder.parent.mkdir()
    shutil.copytree(made_up, folder, ignore=lambda *_: ["on"])
    report = folder / "report.json"
    report.write_text(report.read_text().replace(run.spec.fingerprint, other.fingerprint))
    try:
        target = Target("run", run.path)
        write_scene(scene_of(target, [], None, other.path), rrd)
    finally:
        shutil.rmtree(made_up)
    told = ["Episode 4 (worst, MSE 90.0)", "Episode 1 (middle, MSE 10.0)", "Episode 5 (best, MSE 1.00)"]
    assert tabs_of(rrd) == [*told, "Report", "Training"]
    (text,) = static(rrd, "/episode_4/about", "TextDocument:text")
    assert "trained on *squares-tiny*, shown on *others*" in text
    assert "not held out" not in text
    assert len(curve(rrd, "/episode_4/mse/one_step")) == 7


def test_a_picture_of_another_training_is_named(tmp_path: Path) -> None:
    for step, width in ((1, 8), (2, 9)):
        write_sample(tmp_path, step, np.zeros((6, width, 3), np.uint8))
    with pytest.raises(RunCorrupt, match=r"00000002\.png.*not as large as the others; delete it"):
        training_tab({}, "", samples_of(tmp_path))
