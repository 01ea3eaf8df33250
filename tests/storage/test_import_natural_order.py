"""Names with numbers are put into the order that people mean."""

from __future__ import annotations

import random
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.storage.imports.natural_order import in_natural_order


def ordered(names: list[str]) -> list[str]:
    return [path.name for path in in_natural_order(map(Path, names), may_be_times=True)]


@pytest.mark.parametrize(
    "names",
    [
        ["img2.png", "img9.png", "img10.png"],
        ["episode9", "episode10", "episode11"],
        [f"{1_305_031_102 + number / 30:.6f}.png" for number in range(60)],
        [f"{number / 16}.png" for number in range(40)],  # 0.0, 0.0625, 0.125 ...
        ["1699999999.9876543.jpg", "1700000000.0.jpg", "1700000000.1.jpg", "1700000000.12345.jpg"],
        [f"{run}.{number}.png" for run in (1, 2, 10) for number in range(1, 21)],
        [f"1305031102.{nanoseconds}.png" for nanoseconds in (5000, 33_000_000, 166_000_000)],
        [f"{1_305_031_102 + tick // 10}.{4567 + tick % 10 * 100_001_110}.png" for tick in range(25)],  # by ROS
        [f"9999999999.{nanoseconds}.png" for nanoseconds in (4567, 100_000_001, 200_000_001)],
        [f"1305031102.{tick * 62_500_001:09d}".rstrip("0") + ".png" for tick in range(1, 16)],
        ["4.png", "4.5.png", "5.png", "overview.png"],
        ["v1.5.png", "v1.25.png"],
    ],
)
def test_the_order_is_the_one_that_is_meant(names: list[str]) -> None:
    shuffled = random.Random(0).sample(names, len(names))
    assert ordered(shuffled) == names


def test_a_point_in_the_name_of_a_folder_or_recording_divides_whole_numbers() -> None:
    names = ["2024.9", "2024.11", "2025.1"]
    assert [path.name for path in in_natural_order(map(Path, reversed(names)))] == names


def test_every_time_of_python_s_clock_is_in_order() -> None:
    random_times = random.Random(1)
    times = sorted(1_700_000_000 + random_times.uniform(0, 20) for _ in range(500))
    assert ordered([f"{time}.png" for time in reversed(times)]) == [f"{time}.png" for time in times]


@settings(deadline=None, derandomize=True)
@given(names=st.lists(st.text("01.5ap", min_size=1).filter(lambda name: name.strip(".")), unique=True, max_size=12))
def test_names_of_all_kinds_have_one_order(names: list[str]) -> None:
    assert ordered(ordered(names)) == ordered(list(reversed(names))) == ordered(sorted(names))
