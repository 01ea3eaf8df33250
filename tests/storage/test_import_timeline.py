"""Resampling: invariants over any times, and the cases that robots really have."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.timeline import Piece, cut, interval_ns, resample

ANY_TIMES = st.lists(st.integers(0, 20_000_000_000), min_size=1, max_size=60).map(lambda ts: np.array(sorted(ts)))


def frames_of(times: np.ndarray, hz: float, max_gap_s: float | None = None) -> list[list[int]]:
    return [piece.frames.tolist() for piece in resample(times, hz=hz, max_gap_s=max_gap_s, most=10**6)]


@given(times=ANY_TIMES, hz=st.sampled_from([1.0, 7.0, 10.0, 30.0]), gap=st.none() | st.floats(0.05, 3))
@settings(deadline=None, derandomize=True, max_examples=200)
def test_each_tick_shows_the_latest_frame(times: np.ndarray, hz: float, gap: float | None) -> None:
    slack = int(interval_ns(times) / 4)
    pieces = resample(times, hz=hz, max_gap_s=gap, most=10**6)
    for piece in pieces:
        assert np.abs(np.diff(piece.t_ns) - 1e9 / hz).max(initial=0) <= 1
        assert (times[piece.frames] <= piece.t_ns + slack).all()
        newest = np.searchsorted(times, piece.t_ns + slack, side="right") - 1
        ends = np.flatnonzero(times == times[piece.frames[-1]])[-1]
        assert (piece.frames == np.minimum(newest, ends)).all()
    assert all(before.t_ns[-1] < after.t_ns[0] for before, after in itertools.pairwise(pieces))


def test_jitter_neither_repeats_nor_drops() -> None:
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 50)
    times = np.rint((np.arange(50) * 0.1 + jitter + 1) * 1e9).astype(np.int64)
    times[0] = 1_000_000_000
    assert frames_of(times, 10) == [list(range(50))]


def test_thirty_hertz_read_at_ten_is_every_third() -> None:
    for interval in (33_333_333, 33_333_334):
        assert frames_of(np.arange(301) * interval, 10)[0][:100] == list(range(0, 300, 3))


def test_a_slower_camera_is_repeated() -> None:
    assert frames_of(np.arange(4) * 200_000_000, 10) == [[0, 0, 1, 1, 2, 2, 3]]


def test_a_dropped_frame_ends_no_episode_and_a_pause_does() -> None:
    times = np.delete(np.arange(30) * 100_000_000, [5, 15, 16, 17])
    assert frames_of(times, 10) == [[0, 1, 2, 3, 4, 4, *range(5, 14)], list(range(14, 26))]
    assert len(frames_of(times, 10, max_gap_s=0.15)) == 3


def test_more_frames_than_allowed_are_refused_before_they_are_made() -> None:
    with pytest.raises(RecordingImportError, match="lower '--hz'"):
        resample(np.array([0, 2**62]), hz=1000, max_gap_s=1e12, most=10**6)


@given(lengths=st.lists(st.integers(1, 400), max_size=5), longest=st.integers(3, 120))
@settings(deadline=None, derandomize=True)
def test_cutting_makes_equal_parts(lengths: list[int], longest: int) -> None:
    pieces = [Piece(frames=np.arange(length), t_ns=np.arange(length)) for length in lengths]
    parts = cut(pieces, longest=longest, shortest=1)
    assert sum(map(len, parts)) == sum(lengths)
    assert all(len(part) <= longest for part in parts)
    if parts and len(lengths) == 1:
        assert max(map(len, parts)) - min(map(len, parts)) <= 1
