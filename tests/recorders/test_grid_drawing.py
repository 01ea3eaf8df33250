"""Grid World's second version is the paper's published code, pixel for pixel; its first is what it was."""

from __future__ import annotations

import hashlib
from pathlib import Path

import numpy as np
import pytest
from jaxtyping import Bool, Int, UInt8
from PIL import Image, ImageDraw

from dmotion_bench.errors import RecipeMismatch
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import Preset, episode_seed
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import record_words
from recorders.grid_things import FACTS, draw
from recorders.grid_world import GridWorld

THINGS = (FACTS.agent, *FACTS.objects)
PUBLISHED = {
    "000000_13": (
        [(2, 2), (2, 1), (0, 3), (1, 2), (0, 4)],
        "231d627dfd1fe9d54283be687cc64348f388eda3e03fa2afa50ce469f467af07",
    ),
    "000000_14": (
        [(2, 1), (2, 0), (0, 3), (1, 2), (0, 4)],
        "01ebeb93e02ec612d32d95d2f33c36b85ffdb4a75a735a40597ccc83ca55f76d",
    ),
    "000000_15": (
        [(3, 1), (2, 0), (0, 3), (1, 2), (0, 4)],
        "a6699f546ae7151ece708a8cda629a7fa6ff43907162b7942ab027152056e647",
    ),
    "000001_04": (
        [(3, 1), (0, 0), (2, 1), (1, 2), (1, 1)],
        "1958053c92b9b4f609256703de14bd8fa67af82d40fcc2e64c368ca3176e4813",
    ),
    "000001_05": (
        [(3, 2), (0, 0), (2, 1), (1, 2), (1, 1)],
        "42cbdb910efb05381ec0f6e51cd71ef711c11309b3e0adaadad211f36f177783",
    ),
}
"""Frames of Grid World that the paper's authors published beside their code (hyperplane-lab/dmotion-code,
datagen/demonstration/shape): the cells of agent and objects, and the SHA-256 of the 128 x 128 x 3 bytes."""


@pytest.mark.parametrize("name", PUBLISHED)
def test_the_authors_own_frames_are_drawn_byte_for_byte(name: str) -> None:
    cells, digest = PUBLISHED[name]
    there = np.ones((1, 5), np.bool_)

    frame = draw(np.array([cells]), there, 2).frames[0]
    assert hashlib.sha256(frame.tobytes()).hexdigest() == digest

    first = draw(np.array([cells]), there, 1).frames[0]
    assert 88 < np.square(first.astype(np.float64) - frame).mean() < 122  # why there is a second version


ROUNDER_NOW = ((45, 23), (45, -23), (-45, 23), (-45, -23), (23, 45), (23, -45), (-23, 45), (-23, -45))
"""From a circle's centre: the pixels of the canvas that Pillow 6 fills and Pillow 8.1 and later do not."""


def painted_by_pillow(cells: Int[np.ndarray, "n 2"], there: Bool[np.ndarray, " n"]) -> UInt8[np.ndarray, "h w 3"]:
    """The picture of the paper's code: shapes of 101 pixels on 500 x 500, row by row, reduced by nearest neighbour."""
    canvas = Image.new("RGB", (500, 500))
    pen = ImageDraw.Draw(canvas)
    for row, column, thing in sorted((int(y), int(x), thing) for thing, (x, y) in enumerate(cells) if there[thing]):
        look, x, y = THINGS[thing], 100 * column, 100 * row
        if look.shape == "circle":
            pen.ellipse((x, y, x + 100, y + 100), look.color)
            pen.point([(x + 50 + right, y + 50 + down) for right, down in ROUNDER_NOW], look.color)
        elif look.shape == "triangle":
            pen.polygon([(x + 50, y), (x, y + 100), (x + 100, y + 100)], look.color)
        else:
            pen.rectangle((x, y, x + 100, y + 100), look.color)
    return np.asarray(canvas.resize((128, 128), Image.Resampling.NEAREST))


def test_whole_episodes_are_what_pillow_paints() -> None:
    seeds = [episode_seed(0, number) for number in range(20)]
    hidden = 0
    for episode in GridWorld.generate(seeds, frames=32, policy="random", parameters={"version": 2}):
        labels = episode.labels
        position = np.concatenate([labels.agent.position, labels.objects.position], axis=1)
        visible = np.concatenate([labels.agent.visible, labels.objects.visible], axis=1)
        there = ~np.isnan(position[..., 0])
        for moment in range(32):
            cells = np.nan_to_num(position[moment, :, :2]).astype(np.int64)
            np.testing.assert_array_equal(episode.frames[moment], painted_by_pillow(cells, there[moment]))
        hidden += int(((visible > 0) & (visible < 1)).sum())
    assert hidden > 50  # things do hide one another's borders, in the order in which the cells are drawn


def test_both_versions_play_the_same_episodes() -> None:
    seeds = [episode_seed(0, number) for number in range(20)]
    first, second = (
        list(GridWorld.generate(seeds, frames=32, policy="random", parameters={"version": version}))
        for version in (1, 2)
    )
    errors = []
    for old, new in zip(first, second, strict=True):
        np.testing.assert_array_equal(old.labels.actions, new.labels.actions)
        np.testing.assert_array_equal(old.labels.objects.position, new.labels.objects.position)
        np.testing.assert_array_equal(old.labels.agent.position, new.labels.agent.position)
        errors.append(np.square(old.frames.astype(np.float64) - new.frames).mean())
        assert (old.frames != new.frames).any(-1).mean() < 0.01
    assert np.mean(errors) == pytest.approx(121, abs=15)  # over 9,600 frames: 120.7, 0.39% of the pixels


FINGERPRINTS = {
    1: "f335765a4a664df43bc9d00989a371bbcb3352bc481f7e3f9894a7b6597ffdb2",  # as it was before there was a version 2
    2: "408a6815e724bc64ef6ef7f1078e6d6b2eee2b27695383cb4cab6175b9ab67bb",
}


def test_a_recording_is_of_version_2_and_version_1_is_still_made_as_it_was(tmp_path: Path) -> None:
    new, old = (recipe_for("grid_world", Preset.TINY, settings=settings) for settings in ((), ("version=1",)))
    assert (new.parameters, new.version) == ({"version": 2}, 2)
    assert (old.parameters, old.version) == ({}, 1)
    for recipe in (old, new):
        record_dataset(tmp_path / str(recipe.version), recipe)
        assert Dataset.open(tmp_path / str(recipe.version)).fingerprint == FINGERPRINTS[recipe.version]


def test_a_recording_goes_on_in_its_own_version_only(tmp_path: Path) -> None:
    old = recipe_for("grid_world", Preset.TINY, episodes=3, frames=4, settings=("version=1",))
    record_dataset(tmp_path / "d", old)

    assert record_words(old, tmp_path / "d")[-4:] == ["--set", "version=1", "--out", str(tmp_path / "d")]
    with pytest.raises(RecipeMismatch, match=r"parameters is {} there and {'version': 2} here.*--set version=1"):
        record_dataset(tmp_path / "d", recipe_for("grid_world", Preset.TINY, episodes=3, frames=4))
