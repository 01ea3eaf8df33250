"""What a run predicts of images and stored frames, by whatever its actions are called."""

from __future__ import annotations

import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from torch.utils.data import DataLoader

import dmotion_bench as dm
from dmotion_bench.errors import (
    DatasetMissing,
    LabelsNotAvailable,
    RunMismatch,
    UnknownName,
    UsageError,
)
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.model import TripletBatch

SHORT = {"epochs": 0.5}


def test_a_run_predicts_stored_frames_as_its_model_predicts_images(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    names = run.dataset.spec.actions.names  # type: ignore[union-attr]
    before, now = (to_model(torch.from_numpy(frames[step][None])) for step in (0, 1))
    with torch.inference_mode():
        expected = run.model.predict(before, now, torch.tensor([2]))
    assert torch.equal(run.predict(before, now, names[2]), expected)
    shown = run.predict(frames[0], frames[1], names[2])
    assert isinstance(shown, np.ndarray)
    assert shown.dtype == np.uint8
    assert (to_model(torch.from_numpy(shown)) - expected.clamp(-1, 1)).abs().max() <= 1 / 127.5
    assert np.array_equal(shown, run.predict(frames[0], frames[1], 2))


def test_images_that_a_model_would_take_wrongly_are_refused(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = torch.from_numpy(run.dataset.video(0))
    before, now = (to_model(frames[step][None]) for step in (0, 1))
    same = run.predict(before, now, "up")
    for kind in (torch.float64, torch.float16):
        assert torch.allclose(run.predict(before.to(kind), now.to(kind), "up"), same, atol=0.01)
    raw = frames[1][None].movedim(-1, 1).float()
    for wrong, says in ((raw, "values from 0 to 25"), (now * torch.nan, "values from nan to nan")):
        for call in (lambda one: run.predict(before, one, "up"), lambda one: run.latent_action(before, now, one)):
            with pytest.raises(UsageError, match=says):
                call(wrong)
    with pytest.raises(UsageError, match=r"DMotion\.predict\(\) was given batches of 1, 2 images"):
        run.predict(frames[0], frames[:2], "up")
    with pytest.raises(UsageError, match=r"there are no images: they were given with the shape \(0, "):
        run.predict(frames[:0], frames[:0], "up")


@pytest.mark.slow
def test_a_rollout_begins_with_the_prediction_and_takes_a_sequence_for_each(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    together = run.rollout(frames[:2], frames[1:3], [["up", "left"], ["down", "left"]])
    assert together.shape == (2, 2, 128, 128, 3)
    for row, name in enumerate(("up", "down")):
        alone = run.rollout(frames[row], frames[row + 1], [name, "left"])
        assert np.abs(alone.astype(int) - together[row].astype(int)).max() <= 1  # sums of another order
        first = run.predict(frames[row], frames[row + 1], name)
        assert np.abs(first[0].astype(int) - together[row, 0].astype(int)).max() <= 1
    with pytest.raises(UnknownName, match="did you mean 'up'"):
        run.predict(frames[0], frames[1], "upp")


def _run_of(workspace: Path) -> dm.Run:
    """The run, trained on the data set of this workspace alone."""
    run = dm.load_run("tiny")
    run.manifest["dataset_path"] = "data/grid_world-tiny"
    run.write()
    return run


@pytest.mark.slow
def test_a_run_predicts_by_the_names_that_it_keeps_without_its_data_set(workspace: Path) -> None:
    run = _run_of(workspace)
    frames = run.dataset.video(0)
    left = run.predict(frames[0], frames[1], "left")
    shutil.rmtree(workspace / "data")
    alone = dm.load_run("tiny")
    assert np.array_equal(alone.predict(frames[0], frames[1], "left"), left)
    assert alone.rollout(frames[0], frames[1], ["left", "up"]).shape == (1, 2, 128, 128, 3)
    del alone.manifest["action_names"]  # as in a run of before
    alone.write()
    before = dm.load_run("tiny")
    assert np.array_equal(before.predict(frames[0], frames[1], "2"), left)
    with pytest.raises(DatasetMissing):
        before.predict(frames[0], frames[1], "left")


@pytest.mark.slow
def test_another_data_set_in_the_place_of_a_run_s_own_is_noticed(workspace: Path) -> None:
    run = _run_of(workspace)
    frames = run.dataset.video(0)
    expected = run.predict(frames[0], frames[1], "left")
    shutil.rmtree(workspace / "data" / "grid_world-tiny")
    dm.record("grid_world", "tiny", seed=1, episodes=4, out="data/grid_world-tiny")
    with pytest.raises(RunMismatch, match=r"has changed since the run 'tiny' was trained on it; open it as it is now"):
        _ = run.dataset
    assert np.array_equal(run.predict(frames[0], frames[1], "left"), expected)
    del run.manifest["action_names"]
    with pytest.raises(RunMismatch, match="has changed"):
        run.predict(frames[0], frames[1], "left")


def test_actions_of_tensors_are_checked(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    for number in (-1, 99):
        with pytest.raises(UsageError, match=f"given action {number} in row 0; there are 4"):
            run.predict(frames[0], frames[1], torch.tensor([number]))
        with pytest.raises(UsageError, match=f"given action {number} in row 1; there are 4"):
            run.rollout(frames[0], frames[1], torch.tensor([[0, number]]))


@pytest.mark.slow
def test_a_model_that_was_first_asked_for_a_prediction_can_be_trained_further(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    run.predict(frames[0], frames[1], "up")
    batch = next(iter(DataLoader(run.dataset.triplets("train"), batch_size=4)))
    run.model.train().losses(TripletBatch(**batch)).total.backward()
    assert any(one.grad is not None and bool(one.grad.any()) for one in run.model.parameters())
    with torch.inference_mode():
        other = dm.load_run("tiny").model
    assert not any(one.is_inference() for one in (*other.parameters(), *other.buffers()))


@pytest.mark.slow
def test_latent_actions_are_the_model_s_and_not_every_model_has_them(workspace: Path) -> None:
    run = dm.load_run("tiny")
    frames = run.dataset.video(0)
    images = [to_model(torch.from_numpy(frames[step : step + 1])) for step in range(3)]
    model: Any = run.model
    with torch.inference_mode():
        expected = model.latent_action(*images)
    assert np.array_equal(run.latent_action(*frames[:3]), expected.numpy())
    other = dm.train("ed-cnn", labels="all", settings={"epochs": 0.1})
    with pytest.raises(UsageError, match="'ed-cnn' has no latent actions that can be read: it is given the actions"):
        other.latent_action(*frames[:3])


@pytest.mark.slow
def test_a_run_without_labels_says_how_to_tell_it_the_actions(workspace: Path) -> None:
    run = dm.train("dmotion", labels="none", settings=SHORT, threads=1)
    frames = run.dataset.video(0)
    with pytest.raises(LabelsNotAvailable, match="--labels"):
        run.predict(frames[0], frames[1], "up")
    assert run.latent_action(*frames[:3]).shape == (1, 2)
