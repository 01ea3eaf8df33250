"""Triplets out of the compressed files: every one once an epoch, in an order that nothing but seed and step decide."""

from __future__ import annotations

import functools
import logging
import shutil
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from training_together import together, train_exact
from walking_square import record_walks

from dmotion_bench.errors import DatasetCorrupt, UsageError
from dmotion_bench.learning.data.batches import FramesOnDevice, TripletBatches
from dmotion_bench.learning.data.curriculum import held_for_validation, parts_of, video_sample
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.streamed import WINDOW, StreamedBatches, StreamedTriplets
from dmotion_bench.learning.data.streamed_order import StreamedOrder, Window
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.model import Phase, TrainingConfig
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training import conditions
from dmotion_bench.learning.training.companions import Companions
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

EXACT = ("batch_size=7", "epochs=3", "validations=3", "hard_share=0.4", "precision=float32", "window=12")
counts_of_episodes = st.lists(st.integers(1, 9), min_size=1, max_size=30)


class Stopped(Exception):
    """Raised by a progress callback."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test", episodes=30)


@pytest.fixture(scope="module")
def walks(recorded) -> Dataset:
    return Dataset.open(recorded)


@pytest.fixture
def uncached(recorded, tmp_path) -> Dataset:
    shutil.copytree(recorded, tmp_path / "data" / "walk-test", ignore=shutil.ignore_patterns("cache"))
    return Dataset.open(tmp_path / "data" / "walk-test")


def order_of(counts: list[int], *, shard: int = 4, **settings: int) -> StreamedOrder:
    given = {"batch_size": 4, "seed": 0, "window": 20} | settings
    return StreamedOrder(np.array(counts), np.arange(len(counts)) // shard, **given)


def epochs_of_lanes(order: StreamedOrder, epochs: int) -> list[list[int]]:
    """The triplets of each epoch, taken from every lane as far as its epoch goes."""
    found: list[list[int]] = [[] for _ in range(epochs)]
    for lane, items in enumerate(order._lengths.tolist()):
        length, taken, step = items * order._size, list[int](), 0
        while len(taken) < epochs * length:
            taken += order.share(order.batch(step), lane, order.lanes).tolist()
            step += 1
        for epoch in range(epochs):
            found[epoch] += taken[epoch * length : (epoch + 1) * length]
    return found


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=30)
@given(
    counts=counts_of_episodes,
    shard=st.integers(1, 9),
    batch=st.integers(1, 20),
    seed=st.integers(0, 3),
    window=st.integers(1, 60),
)
def test_every_triplet_comes_once_an_epoch(counts, shard, batch, seed, window) -> None:
    order = order_of(counts, shard=shard, batch_size=batch, seed=seed, window=window)
    assert order.batch_size == min(batch, sum(counts))
    for epoch in epochs_of_lanes(order, 2):
        assert sorted(epoch) == list(range(sum(counts)))


@settings(deadline=None, derandomize=True, max_examples=40)
@given(counts=counts_of_episodes, batch=st.integers(4, 20), size=st.sampled_from([2, 4]), seed=st.integers(0, 3))
def test_groups_hold_moments_of_one_episode_and_leave_out_as_little_as_they_can(counts, batch, size, seed) -> None:
    order = order_of(counts, batch_size=batch, seed=seed, together=size)
    episode = np.repeat(np.arange(len(counts)), counts)
    grouped = size if max(counts) >= size else 1
    for triplets in epochs_of_lanes(order, 2):
        groups = episode[np.array(triplets).reshape(-1, grouped)]
        assert (groups == groups[:, :1]).all()
        assert len(set(triplets)) == len(triplets)
        assert Counter(groups[:, 0].tolist()) == {n: one // grouped for n, one in enumerate(counts) if one >= grouped}


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=40)
@given(
    counts=counts_of_episodes,
    batch=st.integers(1, 20),
    window=st.integers(1, 60),
    world=st.integers(1, 11),
    step=st.integers(0, 40),
)
def test_a_step_is_known_by_its_number_alone(counts, batch, window, world, step) -> None:
    walked = order_of(counts, batch_size=batch, window=window)
    for earlier in range(step):
        walked.batch(earlier)
    order = order_of(counts, batch_size=batch, window=window)
    np.testing.assert_array_equal(order.batch(step), walked.batch(step))
    if order.batch_size < world:
        return
    shares = [order.share(order.batch(step), rank, world) for rank in range(world)]
    np.testing.assert_array_equal(np.concatenate(shares), order.batch(step))
    ends = np.cumsum(counts)
    for rank, share in enumerate(shares):  # what a process has read is enough for its share
        windows = order.open_windows(step, order.lanes_of(rank, world))
        read = {place for window in windows for place in order.episodes(window)}
        assert len(share)
        assert set(np.searchsorted(ends, share, side="right").tolist()) <= read


def test_other_seeds_and_epochs_have_other_orders() -> None:
    order = order_of([9] * 20)
    one, two = epochs_of_lanes(order, 2)
    assert one != two
    assert one != epochs_of_lanes(order_of([9] * 20, seed=1), 1)[0]


def test_windows_bound_what_is_in_memory_and_mix_what_is_in_them() -> None:
    """About a window and a quarter, in whole episodes, for ten times as many episodes, too."""
    most = {}
    for episodes in (500, 5000):
        order = order_of([10] * episodes, shard=20, batch_size=32, window=1600)
        held = []
        for step in range(400):
            windows = order.open_windows(step, range(order.lanes))
            held.append(10 * len({place for window in windows for place in order.episodes(window)}))
        most[episodes] = max(held)
    assert most[500] <= 1.6 * 1600
    assert most[5000] <= 1.1 * most[500]
    first = order._windows.of(Window(3, 0, 1)).reshape(-1)
    assert len(first) == 200
    assert abs(np.corrcoef(np.arange(200), np.argsort(first.argsort()))[0, 1]) < 0.2


def test_hard_triplets_come_from_the_open_windows_once_all_of_these_have_losses() -> None:
    order = order_of([10] * 40, batch_size=16, window=160)
    losses = np.full(400, np.nan, np.float32)
    np.testing.assert_array_equal(order.mixed_batch(3, losses, 0.5), order.batch(3))
    losses[:] = 0.0
    losses[np.arange(0, 400, 10)] = 1.0  # the first triplet of each episode
    for step in (3, 11, 60):
        mixed, even = order.mixed_batch(step, losses, 0.5), order.batch(step)
        np.testing.assert_array_equal(mixed, order.mixed_batch(step, losses, 0.5))
        windows = [order.open_windows(step, [lane]) for lane in range(order.lanes)]
        for lane, at_hand in enumerate(windows):
            mine, evenly = (order.share(one, lane, order.lanes) for one in (mixed, even))
            assert mine[0] == evenly[1]
            assert losses[mine[1]] == 1.0
            assert mine[1] // 10 in {place for window in at_hand for place in order.episodes(window)}


def test_hard_groups_come_whole_from_the_open_windows() -> None:
    order = order_of([10] * 40 + [3] * 5, batch_size=33, window=320, together=4)
    episode = np.repeat(np.arange(45), [10] * 40 + [3] * 5)
    losses = np.where(episode % 2 == 0, np.float32(1.0), np.float32(0.0))
    losses[9::10] = np.nan  # others of the same group are known
    for step in (1, 8, 30):
        mixed, even = order.mixed_batch(step, losses, 0.5), order.batch(step)
        assert len(mixed) == order.batch_size == 32
        groups = mixed.reshape(-1, 4)
        assert (episode[groups] == episode[groups][:, :1]).all()
        assert all(len(set(group)) == 4 for group in groups.tolist())
        np.testing.assert_array_equal(groups[::2], even.reshape(-1, 4)[::2])  # every other lane draws its group
        for lane in range(1, order.lanes, 2):
            at_hand = {place for window in order.open_windows(step, [lane]) for place in order.episodes(window)}
            drawn = int(episode[groups[lane, 0]])
            assert drawn in at_hand
            assert drawn % 2 == 0 or all(place % 2 for place in at_hand)


def _streamed(walks: Dataset, loaders: int = 1) -> StreamedTriplets:
    return StreamedTriplets.of_split(walks, "train", window=24, loaders=loaders)


@pytest.mark.slow
@pytest.mark.parametrize("loaders", [1, 4])
def test_batches_are_those_of_the_cache_for_any_number_of_loaders(walks, loaders) -> None:
    triplets, cached = _streamed(walks, loaders), TripletSet.of_split(walks, "train")
    assert len(triplets) == len(cached)
    order = triplets.order(8, seed=5)
    actions = functools.cache(lambda episode: walks.states(episode).actions)
    batches = StreamedBatches(triplets, order, actions, torch.device("cpu"))
    read = StreamedBatches(triplets, order, None, torch.device("cpu"), earlier=3)
    reaching = TripletBatches(cached, None, FramesOnDevice(torch.device("cpu"))).reaching_back(3)
    taken = np.array([actions(at)[step] for at, step in zip(cached.episode, cached.step, strict=True)])
    labelled = TripletBatches(cached, taken, FramesOnDevice(torch.device("cpu"))).reaching_back(3)
    told = StreamedBatches(triplets, order, actions, torch.device("cpu"), earlier=3)
    for step in range(40):
        index = order.batch(step)
        batches.expect(step, 0, 1)
        batch = batches(index)
        np.testing.assert_array_equal(triplets.places(index), cached.places(index))
        frames = torch.from_numpy(cached.gather(index)).float().permute(1, 0, 4, 2, 3) / 127.5 - 1
        for images, wanted in zip((batch.previous, batch.current, batch.next), frames, strict=True):
            torch.testing.assert_close(images, wanted, atol=1e-6, rtol=0)
        expected = [actions(episode)[at] for episode, at in zip(*triplets.places(index), strict=True)]
        assert batch.action.tolist() == expected
        assert batch.episode.tolist() == triplets.places(index)[0].tolist()
        torch.testing.assert_close(read(index).current, batch.current)  # nothing has to be expected
        assert batch.earlier is None
        assert torch.equal(read(index).earlier, reaching(index).earlier)
        assert read(index).earlier_action is None
        for name in ("earlier", "earlier_action", "history"):
            assert torch.equal(getattr(told(index), name), getattr(labelled(index), name))
    for one in (batches, read, told):
        one.close()


def test_a_damaged_episode_ends_the_training_with_a_sentence(recorded, tmp_path) -> None:
    shutil.copytree(recorded, tmp_path / "walk")
    walks = Dataset.open(tmp_path / "walk")
    row = walks.rows[int(walks.split("train")[3])]
    file = tmp_path / "walk" / "video" / f"shard-{row.shard:05d}.mcap"
    content = bytearray(file.read_bytes())
    content[row.video.offset + row.video.size // 2] ^= 0xFF
    file.write_bytes(content)
    triplets = _streamed(walks)
    order = triplets.order(8, seed=0)
    batches = StreamedBatches(triplets, order, None, torch.device("cpu"))

    def epoch() -> None:
        for step in range(len(triplets) // 8 + 1):
            batches.expect(step, 0, 1)
            batches(order.batch(step))

    with pytest.raises(DatasetCorrupt, match=r"is damaged: it .* See what else is with 'dmbench data check"):
        epoch()
    batches.close()


@pytest.mark.parametrize("budget", ["25%", "100%", "17", "3"])
def test_the_budget_pays_for_the_triplets_that_it_pays_for_in_the_cache(walks, budget) -> None:
    streamed, cached = (LabelBudget(walks, LabelRequest.parse(budget), 0) for _ in range(2))
    part, actions = streamed.streamed_actions(_streamed(walks))
    paid = cached.actions(TripletSet.of_split(walks, "train"), "training")
    np.testing.assert_array_equal(part.places(np.arange(len(part))), [paid.triplets.episode, paid.triplets.step])
    episodes, steps = part.places(np.arange(len(part)))
    assert [actions(one)[at] for one, at in zip(episodes, steps, strict=True)] == paid.actions.tolist()
    assert streamed.given == cached.given


def test_the_random_order_has_every_triplet_once_and_begins_like_one_that_is_broken_off(walks) -> None:
    triplets = StreamedTriplets.of_split(walks, "train", window=8)
    order = list(triplets.shuffled(np.random.default_rng(1)))
    assert sorted(order) == list(range(len(triplets)))
    assert order != sorted(order)
    begun = triplets.shuffled(np.random.default_rng(1))
    assert [next(begun) for _ in range(5)] == order[:5]
    assert list(triplets.shuffled(np.random.default_rng(2))) != order


def test_validation_is_that_of_the_cache_and_is_decoded_once(walks, tmp_path, monkeypatch) -> None:
    def parts(window: int) -> tuple:
        data = training_data(_run(walks, tmp_path / f"run-{window}", f"window={window}"), walks)
        config = TrainingConfig(epochs=1, batch_size=8, window=window)
        return parts_of((Phase(),), data, config, seed=0, device=torch.device("cpu"))

    monkeypatch.setattr("dmotion_bench.learning.data.curriculum.VALIDATION_TRIPLETS", 9)
    (cached,), (streamed,) = parts(0), parts(24)
    assert len(streamed.validation) == 9
    ours, theirs = (part.validation(np.arange(9)) for part in (streamed, cached))
    for name in ("previous", "current", "next", "episode"):
        torch.testing.assert_close(getattr(ours, name), getattr(theirs, name))
    opened = list[int]()
    read = Dataset.video
    monkeypatch.setattr(Dataset, "video", lambda *given: opened.append(given[1]) or read(*given))
    parts(24)[0].validation(np.arange(9))
    assert not opened


def test_the_video_that_is_clustered_is_of_the_training_or_where_streamed_of_the_validation(walks, tmp_path) -> None:
    cached, streamed = (
        training_data(_run(walks, tmp_path / f"run-{window}", f"window={window}"), walks) for window in (0, 24)
    )
    some = video_sample(cached, 5)
    assert len(some) == 5
    assert {*some.episode.tolist()} <= {*walks.split("train").tolist()}
    np.testing.assert_array_equal(video_sample(streamed, 5).episode, held_for_validation(streamed).episode)


def _run(walks: Dataset, folder: Path, *settings: str, **request) -> Run:
    asked = TrainingRequest(
        model="dmotion", settings=("batch_size=4", "epochs=0.4", "validations=3", *settings), **request
    )
    return open_run(asked, walks, folder, Workspace(folder))


def _train(run: Run, walks: Dataset, stop_at: int | None = None, loaders: int | None = None) -> None:
    def on_step(report: StepReport) -> None:
        if report.step == stop_at:
            raise Stopped

    train(run, training_data(run, walks, loaders), launch("cpu"), on_step)


@pytest.mark.slow
def test_a_run_that_is_killed_in_an_epoch_ends_with_the_same_bits(uncached, tmp_path, monkeypatch) -> None:
    """Other numbers of loaders, half of each batch drawn by losses, and no cache of the data set."""
    settings = ("window=24", "hard_share=0.5", "epochs=1.6", "validations=4", "precision=float32")
    whole = _run(uncached, tmp_path / "whole", *settings)
    _train(whole, uncached)
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
    for stop_at, loaders in ((5, 1), (33, 3), (61, 2)):
        with pytest.raises(Stopped):
            _train(_run(uncached, tmp_path / "run", *settings), uncached, stop_at, loaders)
    _train(_run(uncached, tmp_path / "run", *settings), uncached)
    assert Run.open(tmp_path / "run").result["weights"] == Run.open(tmp_path / "whole").result["weights"]
    assert not uncached.cache_file.path.exists()


@pytest.mark.slow
def test_two_processes_read_a_half_each_and_learn_the_weights_of_one(recorded, tmp_path) -> None:
    """Of 1e-9 in float64, as where the frames are in the cache."""
    for world in (1, 2):
        together(world, train_exact, recorded, tmp_path / f"{world}", EXACT)
    alone, shared = (checkpoint.load(tmp_path / f"{world}" / "last.safetensors", required=None)[0] for world in (1, 2))
    assert alone.keys() == shared.keys()
    for name, tensor in alone.items():
        atol = 1e-6 if name.startswith("hardness") else 1e-9
        torch.testing.assert_close(shared[name], tensor, rtol=0, atol=atol, equal_nan=True)


def test_data_that_fit_nowhere_are_streamed_with_a_word(uncached, tmp_path, monkeypatch, caplog) -> None:
    assert _run(uncached, tmp_path / "fits").spec.training["window"] == 0
    monkeypatch.setattr("shutil.disk_usage", lambda _: shutil._ntuple_diskusage(1 << 40, 1 << 40, 1000))
    with caplog.at_level(logging.WARNING, "dmotion_bench"):
        run = _run(uncached, tmp_path / "large")
    assert run.spec.training["window"] == WINDOW
    assert "the frames take 0.0 GiB as a cache, and" in caplog.text
    assert "reads the compressed files instead and shuffles 8,192 triplets at a time ('--stream')." in caplog.text
    assert _run(uncached, tmp_path / "asked", stream=False).spec.training["window"] == 0
    run.path.mkdir(parents=True)
    run.write()
    monkeypatch.undo()
    assert _run(uncached, tmp_path / "large").spec.training["window"] == WINDOW  # as it was begun
    assert _run(uncached, tmp_path / "given", stream=True).spec.training["window"] == WINDOW
    assert _run(uncached, tmp_path / "given", "window=7", stream=True).spec.training["window"] == 7


def test_what_contradicts_streaming_is_refused(walks, tmp_path) -> None:
    with pytest.raises(UsageError, match="'--split paper' shuffles all triplets of the data set and cannot be"):
        _run(walks, tmp_path / "run", stream=True, protocol="paper")
    with pytest.raises(UsageError, match=r"'--set window=9' is for data that are streamed; leave it out"):
        _run(walks, tmp_path / "run", "window=9", stream=False)
    with pytest.raises(UsageError, match="window is -1; it cannot be below zero"):
        _run(walks, tmp_path / "run", "window=-1")


def test_the_step_that_is_timed_reads_each_episode_once(walks, tmp_path, monkeypatch) -> None:
    run, read, video = _run(walks, tmp_path / "run", *EXACT), Counter[int](), Dataset.video

    def counted(self: Dataset, episode: int, room: Any = None) -> Any:
        read[episode] += 1
        return video(self, episode, room)

    parts = parts_of((Phase(),), training_data(run, walks), run.spec.training_config, 0, torch.device("cpu"))
    monkeypatch.setattr(Dataset, "video", counted)
    conditions._trial(run.spec, parts, torch.device("cpu"), Companions(launch("cpu")))
    parts[0].batches.close()
    assert read
    assert max(read.values()) == 1
