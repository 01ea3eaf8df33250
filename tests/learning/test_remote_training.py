"""A training straight from object storage that fails now and then, killed three times."""

from __future__ import annotations

import signal

import pytest
from object_storage import FAULTS, object_storage
from remote_training import killed, train_from
from walking_square import record_walks

from dmotion_bench.errors import DatasetCorrupt, RunError
from dmotion_bench.storage import object_store
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.remote_copy import upload

WHERE = "s3://data/walk-test"


@pytest.mark.slow
def test_storage_that_fails_and_three_kills_end_with_the_weights_of_a_training_from_a_folder(
    tmp_path, monkeypatch
) -> None:
    data = record_walks(tmp_path / "here" / "walk-test", episodes=40, shard_episodes=5)
    whole = train_from(str(data), tmp_path / "runs" / "whole")
    with object_storage() as storage:
        for name, value in storage.environment.items():
            monkeypatch.setenv(name, value)
        monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path / "there"))
        monkeypatch.setattr(object_store, "PAUSES", (0.01, 0.02, 0.04))
        upload(data, WHERE)
        largest = max(shard.video.size for shard in Dataset.open(data).manifest.shards)
        monkeypatch.setenv("DMBENCH_REMOTE_GIB", str(3.5 * largest / 2**30))  # three of eight files at a time
        kinds = [kind for kind in FAULTS if kind != "silent"]
        storage.fault = lambda *_: kinds[len(storage.seen) % len(kinds)] if len(storage.seen) % 5 == 0 else None
        for kill_at in (3, 11, 17):
            assert killed(WHERE, tmp_path / "runs" / "killed", kill_at) == -signal.SIGKILL
        again = train_from(WHERE, tmp_path / "runs" / "killed")
        assert storage.count("GET", ".mcap") > 3 * 8  # shards that had to make room came again
        assert again.result["weights"] == whole.result["weights"]
        assert again.result["validation_loss"] == whole.result["validation_loss"]
        assert again.manifest["dataset_path"] == WHERE
        assert Dataset.open(again.dataset_path).fingerprint == whole.spec.fingerprint

        storage.fault = lambda method, path: "wrong" if path.endswith(".mcap") else None
        with pytest.raises(DatasetCorrupt, match=r"is damaged: it does not hold the bytes .* Nothing of it is used"):
            train_from(WHERE, tmp_path / "runs" / "wrong")
        storage.fault = lambda *_: None
        again = train_from(WHERE, tmp_path / "runs" / "wrong")
        assert again.result["weights"] == whole.result["weights"]  # nothing wrong was trained on

        monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path / "elsewhere"))
        with pytest.raises(RunError, match="was trained on 's3://data/walk-test', which was never opened from here"):
            _ = again.dataset_path
