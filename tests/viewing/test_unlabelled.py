"""Recordings of which little is known: no labels at all, or nothing but the actions. What can be shown is shown."""

from __future__ import annotations

import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from pushed_squares import SPEC, squares_episode
from rrd_contents import curve, lane, layout_of, read, static, tabs_of, values

from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.specs import DatasetRecipe, Episode, EpisodeLabels, ObjectStates
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.viewing.comparison import comparison_scene
from dmotion_bench.viewing.dataset import dataset_scene
from dmotion_bench.viewing.imagination import imagine
from dmotion_bench.viewing.run import run_scene
from dmotion_bench.viewing.scene import write_scene

from .test_run_scene import Blind


@pytest.fixture
def unlabelled(dataset: Dataset, tmp_path: Path) -> Dataset:
    shutil.copytree(dataset.path, tmp_path / "unlabelled")
    shutil.rmtree(tmp_path / "unlabelled/labels")
    return Dataset.open(tmp_path / "unlabelled")


@pytest.fixture
def actions_alone(tmp_path: Path) -> Dataset:
    """Squares as an imported recording has them: actions, and no places or masks."""
    spec = replace(SPEC, objects=(), agent_has_color=False)
    recipe = DatasetRecipe(environment="imported", episodes=10, frames=8)

    def without_places(number: int) -> Episode:
        episode = squares_episode(number, 8)
        gone = ObjectStates(
            position=np.full((8, 1, 3), np.nan),
            orientation=np.full((8, 1, 4), np.nan),
            pixel=np.full((8, 1, 2), np.nan),
            visible=np.zeros((8, 1)),
        )
        nothing = replace(gone, **{name: getattr(gone, name)[:, :0] for name in vars(gone)})
        labels = EpisodeLabels(
            actions=episode.labels.actions,
            pushed=np.zeros(7, np.bool_),
            agent=gone,
            objects=nothing,
            masks=np.zeros_like(episode.labels.masks),
        )
        return replace(episode, labels=labels)

    with DatasetWriter.create_or_resume(tmp_path / "imported", recipe, spec) as writer:
        for index in writer.missing:
            writer.write_shard(index, map(without_places, writer.episodes_of(index)))
        writer.finish()
    return Dataset.open(tmp_path / "imported")


def names_of_views(rrd: Path) -> set[str]:
    return {
        str(parts["ViewBlueprint:display_name"][0])
        for parts in layout_of(rrd).values()
        if "ViewBlueprint:display_name" in parts
    }


def test_of_actions_alone_there_is_a_lane_and_no_empty_view(actions_alone: Dataset, rrd: Path) -> None:
    write_scene(dataset_scene(actions_alone, [0]), rrd)

    shown = {path for path in read(rrd) if path.startswith("/episode")}
    assert not any(part in path for path in shown for part in ("masks", "world", "trails", "places"))
    expected = [SPEC.actions.names[action] for action in actions_alone.labels(0).actions]
    assert lane(rrd, "/episode_0/action", 8) == [*expected, None]
    assert names_of_views(rrd) == {"Camera", "What happens", "What you see"}


def test_an_unlabelled_run_is_told_the_motion_it_sees(run: Run, unlabelled: Dataset, rrd: Path) -> None:
    write_scene(run_scene(run, unlabelled, [0]), rrd)

    images = to_model(torch.from_numpy(unlabelled.video(0)))
    with torch.no_grad():
        motion = run.model.latent_action(images[:-2], images[1:-1], images[2:])
        steps = to_pixels(run.model.predict_with_latent(images[:-2], images[1:-1], motion)).numpy()
        own = [images[:1], images[1:2]]
        for one in motion:
            own.append(run.model.predict_with_latent(own[-2], own[-1], one[None]))
        imagined = to_pixels(torch.cat(own[2:])).numpy()
    for kind, expected in (("one_step", steps), ("imagined", imagined)):
        column = values(rrd, f"/episode_0/{kind}/frame", "Image:buffer")
        shown = np.array([buffer for _, (buffer,) in column], np.uint8).reshape(8, 64, 64, 3)
        assert np.abs(shown[2:].astype(int) - expected).max() <= 1
    assert len(curve(rrd, "/episode_0/mse/one_step")) == 6
    assert tabs_of(rrd) == ["Episode 0", "Training"]
    assert "What happens" not in names_of_views(rrd)
    (text,) = static(rrd, "/episode_0/about", "TextDocument:text")
    assert "The actions of this recording are not known" in text
    assert "true motion (white)" not in text


def test_of_a_model_that_needs_actions_there_is_the_video_and_the_training(
    run: Run, unlabelled: Dataset, rrd: Path
) -> None:
    blind = Run(run.path, run.manifest)
    blind.__dict__["model"] = Blind(run.model)
    write_scene(run_scene(blind, unlabelled, [0]), rrd)

    assert {path for path in read(rrd) if path.startswith("/episode")} == {"/episode_0/camera", "/episode_0/about"}
    assert tabs_of(rrd) == ["Episode 0", "Training"]
    assert "predicts by actions alone" in static(rrd, "/episode_0/about", "TextDocument:text")[0]
    with pytest.raises(LabelsNotAvailable, match="actions alone"):
        imagine(blind.model, unlabelled.video(0), None, unlabelled.spec)


def test_unlabelled_runs_stand_side_by_side(run: Run, other_run: Run, unlabelled: Dataset, rrd: Path) -> None:
    write_scene(comparison_scene([run, other_run], unlabelled, [0]), rrd)
    assert {"/episode_0/model_0/imagined/frame", "/episode_0/model_1/imagined/frame"} <= set(read(rrd))
    assert "told the motion" in static(rrd, "/episode_0/about", "TextDocument:text")[0]

    blind = Run(other_run.path, other_run.manifest)
    blind.__dict__["model"] = Blind(other_run.model)
    with pytest.raises(LabelsNotAvailable, match="leave it out"):
        comparison_scene([run, blind], unlabelled, [0])


def test_without_places_the_table_has_no_empty_columns(run: Run, actions_alone: Dataset, rrd: Path) -> None:
    write_scene(run_scene(run, actions_alone, [0]), rrd)
    (text,) = static(rrd, "/episode_0/about", "TextDocument:text")
    assert "| mean of this episode | MSE |\n" in text
    assert "| - |" not in text


def test_of_a_model_that_draws_no_frames_there_is_the_video(
    run: Run, dataset: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(type(run.model), "needs_pixels", False)
    rrd = tmp_path / "scene.rrd"
    write_scene(run_scene(run, dataset, [0]), rrd)
    assert names_of_views(rrd) >= {"What really happens", "What you see"}
    assert "Predicted one step ahead" not in names_of_views(rrd)
    assert "This model draws no frames: here is the video." in static(rrd, "/episode_0/about", "TextDocument:text")[0]
