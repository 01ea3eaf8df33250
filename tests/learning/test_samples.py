"""Pictures of predictions through a training: of paid labels alone, and without a trace in the weights."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import ClassVar, NoReturn

import numpy as np
import pytest
import torch
from PIL import Image
from walking_square import record_walks

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import RunCorrupt
from dmotion_bench.learning.demonstrations import READ_AT_ONCE, Demonstrations
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, ModelInputs, TripletBatch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.samples import (
    GAP,
    largest_sample,
    read_sample,
    sample_of_demonstrations,
    samples_of,
)
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.4", "validations=3")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


def trained(data: Path, folder: Path, model: str, labels: str) -> Run:
    dataset = Dataset.open(data)
    request = TrainingRequest(model=model, labels=labels, settings=SETTINGS)
    run = open_run(request, dataset, folder, Workspace(folder))
    train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
    return Run.open(folder)


def rows(picture: np.ndarray, size: int) -> list[np.ndarray]:
    """The three rows of a picture, each a list of frames."""
    tall = picture.reshape(3, size + GAP, -1, size + GAP, 3)[:, :size, :, :size]
    return [row.transpose(1, 0, 2, 3) for row in tall]


@pytest.mark.slow
def test_one_at_each_validation_and_the_last_is_what_the_run_predicts(recorded: Path, tmp_path: Path) -> None:
    run = trained(recorded, tmp_path / "run", "dmotion", "one-shot")
    pictures = samples_of(run.path)
    validated = [json.loads(row)["step"] for row in run.metrics.read_text().splitlines() if "validation_loss" in row]
    assert list(pictures) == validated

    size = run.spec.height
    before, after, predicted = rows(read_sample(pictures[run.result["best_step"]]), size)
    dataset = Dataset.open(recorded)
    train_frames = np.concatenate([dataset.video(int(episode)) for episode in dataset.split("train")])
    for shown in (*before, *after):
        assert (train_frames == shown).all((1, 2, 3)).any()  # frames of the data set to the last bit

    given = training_data(run, dataset)
    demonstrations = given.budget.demonstrations(given.train)
    images = to_model(torch.from_numpy(demonstrations.frames))
    with torch.no_grad():
        expected = to_pixels(run.model.predict(images[:, 0], images[:, 1], torch.from_numpy(demonstrations.actions)))
    assert np.abs(predicted.astype(int) - expected.numpy()).max() <= 1


@pytest.mark.slow
@pytest.mark.parametrize(("model", "labels"), [("dmotion", "one-shot"), ("ed-cnn", "50%")])
def test_they_change_neither_the_weights_nor_the_labels_that_are_paid(
    recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, model: str, labels: str
) -> None:
    with_pictures = trained(recorded, tmp_path / "with", model, labels)
    monkeypatch.setattr("dmotion_bench.learning.training.loop._Trainer._sample", lambda _: None)
    without = trained(recorded, tmp_path / "without", model, labels)
    assert samples_of(with_pictures.path)
    assert not samples_of(without.path)
    for fact in ("weights", "labels", "labels_total", "validation_loss"):
        assert with_pictures.result[fact] == without.result[fact]
    for name in ("best.safetensors",):
        assert (with_pictures.path / name).read_bytes() == (without.path / name).read_bytes()


class _Noting(ForwardModel[None]):
    """Notes which actions it was told of."""

    supervision: ClassVar[Supervision] = Supervision.NONE
    told: ClassVar[set[int]] = set()

    def losses(self, batch: TripletBatch) -> NoReturn:
        raise AssertionError("it is not trained")

    def align(self, demonstrations: Demonstrations) -> None:
        self.told.update(demonstrations.action.tolist())

    def predict(self, previous: torch.Tensor, current: torch.Tensor, action: torch.Tensor) -> torch.Tensor:
        return current


def test_a_picture_of_many_demonstrations_knows_all_of_their_actions() -> None:
    action = torch.arange(3).repeat_interleave(READ_AT_ONCE)  # K-shot: by action
    images = torch.zeros(len(action), 3, 1, 1)
    given = Demonstrations(previous=images, current=images, next=images, action=action)
    model = _Noting(None, ModelInputs(height=1, width=1, actions=Discrete(("a", "b", "c"))))
    sample_of_demonstrations(model, given)
    assert model.told == {0, 1, 2}


@pytest.mark.slow
def test_a_run_without_labels_has_none(recorded: Path, tmp_path: Path) -> None:
    assert not samples_of(trained(recorded, tmp_path / "run", "dmotion", "none").path)


def test_a_picture_that_no_training_of_these_frames_makes_is_not_unpacked(tmp_path: Path) -> None:
    path = tmp_path / "00000001.png"
    Image.new("1", (13_000, 13_000)).save(path)  # 20 KiB, and half a gigabyte unpacked
    with pytest.raises(RunCorrupt, match=f"{re.escape(str(path))}.*13000x13000 pixels; delete it"):
        read_sample(path)
    Image.new("RGB", (4 * (8 + GAP), 3 * (6 + GAP))).save(path)
    assert read_sample(path, largest_sample(6, 8)).shape == (3 * (6 + GAP), 4 * (8 + GAP), 3)
    with pytest.raises(RunCorrupt):
        read_sample(path, largest_sample(6, 7))


@pytest.mark.parametrize("content", [b"", b"\x89PNG\r\n\x1a\n" + b"x" * 100])
def test_a_damaged_picture_is_named(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "00000001.png"
    path.write_bytes(content)
    with pytest.raises(RunCorrupt, match=f"{re.escape(str(path))}.*delete it"):
        read_sample(path)
