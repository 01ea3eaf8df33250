"""Resampling: invariants over any times, and the cases that robots really have."""

from __future__ import annotations

import itertools
import math
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.commands import ContinuousCommands, DiscreteCommands
from dmotion_bench.storage.imports.imported_actions import step_actions
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import steady_times
from dmotion_bench.storage.imports.timeline import (
    ROUNDED_NS,
    Piece,
    cut,
    interval_ns,
    irregularity,
    length_for,
    resample,
)

ANY_TIMES = st.lists(st.integers(0, 20_000_000_000), min_size=1, max_size=60).map(lambda ts: np.array(sorted(ts)))


def frames_of(times: np.ndarray, hz: float, max_gap_s: float | None = None) -> list[list[int]]:
    return [piece.frames.tolist() for piece in resample(times, hz=hz, max_gap_s=max_gap_s, most=10**6)]


@pytest.mark.slow
@given(times=ANY_TIMES, hz=st.sampled_from([1.0, 7.0, 10.0, 30.0]), gap=st.none() | st.floats(0.05, 3))
@settings(deadline=None, derandomize=True, max_examples=200)
def test_each_tick_shows_the_latest_frame(times: np.ndarray, hz: float, gap: float | None) -> None:
    slack = int(min(interval_ns(times) / 4, 0.5e9 / hz)) + ROUNDED_NS
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


STEADY = pytest.mark.parametrize(
    ("rate", "hz"), [(30, 15), (60, 30), (60, 15), (30, 24), (60, 48), (80, 30), (59.94, 29.97), (30, 7.5), (50, 20)]
)


@STEADY
def test_a_frame_at_the_edge_is_on_the_same_side_at_every_tick(rate: float, hz: float) -> None:
    (piece,) = resample(steady_times(200, rate, Path("a")), hz=hz, max_gap_s=None, most=10**6)
    exact = (Fraction(k) * Fraction(str(rate)) / Fraction(str(hz)) for k in range(len(piece)))
    assert piece.frames.tolist() == [min(math.floor(tick + Fraction(1, 4)), 199) for tick in exact]


@STEADY
@pytest.mark.parametrize("rounded_to_ns", [1, 1000])
def test_a_command_halfway_counts_for_the_same_step_everywhere(rate: float, hz: float, rounded_to_ns: int) -> None:
    """The command of a step is the last one up to its middle, as computed without rounding."""
    times = (np.rint(steady_times(200, rate, Path("a")) / rounded_to_ns) * rounded_to_ns).astype(np.int64)
    (piece,) = resample(times, hz=hz, max_gap_s=None, most=10**6)
    ratio = Fraction(str(rate)) / Fraction(str(hz))
    expected = [math.floor(ratio * Fraction(2 * step + 1, 2)) for step in range(len(piece) - 1)]

    names = [str(number) for number in range(200)]
    discrete = DiscreteCommands(times_ns=times, names=names)
    assert step_actions(piece, discrete, tuple(names), ImportOptions()).tolist() == expected
    continuous = ContinuousCommands(times_ns=times, values=np.arange(200.0)[:, None], names=("v",))
    assert step_actions(piece, continuous, (), ImportOptions())[:, 0].tolist() == expected


def test_a_slower_camera_is_repeated() -> None:
    assert frames_of(np.arange(4) * 200_000_000, 10) == [[0, 0, 1, 1, 2, 2, 3]]


def test_pictures_far_apart_are_not_repeated_without_end() -> None:
    days = np.arange(4) * 100_000 * 10**9
    assert frames_of(days, 1) == [[0], [1], [2], [3]]
    assert sum(map(len, frames_of(days, 1, max_gap_s=200_000))) == 300_001


def test_a_slow_camera_s_dropped_frame_is_bridged_for_twenty_ticks() -> None:
    seconds = np.array([0, 1, 2, 4, 5, 8, 9]) * 10**9
    assert [len(piece) for piece in frames_of(seconds, 10)] == [51, 11]


def test_bursts_are_less_regular_than_jitter_and_pauses_alike_on_both_clocks() -> None:
    jitter = np.random.default_rng(0).uniform(-0.02, 0.02, 200)
    assert irregularity(np.sort(np.rint((np.arange(200) * 0.1 + jitter) * 1e9).astype(np.int64))) < 0.3
    for burst in (2, 3, 10):
        times = np.arange(200) // burst * burst * 100_000_000 + np.arange(200) % burst * 1_000_000
        assert irregularity(times) > 0.9
    assert irregularity(np.array([5])) == 0
    assert irregularity(np.array([5, 5, 5])) == np.inf


@pytest.mark.slow
@given(
    lengths=st.lists(st.integers(1, 60), min_size=1, max_size=5),
    episodes=st.integers(1, 12),
    shortest=st.integers(3, 6),
)
@settings(deadline=None, derandomize=True)
def test_the_length_for_so_many_episodes_is_the_longest(lengths: list[int], episodes: int, shortest: int) -> None:
    pieces = [Piece(frames=np.arange(length), t_ns=np.arange(length)) for length in lengths]
    enough = [n for n in range(shortest, 61) if len(cut(pieces, longest=n, shortest=shortest)) >= episodes]
    assert length_for(pieces, episodes=episodes, shortest=shortest, most=60) == (max(enough) if enough else None)


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
