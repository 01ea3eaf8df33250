"""A run scored on an import: its actions are matched by their names, and a copy of the training is told by pictures."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from known_model import Known, NoConfig
from made_up_import import write_import
from noise_world import MOVES, noise_spec, write_noise
from PIL import Image
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import DatasetError, DatasetMissing, LabelsNotAvailable, RunMismatch, UsageError
from dmotion_bench.learning.action_encoding import ActionEncoding
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring import transfer
from dmotion_bench.scoring.overlap import _are_copies
from dmotion_bench.scoring.report import Report, read_report_samples
from dmotion_bench.scoring.score import score_model, score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.scoring.transfer import beyond_bounds, transferable
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.exports.lerobot import export_lerobot
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from recorders.grid_things import FACTS

from .conftest import write_dataset
from .test_identification import SeesGreen

MakeRun = Callable[..., Run]
QUICK = ScoreSettings(horizon=3, resamples=100)
ALPHABETICAL = ("down", "left", "right", "up")


class ByAction(Known):
    """Brightens the current frame more for a higher number of the action."""

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return current + 0.1 * (1 + action.to(current)).reshape(-1, 1, 1, 1)


@pytest.fixture
def run(make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    made = make_run(tmp_path / "run")
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: ByAction)
    return made


@pytest.fixture(scope="module")
def other(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Of another seed: what the import's recordings show."""
    return write_dataset(tmp_path_factory.mktemp("other") / "other", seed=4)


def _score(run: Run, dataset: Dataset, **options: Any) -> Report:
    return score_run(run.path, settings=QUICK, data=dataset.path, **options)


@pytest.mark.slow
def test_another_order_of_the_actions_changes_no_figure(run: Run, other: Dataset, tmp_path: Path) -> None:
    """One process scores both, as ``score --all`` does: what it keeps of the references must not mix the orders."""
    expected = score_model(run.model, other, settings=QUICK)
    shared = SharedSamples()
    reports = {
        name: _score(run, write_import(tmp_path / name, other, actions=actions), shared=shared)
        for name, actions in (("kept", None), ("sorted", ALPHABETICAL))
    }
    assert FACTS.actions != Discrete(ALPHABETICAL)
    assert reports["sorted"].figures == reports["kept"].figures
    assert reports["sorted"].reference == reports["kept"].reference
    kept, ordered = (read_report_samples(run.path / report.place, report) for report in reports.values())
    assert kept is not None
    assert kept.equals(ordered)

    figures = reports["sorted"].figures
    of_pixels = [name for name in figures if "mse" in name and "push" not in name]
    assert {"mse", "rollout_mse[3]"} <= set(of_pixels)
    assert {name: figures[name] for name in of_pixels} == {name: expected.figures[name].to_json() for name in of_pixels}
    assert not [name for name in figures if "position" in name]


def test_an_import_numbered_otherwise_is_the_same_data_set(other: Dataset, tmp_path: Path) -> None:
    ordered = write_import(tmp_path / "sorted", other, actions=ALPHABETICAL)
    assert isinstance(other.spec.actions, Discrete)
    read = ordered.numbered(other.spec.actions.names)
    assert (read.fingerprint, read.spec.actions) == (ordered.fingerprint, other.spec.actions)
    assert ordered.spec.actions == Discrete(ALPHABETICAL)
    for episode in (0, 7):
        taken = other.states(episode).actions
        np.testing.assert_array_equal(read.states(episode).actions, taken)
        np.testing.assert_array_equal(read.labels(episode).actions, taken)
        assert not np.array_equal(ordered.states(episode).actions, taken)
        np.testing.assert_array_equal(
            read.numbered(ALPHABETICAL).states(episode).actions, ordered.states(episode).actions
        )
        np.testing.assert_array_equal(read.video(episode), other.video(episode))
    with pytest.raises(UsageError, match="name the same ones in another order"):
        ordered.numbered(("up", "down"))


def test_an_import_of_other_bounds_is_read_with_those_of_the_training(
    run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Monday's and Tuesday's drives differ in their largest numbers."""
    monday, tuesday = (
        write_noise(tmp_path / name, spec=noise_spec(actions=replace(MOVES, low=low, high=high)))
        for name, low, high in (("monday", (-1.0, -2.0), (1.0, 2.0)), ("tuesday", (-1.5, -1.75), (1.5, 1.75)))
    )
    monkeypatch.setattr(transfer, "_is_import", lambda dataset: True)
    read = transfer._numbered(run, monday, tuesday)
    assert (read.spec.actions, read.fingerprint) == (monday.spec.actions, tuesday.fingerprint)
    np.testing.assert_array_equal(read.states(0).actions, tuesday.states(0).actions)
    other = write_noise(tmp_path / "other", spec=noise_spec(actions=replace(MOVES, units=("mm", "mm"))))
    with pytest.raises(RunMismatch, match="take data of the same actions"):
        transfer._numbered(run, monday, other)
    swapped = write_noise(tmp_path / "swapped", spec=noise_spec(actions=replace(MOVES, names=MOVES.names[::-1])))
    way_out = f"; their order differs: import it again with '--action-fields {','.join(MOVES.names)}'."
    with pytest.raises(RunMismatch, match=re.escape(way_out)):
        transfer._numbered(run, monday, swapped)


@pytest.mark.slow
def test_it_is_a_transfer_and_says_from_what(run: Run, grid: Dataset, other: Dataset, tmp_path: Path) -> None:
    slower = write_import(tmp_path / "recordings", other, step_ns=other.spec.step_ns * 2)
    report = _score(run, slower)
    assert report.place == Path("report/on/recordings")
    assert report.dataset == {
        "name": "recordings",
        "environment": "imported",
        "fingerprint": slower.fingerprint,
        "trained_on": {"name": grid.name, "fingerprint": grid.fingerprint, "environment": "grid_world"},
    }
    assert report.remarks["trained_on"] == (
        f"trained on {grid.name!r} (grid_world), and scored on 'recordings', an import whose actions are matched by "
        "their names; a step of it takes 0.2 s, of the training 0.1 s"
    )
    assert "paper" not in report.reference


@pytest.mark.slow
def test_an_export_comes_back_with_the_figures_of_what_was_exported(run: Run, other: Dataset, tmp_path: Path) -> None:
    export_lerobot(other, tmp_path / "export")
    options = ImportOptions(actions="action", seed=other.recipe.seed)
    import_recordings([tmp_path / "export"], tmp_path / "back", options)
    report = _score(run, Dataset.open(tmp_path / "back"))
    assert report.figures["mse"] == score_model(run.model, other, settings=QUICK).figures["mse"].to_json()


def _compressed(frames: np.ndarray) -> np.ndarray:
    """As a lossy codec with reduced colours leaves them: JPEG at quality 30."""
    kept = []
    for frame in frames:
        file = BytesIO()
        Image.fromarray(frame).save(file, "JPEG", quality=30)
        kept.append(np.asarray(Image.open(file)))
    return np.stack(kept)


@pytest.mark.slow
@pytest.mark.parametrize("cut", [1, 2])
@pytest.mark.parametrize("lossy", [False, True])
def test_a_copy_of_the_training_is_refused(run: Run, grid: Dataset, tmp_path: Path, lossy: bool, cut: int) -> None:
    picture = _compressed if lossy else lambda frames: frames
    copy = write_import(tmp_path / "copy", grid, seed=18, cut=cut, picture=picture, actions=ALPHABETICAL)
    trained = {*grid.split("train").tolist(), *grid.split("validation").tolist()}
    asked = copy.split("test").tolist()
    known = [episode for episode in asked if episode // cut in trained]
    assert 0 < len(known) < len(asked)
    assert lossy == (not np.array_equal(copy.video(0), grid.video(0)[: len(copy.video(0))]))
    listed = ", ".join(map(str, known[:5])) + (r" \.\.\." if len(known) > 5 else "")
    with pytest.raises(
        RunMismatch, match=rf"^{len(known)} of the {len(asked)} test .* show the same as .*\(episodes {listed}\)"
    ):
        _score(run, copy)


@pytest.mark.slow
def test_copies_of_frames_as_large_as_can_be_are_told() -> None:
    """Their sums are so large that the products of two are rounded."""
    generator = np.random.default_rng(0)
    most = 255 * (4096 // 8) ** 2
    frames, others = (generator.integers(most // 4, most, (many, 192)).astype(np.float64) for many in (60, 40))
    squared = (frames**2).sum(1) + (frames**2).sum(1) - 2 * np.diag(frames @ frames.T)
    assert (squared < 0).any()
    assert _are_copies(frames, iter([frames, others])).all()
    assert _are_copies(frames, iter([frames])).all()
    assert not _are_copies(others, iter([frames[:30], frames[30:]])).any()


def test_a_copy_that_tests_the_same_episodes_holds_them_out(run: Run, grid: Dataset, tmp_path: Path) -> None:
    copy = write_import(tmp_path / "copy", grid)
    np.testing.assert_array_equal(copy.split("test"), grid.split("test"))
    assert _score(run, copy).figures["mse"] == score_run(run.path, settings=QUICK).figures["mse"]


@pytest.mark.slow
def test_the_paper_s_split_has_trained_on_every_episode(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    shuffled = make_run(tmp_path / "shuffled", protocol="paper")
    with pytest.raises(RunMismatch, match=r"3 of the 3 test episodes .* show the same as"):
        _score(shuffled, write_import(tmp_path / "copy", grid))


def test_an_import_without_a_test_episode_gets_a_sentence(run: Run, tmp_path: Path) -> None:
    single = write_dataset(tmp_path / "single", seed=5, episodes=1)
    with pytest.raises(DatasetError, match="the test split of 'import' has no triplet"):
        _score(run, write_import(tmp_path / "import", single))


def test_static_frames_that_two_recordings_share_are_no_copy(
    run: Run, other: Dataset, grid: Dataset, tmp_path: Path
) -> None:
    """Both begin with the same two pictures, of the five that are looked at."""
    shared = grid.video(int(grid.split("train")[0]))[:2]
    beginning = write_import(
        tmp_path / "beginning", other, picture=lambda frames: np.concatenate([shared, frames[:3]]), actions=()
    )
    assert transferable(run, beginning, "test").fingerprint == beginning.fingerprint


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (
            {"renamed": {"up": "forward"}},
            r"forward, down, left, right, and those of .*up, down.*; take data of the same",
        ),
        ({"picture": 2}, r"128 x 128 pixels, and 'x' has 64 x 64; import it again with '--size 128'"),
    ],
)
def test_other_actions_or_pictures_are_refused(
    run: Run, other: Dataset, tmp_path: Path, options: dict[str, Any], said: str
) -> None:
    names, step = options.get("renamed", {}), options.get("picture", 1)
    foreign = write_import(
        tmp_path / "x",
        other,
        renamed=lambda name: names.get(name, name),
        picture=lambda frames: frames[:, ::step, ::step],
    )
    with pytest.raises(RunMismatch, match=said):
        _score(run, foreign)


def test_another_number_of_actions_is_refused_by_name(run: Run, other: Dataset, tmp_path: Path) -> None:
    more = write_import(tmp_path / "x", other, actions=(*ALPHABETICAL, "wait"))
    with pytest.raises(
        RunMismatch, match=r"of 'x' are down, left, right, up, wait, and those of .* up, down, left, right; take"
    ):
        _score(run, more)


@pytest.mark.slow
def test_control_is_refused(run: Run, other: Dataset, tmp_path: Path) -> None:
    with pytest.raises(LabelsNotAvailable, match=r"no environment to act in .* '--metrics prediction,rollout'"):
        _score(run, write_import(tmp_path / "x", other), metrics=("prediction", "control"))
    assert not (run.path / "report").exists()


def test_without_the_data_set_of_the_training_nothing_is_matched(
    make_run: MakeRun, other: Dataset, tmp_path: Path
) -> None:
    with pytest.raises(DatasetMissing, match=r"'x' is an import, and only the data set .* put it there again"):
        _score(make_run(tmp_path / "run", fingerprint="gone"), write_import(tmp_path / "x", other))


@pytest.mark.slow
def test_video_alone_is_scored_by_what_a_model_reads_off_it(
    run: Run, other: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    video = write_import(tmp_path / "video", other, actions=())
    with pytest.raises(LabelsNotAvailable, match="the actions of 'video' are not known, and this model predicts by"):
        _score(run, video)

    monkeypatch.setattr(Run, "model", SeesGreen())
    report = _score(run, video)
    expected = score_model(SeesGreen(), other, metrics=("prediction",), settings=QUICK).figures["mse_true_motion"]
    assert report.figures == {"mse_true_motion": expected.to_json()}
    assert report.remarks["trained_on"].endswith("and scored on 'video', an import")


@pytest.mark.slow
def test_a_run_that_knows_no_action_s_name_is_scored_on_video_alone(
    make_run: MakeRun, other: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    nameless = make_run(tmp_path / "run", labels="none")
    monkeypatch.setattr(Run, "model", SeesGreen())
    with pytest.raises(LabelsNotAvailable, match="trained with '--labels none'"):
        _score(nameless, write_import(tmp_path / "named", other))
    assert "mse_true_motion" in _score(nameless, write_import(tmp_path / "video", other, actions=())).figures


class ByNumber(Known):
    """Brightens the current frame by the first number of the action, normalised by the bounds of the training."""

    def __init__(self, config: NoConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.encoding = ActionEncoding(inputs.actions)

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return current + 0.1 * self.encoding(action)[:, 0].reshape(-1, 1, 1, 1)


def test_actions_beyond_those_of_the_training_are_scored_as_they_are(tmp_path: Path) -> None:
    wider = replace(MOVES, low=(-0.06, 0.0), high=(0.06, 2.25))
    tuesday = write_noise(tmp_path / "tuesday", episodes=20, spec=noise_spec(16, 16, actions=wider)).bounded(MOVES)
    model = ByNumber(NoConfig(), ModelInputs(height=16, width=16, actions=MOVES)).eval()
    test = {episode: tuesday.states(episode).actions for episode in tuesday.split("test").tolist()}
    taken = np.concatenate(list(test.values()))
    outside = ((np.abs(taken[:, 0]) > 0.04) | (taken[:, 1] > 1.5)).sum()
    assert 0 < outside < len(taken)
    assert beyond_bounds(tuesday, "test") == (outside, len(taken))

    scores = score_model(model, tuesday, metrics=("prediction", "rollout"), settings=ScoreSettings(horizon=2))
    errors = []
    for episode, actions in test.items():
        frames = tuesday.video(episode).astype(np.float32)
        for step in range(1, len(frames) - 1):
            drawn = np.clip(np.rint(frames[step] + 127.5 * 0.1 * actions[step, 0] / 0.04), 0, 255)
            errors.append(((drawn - frames[step + 1]) ** 2).mean())
    assert scores.figures["mse"].mean == pytest.approx(np.mean(errors), rel=1e-3)

    frames, (row, place) = tuesday.video(0)[:2], np.argwhere(MOVES.beyond(taken))[0]
    with pytest.raises(UsageError, match=f"was given '{MOVES.names[place]}' = .* in row 0; it can be"):
        model.predict(frames[:1], frames[1:], taken[row])
