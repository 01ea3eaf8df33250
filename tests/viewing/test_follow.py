"""Following a training and a recording: what is new is logged, once, whoever writes it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import rerun as rr
from pushed_squares import SPEC, squares_episode
from rrd_contents import curve, static, values

from dmotion_bench.learning.training.samples import write_sample
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.viewing.follow import Follower, RecordingFollower, TrainingFollower
from dmotion_bench.viewing.live import recording_to

ROWS = [{"step": step, "learning_rate": 0.1, "triplets_per_s": 9.0, "loss": 8.0 / step} for step in (1, 2, 3)]
VALIDATION = {"step": 3, "learning_rate": 0.1, "triplets_per_s": 9.0, "validation_loss": 2.5}


@contextmanager
def followed(follower: Follower, rrd: Path) -> Iterator[rr.RecordingStream]:
    with recording_to(follower.title, follower.blueprint(), file=rrd) as recording:
        follower.start(recording)
        yield recording


def append(run: Path, text: str) -> None:
    with (run / "metrics.jsonl").open("a") as file:
        file.write(text)


def test_rows_are_logged_once_and_whole(tmp_path: Path, rrd: Path) -> None:
    run = tmp_path / "run"
    run.mkdir()
    follower = TrainingFollower(run)
    lines = [json.dumps(row) + "\n" for row in (*ROWS, VALIDATION)]
    with followed(follower, rrd) as recording:
        assert not follower.poll(recording)  # there is nothing yet
        append(run, lines[0] + lines[1][:9])
        assert follower.poll(recording)
        assert not follower.poll(recording)
        append(run, lines[1][9:] + lines[2] + lines[3])
        assert follower.poll(recording)
    assert curve(rrd, "/training/losses/loss") == [(1, 8.0), (2, 4.0), (3, pytest.approx(8 / 3))]
    assert curve(rrd, "/training/losses/validation_loss") == [(3, 2.5)]
    assert curve(rrd, "/training/learning_rate")[:3] == [(1, 0.1), (2, 0.1), (3, 0.1)]
    look = {name: static(rrd, f"/training/losses/{name}", "SeriesLines:colors") for name in ("loss", "validation_loss")}
    assert look["loss"] == look["validation_loss"]  # the same loss, by its width in validation


def test_pictures_are_logged_at_their_steps(tmp_path: Path, rrd: Path) -> None:
    picture = np.random.default_rng(0).integers(0, 255, (6, 8, 3), dtype=np.uint8)
    follower = TrainingFollower(tmp_path)
    with followed(follower, rrd) as recording:
        write_sample(tmp_path, 40, picture)
        assert follower.poll(recording)
        write_sample(tmp_path, 80, 255 - picture)
        assert follower.poll(recording)
        assert not follower.poll(recording)
    column = values(rrd, "/training/samples", "Image:buffer")
    assert [step for step, _ in column] == [40, 80]
    np.testing.assert_array_equal(np.array(column[1][1][0], np.uint8).reshape(6, 8, 3), 255 - picture)


def test_a_training_is_done_when_its_result_is_written(tmp_path: Path) -> None:
    follower = TrainingFollower(tmp_path)
    assert not follower.done
    (tmp_path / "run.json").write_text('{"result": null}')
    assert not follower.done
    (tmp_path / "run.json").write_text('{"result": {"steps": 3}}')
    assert follower.done


def test_an_episode_of_each_new_shard(tmp_path: Path, rrd: Path, caplog: pytest.LogCaptureFixture) -> None:
    path = tmp_path / "squares-live"
    recipe = DatasetRecipe(environment="squares", episodes=4, frames=8, shard_episodes=2)
    follower = RecordingFollower(path, SPEC)
    with followed(follower, rrd) as recording:
        assert not follower.poll(recording)
        with DatasetWriter.create_or_resume(path, recipe, SPEC) as writer:
            for index in writer.missing:
                writer.write_shard(index, (squares_episode(one, 8) for one in writer.episodes_of(index)))
                assert follower.poll(recording)
                assert not follower.poll(recording)
                assert not follower.done
            writer.finish()
        assert follower.done
    column = values(rrd, "/recording/camera", "Image:buffer")
    assert [frame for frame, _ in column] == list(range(16))
    shown = np.array([buffer for _, (buffer,) in column], np.uint8).reshape(16, 64, 64, 3)
    dataset = Dataset.open(path)
    np.testing.assert_array_equal(shown, np.concatenate([dataset.video(0), dataset.video(2)]))
    assert curve(rrd, "/recording/shards") == [(0, 1.0), (8, 2.0)]
    (path / "video/shard-00000.mcap").write_bytes(b"garbage")
    anew = RecordingFollower(path, SPEC)
    with followed(anew, rrd.with_name("anew.rrd")) as recording:
        assert anew.poll(recording)
    assert "shard 0 of" in caplog.text
    assert [frame for frame, _ in values(rrd.with_name("anew.rrd"), "/recording/camera", "Image:buffer")] == list(
        range(8)
    )
    pushes = [float(dataset.labels(episode).pushed.sum()) for episode in (0, 2)]
    assert [value for _, value in curve(rrd, "/recording/pushes")] == pushes
