"""A filmstrip shows what was seen at its moments, and below it what the model makes of the images before."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import UInt8
from PIL import Image
from pushed_squares import SPEC

from dmotion_bench.errors import ViewerError
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.agents import NO_ACTION
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.captions import BACKGROUND, GAP, LINE, SIDE, captioned
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


@pytest.fixture
def said(monkeypatch: pytest.MonkeyPatch) -> list[tuple[str, str, str]]:
    """Of each picture the heading, the words above the second row, and those at the end."""
    pictures: list[tuple[str, str, str]] = []

    def take(titles: Any, rows: Any, below: str, *, heading: str) -> Image.Image:
        pictures.append((heading, rows[1][0], below))
        return captioned(titles, rows, below, heading=heading)

    monkeypatch.setattr("dmotion_bench.viewing.filmstrip.captioned", take)
    return pictures


def test_words_tell_whose_task_it_is_and_how_old_the_images_are(
    film: Film, run: Run, said: list[tuple[str, str, str]]
) -> None:
    for ahead, lost in ((2, 0), (3, 2), (1, 0)):
        filmstrip(film, film.current[0], DISTANCE, ACTIONS, run.model, ahead=ahead, title="run, task 3", lost=lost)

    distance = "the numbers are the distance left: 1 at the start, 0 at the goal"
    assert said == [
        ("run, task 3", "imagined from the images 2 steps before", distance),
        (
            "run, task 3",
            "imagined from the images up to 3 steps before",
            f"{distance}; each lost object adds 1, 2 lost",
        ),
        ("run, task 3", "imagined from the images 1 step before", distance),
    ]


def test_long_words_take_several_lines() -> None:
    frames = [np.zeros((SPEC.height, SPEC.width, 3), np.uint8)] * 2
    short, long = (captioned([title, "b"], [("seen", frames)], "below") for title in ("a", "a " * 40))
    assert (short.width, long.width) == (GAP + 2 * (SIDE + GAP),) * 2
    assert (long.height - short.height) % LINE == 0
    assert long.height > short.height
    written = np.asarray(long)[:, : GAP + SIDE] != BACKGROUND
    assert not (np.asarray(long)[: 2 * LINE, GAP + SIDE : 2 * GAP + SIDE] != BACKGROUND).any()  # between the columns
    assert written[LINE : 2 * LINE].any()
    headed = captioned(["a", "b"], [("seen", frames)], "below", heading="run", notes=("", "ended"))
    assert headed.height == short.height + 2 * LINE


def test_a_picture_that_cannot_be_written_is_one_sentence(film: Film, tmp_path: Path) -> None:
    picture = filmstrip(film, film.current[0], DISTANCE, ACTIONS, None, ahead=3)
    write_filmstrip(picture, tmp_path / "strip.png")
    with Image.open(tmp_path / "strip.png") as file:
        np.testing.assert_array_equal(np.asarray(file), np.asarray(picture))
    with pytest.raises(ViewerError, match="cannot be written"):
        write_filmstrip(picture, tmp_path / "strip.png" / "below.png")
