"""The learned number of steps between frames, on video in which a square goes its way."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import UInt8
from scipy.stats import spearmanr

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.temporal_distance import (
    TemporalDistance,
    TemporalDistanceConfig,
    load,
    main,
    pairs,
    place_of,
    save,
    train,
)
from dmotion_bench.workspace import Workspace

REACH = 12
CONFIG = TemporalDistanceConfig(steps=150, batch_size=48, reach=REACH, width=8, learning_rate=3e-3)


def _video(start: int, length: int = 20) -> UInt8[np.ndarray, "t h w 3"]:
    """A square that moves one pixel to the right in each frame."""
    frames = np.zeros((length, 32, 32, 3), np.uint8)
    for step in range(length):
        frames[step, 12:18, start + step : start + step + 6] = 255
    return frames


class _Frames:
    def __init__(self, videos: list[np.ndarray]) -> None:
        self.frames = np.concatenate(videos)
        self.offsets = np.cumsum([0, *map(len, videos)])

    @property
    def nbytes(self) -> int:
        return self.frames.nbytes

    def checked(self, first: np.ndarray, length: int) -> np.ndarray:
        assert length == 1
        assert first.max() < len(self.frames)
        return self.frames


@pytest.fixture(scope="module")
def videos() -> _Frames:
    return _Frames([_video(start) for start in (0, 2, 4, 6)])


@pytest.fixture(scope="module")
def trained(videos: _Frames) -> TemporalDistance:
    return train(videos, np.arange(4), CONFIG)


@pytest.mark.slow
def test_it_tells_how_many_steps_lie_between_two_frames(trained: TemporalDistance) -> None:
    video = _video(3)  # begins where no episode of the training does
    with torch.inference_mode():
        vectors = trained.embed(to_model(torch.from_numpy(video)))
        told = torch.stack([trained.between(vectors, vectors[[one]].expand_as(vectors)) for one in range(len(video))])
    steps = np.abs(np.arange(20)[:, None] - np.arange(20))
    near = steps <= REACH

    assert spearmanr(told.numpy()[near], steps[near]).statistic > 0.9
    assert np.abs(told.numpy()[near] - steps[near]).mean() < 2.5
    assert float(told.diagonal().max()) < 0.01
    assert float(told.max()) <= REACH


def test_pairs_are_as_many_steps_apart_as_they_say() -> None:
    offsets, episodes = np.array([0, 5, 30, 60]), np.array([1, 2])
    first, second, apart = pairs(np.random.default_rng(0), offsets, episodes, 5000, 8)
    owner = [np.searchsorted(offsets, places, side="right") - 1 for places in (first, second)]
    same = owner[0] == owner[1]

    assert set(owner[0].tolist()) | set(owner[1].tolist()) == {1, 2}
    np.testing.assert_array_equal(apart[same], np.abs(second - first)[same])
    assert (apart[~same] == 8).all()
    assert apart.max() <= 8
    assert 0.05 < (~same).mean() < 0.25  # a quarter, of which half are the same episode by chance


@pytest.mark.slow
def test_the_same_seed_gives_the_same_network_under_the_same_name(
    videos: _Frames, trained: TemporalDistance, tmp_path: Path
) -> None:
    workspace = Workspace(tmp_path)
    few = TemporalDistanceConfig(steps=3, batch_size=8, width=4)
    names = [save(train(videos, np.arange(4), few), workspace) for _ in range(2)]
    assert names[0] == names[1]

    name = save(trained, workspace)
    again = load(name, workspace)
    frames = to_model(torch.from_numpy(_video(1)))
    torch.testing.assert_close(again.embed(frames), trained.embed(frames), rtol=0, atol=0)
    assert again.config == CONFIG


def test_what_is_no_learned_distance_is_refused(trained: TemporalDistance, tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    with pytest.raises(InvalidSetting, match="names no learned distance; train one with"):
        load("../../somewhere", workspace)
    with pytest.raises(InvalidSetting, match=r"there is no learned distance 000000000000\.\.\."):
        load("0" * 64, workspace)
    other = {name: value + 1 for name, value in trained.state_dict().items()}
    checkpoint.save(place_of("0" * 64, workspace), other, {"config": vars(CONFIG)})
    with pytest.raises(InvalidSetting, match="other weights than its name says"):
        load("0" * 64, workspace)
    checkpoint.save(place_of("1" * 64, workspace), other, {})
    with pytest.raises(InvalidSetting, match="holds no learned distance"):
        load("1" * 64, workspace)
    for width in (9, 2**20, 2**63):
        checkpoint.save(place_of("2" * 64, workspace), other, {"config": vars(CONFIG) | {"width": width}})
        with pytest.raises(
            InvalidSetting, match=r"holds no learned distance: (its weights are of another|.*[Oo]verflow)"
        ):
            load("2" * 64, workspace)


def test_a_damaged_file_is_said_with_what_makes_it_again(tmp_path: Path) -> None:
    """The way out of a damaged checkpoint of a training would delete every other network beside it."""
    workspace = Workspace(tmp_path)
    path = place_of(save(TemporalDistance(CONFIG), workspace), workspace)
    content = bytearray(path.read_bytes())
    content[-3] ^= 1
    path.write_bytes(content)
    with pytest.raises(InvalidSetting, match=r"is damaged, .*delete that file and train the network again with"):
        load(path.stem, workspace)


@pytest.mark.parametrize("config", [[], "x", {"width": 1.5}, {"width": True}, {"width": "a"}, {"deep": 1}])
def test_settings_that_cannot_be_are_refused(tmp_path: Path, config: Any) -> None:
    workspace = Workspace(tmp_path)
    checkpoint.save(place_of("3" * 64, workspace), TemporalDistance(CONFIG).state_dict(), {"config": config})
    with pytest.raises(InvalidSetting, match=r"holds no learned distance|cannot be read|has no field deep"):
        load("3" * 64, workspace)


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["data/missing"], "error: .*data/missing"),
        (["data/missing", "--steps", "0"], "error: steps is 0; it must be 1 or more"),
        (["data/missing", "--seed", "-1"], "error: seed is -1; it cannot be below zero"),
    ],
)
def test_what_the_command_cannot_do_is_a_sentence(
    arguments: list[str], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    with pytest.raises(SystemExit) as left:
        main(arguments)
    assert left.value.code == 2
    assert re.search(said, capsys.readouterr().err)
