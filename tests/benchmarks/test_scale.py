"""The arithmetic of a million hours, the share of time that is not work, and memory that does not grow."""

from __future__ import annotations

import json
import multiprocessing
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench.benchmarks import cluster
from dmotion_bench.benchmarks.cluster import Nap, Slept, simulate
from dmotion_bench.benchmarks.million_hours import YEAR_S, Inputs, amounts
from dmotion_bench.benchmarks.scene import scene_dataset
from dmotion_bench.benchmarks.streaming_memory import _into
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.storage.limits import LARGEST_MANIFEST, MOST_EPISODES

INPUTS = Inputs(
    hz=10.0,
    frame_bytes=49152.0,
    rendered_bytes=1000.0,
    camera_bytes=20_000.0,
    label_bytes=500.0,
    episode_frames=100.0,
    shard_episodes=20.0,
    index_bytes=30.0,
    manifest_bytes=100.0,
    source_bytes=10_000.0,
    import_s=0.5,
    stream_s=1e-4,
    train_s=1e-2,
    shard_requests=2.0,
)


def test_amounts_are_those_of_a_calculation_by_hand() -> None:
    found = amounts(INPUTS, hours=1000.0)  # 3.6e6 seconds, 3.6e7 frames, 3.6e5 episodes, 1.8e4 files
    assert (found.frames, found.episodes, found.shards) == (3.6e7, 3.6e5, 1.8e4)
    assert (found.source_tb, found.rendered_tb, found.camera_tb) == pytest.approx((0.036, 0.036, 0.72))
    assert found.cache_tb == pytest.approx(1.769472)
    assert found.index_gb == pytest.approx(0.0108)
    assert found.requests == 3.6e4
    assert found.import_core_years == pytest.approx(1.8e6 / YEAR_S)
    triplets = 3.6e5 * 98
    assert found.stream_core_years == pytest.approx(triplets * 1e-4 / YEAR_S)
    assert found.train_core_years == pytest.approx(triplets * 1e-2 / YEAR_S)
    assert found.readers_per_trainer == pytest.approx(0.01)
    assert found.datasets == pytest.approx(3.6e5 / MOST_EPISODES)  # 335,544 files, of 20 episodes, would fit otherwise
    crowded = Inputs(**{**vars(INPUTS), "manifest_bytes": LARGEST_MANIFEST / 10})
    assert amounts(crowded, hours=1000.0).datasets == pytest.approx(3.6e5 / (10 * 20))


class Scripted:
    """Two workers whose jobs begin and end when the test says so."""

    def __init__(self, slept: list[Slept]) -> None:
        self.slept = slept

    def map_unordered(self, function: Callable[..., Any], jobs: Iterable[Any]) -> Iterator[Any]:
        yield from self.slept


def test_time_between_jobs_is_no_work(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([100.0, 110.0])
    monkeypatch.setattr(cluster.time, "monotonic", lambda: next(clock))
    slept = [Slept(began=101, ended=104), Slept(began=102, ended=105), Slept(began=105, ended=108)]
    slept.append(Slept(began=106, ended=110))
    share = simulate("scripted", Scripted(slept), 2, [Nap(seconds=3)] * 4)
    assert (share.wall, share.starting, share.work) == (10.0, 2.0, 13.0)
    assert share.not_work == pytest.approx(1 - 13 / 20)
    # from 102, when both are busy, to 106, when the last job begins: 8 worker-seconds, of which 2 + 3 + 1 are work
    assert share.not_work_later == pytest.approx(2 / 8)
    assert share.between_jobs == pytest.approx(2 / 2)


def test_a_real_executor_is_measured() -> None:
    share = simulate("local", LocalExecutor(2), 2, [Nap(seconds=0.05)] * 6)
    assert share.jobs == 6
    assert share.work >= 6 * 0.05
    assert 0 <= share.not_work_later <= 1
    assert share.wall >= share.starting


def test_the_simulated_cluster_prints_a_table(capsys: pytest.CaptureFixture[str]) -> None:
    words = ["--workers", "2", "--jobs", "4", "--seconds", "0.05", "0.12", "--executors", "local"]
    cluster.main(words)
    said, _, head, rule, row = capsys.readouterr().out.splitlines()
    assert said == "Jobs sleep for 0.1, 0.1 s in turn."
    assert {line.count("|") for line in (head, rule, row)} == {9}
    assert row.startswith("| local | 2 | 4 | ")
    cluster.main([*words, "--json"])
    lengths, share = map(json.loads, capsys.readouterr().out.splitlines())
    assert lengths == {"seconds of the jobs": [0.05, 0.12]}
    assert share["work"] >= 2 * (0.05 + 0.12)


@pytest.mark.slow
def test_memory_stays_as_it_is_with_ten_times_as_many_episodes(tmp_path: Path) -> None:
    context = multiprocessing.get_context("spawn")
    peaks = []
    for episodes in (100, 1000):
        scene_dataset(tmp_path / str(episodes), episodes, 8)
        queue = context.Queue()
        process = context.Process(target=_into, args=(queue, tmp_path / str(episodes), 256, 10**9))
        process.start()
        found = queue.get(timeout=300)
        process.join()
        assert found.triplets >= 0.7 * 0.81 * episodes * 6
        peaks.append(found.streamed - found.before)
    frames = 900 * 8 * 49152 / 2**20  # that the larger one has more, decoded [MiB]
    assert peaks[1] - peaks[0] < 0.1 * frames
