"""A filmstrip shows what was seen at its moments, and below it what the model makes of the images before."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from jaxtyping import UInt8
from PIL import Image
from pushed_squares import SPEC

from dmotion_bench.errors import ViewerError
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.run import Run
from dmotion_bench.planning.agents import NO_ACTION
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.captions import BACKGROUND, GAP, LINE, SIDE
from dmotion_bench.viewing.filmstrip import Film, filmstrip, write_filmstrip

SCALE = SIDE // SPEC.width
ACTIONS = np.array([0, 1, NO_ACTION, 2, 3, 0, 1])
DISTANCE = np.linspace(1, 0.2, 8)


def _tile(picture: Image.Image, column: int, row: int) -> UInt8[np.ndarray, "h w 3"]:
    """The frame in a place of the picture, as small as it was."""
    left, top = GAP + column * (SIDE + GAP), LINE + row * (LINE + SIDE) + LINE
    return np.asarray(picture)[top : top + SIDE : SCALE, left : left + SIDE : SCALE]


@pytest.fixture
def film(dataset: Dataset) -> Film:
    """Of a task of seven steps, in which each image follows the one before."""
    frames, film = np.array(dataset.video(0)[:8]), Film()
    for step in range(7):
        before = frames[[max(0, step - 1)]]
        film.take(Observation(previous=before, current=frames[[step]], goals=frames[[7]], step=step))
    film.current.append(frames[7])
    return film


def test_below_what_was_seen_stands_what_the_model_made_of_the_images_before(film: Film, run: Run) -> None:
    goal = film.current[3]
    picture = filmstrip(film, goal, DISTANCE, ACTIONS, run.model, ahead=3)

    assert picture.size == (GAP + 5 * (SIDE + GAP), 2 * LINE + 2 * (LINE + SIDE))
    for column, moment in enumerate((0, 2, 4, 7)):
        np.testing.assert_array_equal(_tile(picture, column, 0), film.current[moment])
    np.testing.assert_array_equal(_tile(picture, 4, 0), goal)
    for column, first, taken in ((1, 0, [0, 1]), (2, 1, [1, 2]), (3, 4, [3, 0, 1])):
        images = (to_model(torch.from_numpy(one[first])[None]) for one in (film.previous, film.current))
        with torch.inference_mode():
            expected = to_pixels(run.model.rollout(*images, torch.tensor([taken])))[0, -1].numpy()
        np.testing.assert_array_equal(_tile(picture, column, 1), expected)
    for column in (0, 4):
        assert (_tile(picture, column, 1) == BACKGROUND).all()


def test_continuous_actions_are_taken_in_their_units(film: Film, moved_runs: list[Run], moved: Dataset) -> None:
    model, actions = moved_runs[0].model, moved.labels(0).actions[:7].astype(np.float64)
    found = film.imagined(model, actions, moment=4, ahead=3)
    images = (to_model(torch.from_numpy(one[1])[None]) for one in (film.previous, film.current))
    with torch.inference_mode():
        expected = to_pixels(model.rollout(*images, torch.from_numpy(actions[None, 1:4]).float()))[0, -1].numpy()
    assert found is not None
    np.testing.assert_array_equal(found, expected)


def test_of_a_reference_there_is_what_was_seen(film: Film) -> None:
    picture = filmstrip(film, film.current[0], DISTANCE, ACTIONS, None, ahead=3)
    assert picture.height == 2 * LINE + LINE + SIDE


def test_a_task_of_one_step_has_two_moments(film: Film) -> None:
    picture = filmstrip(film, film.current[0], DISTANCE[:2], ACTIONS[:1], None, ahead=3)
    assert picture.width == GAP + 3 * (SIDE + GAP)


def test_a_picture_that_cannot_be_written_is_one_sentence(film: Film, tmp_path: Path) -> None:
    picture = filmstrip(film, film.current[0], DISTANCE, ACTIONS, None, ahead=3)
    write_filmstrip(picture, tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as file:
        np.testing.assert_array_equal(np.asarray(file), np.asarray(picture))
    with pytest.raises(ViewerError, match="cannot be written"):
        write_filmstrip(picture, tmp_path / "strip.png" / "below.png")
