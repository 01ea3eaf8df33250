"""What is echoed is short and printable, what is to be typed can be pasted."""

from __future__ import annotations

import math
import pickle
import shlex
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dmotion_bench.errors import DatasetCorrupt, DmbenchError, UnknownName
from dmotion_bench.wording import SENTENCE_LIMIT, command, duration, durations, rounded, shown
from leaderboard.columns import number


@pytest.mark.slow
@settings(deadline=None, derandomize=True, max_examples=200)
@given(words=st.lists(st.text(min_size=1), min_size=1))
def test_a_command_is_read_by_a_shell_as_it_was_meant(words: list[str]) -> None:
    quoted = command("dmbench view", *words)
    assert quoted[0] == quoted[-1]
    assert shlex.split(quoted[1:-1]) == ["dmbench", "view", *words]


def test_a_plain_command_looks_plain() -> None:
    assert command("dmbench data check", Path("data/a")) == "'dmbench data check data/a'"
    assert command("dmbench view", "my data") == "\"dmbench view 'my data'\""


@pytest.mark.parametrize(
    "value",
    ["x" * 600_000, ["y" * 600_000], 10**5000, {"a": list(range(100_000))}],
    ids=["text", "list", "number", "object"],
)
def test_a_value_is_shown_shortly(value: object) -> None:
    assert len(shown(value)) < 300
    assert shown("cwsm") == "'cwsm'"


def test_a_sentence_stays_short_and_keeps_its_advice() -> None:
    error = DatasetCorrupt(f"{'x' * 60_000!r} is damaged; see 'dmbench data check'.")
    assert len(str(error)) < SENTENCE_LIMIT + 50
    assert str(error).endswith("see 'dmbench data check'.")
    assert len(str(UnknownName("model", "m" * 60_000, ["n" * 60_000] * 50))) < SENTENCE_LIMIT + 50
    assert str(pickle.loads(pickle.dumps(error))) == str(error)


def test_what_would_move_a_terminal_is_written_out() -> None:
    assert str(DmbenchError("a\x1b[2Jb\ud800\n c")) == "a\\x1b[2Jb\\ud800\n c"


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (None, ""),
        (0.48, "0.480"),
        (7, "7.00"),
        (9.996, "10.0"),
        (-13.72, "-13.7"),
        (99.96, "100"),
        (1883.2, "1,883"),
        (1_234_567.8, "1,234,568"),
        (-0.00012345, "-0.000123"),
        (-0.00004, "0"),
        (0, "0"),
        (math.nan, "nan"),
        (-math.inf, "-inf"),
    ],
)
def test_a_figure_has_three_digits_in_the_terminal_and_on_the_page(value: float | None, text: str) -> None:
    assert rounded(value) == text
    assert number(value) == text.replace("-", "\u2212")


def test_an_object_that_cannot_be_shown_is_told_by_its_kind() -> None:
    class Half:
        def __repr__(self) -> str:
            raise AttributeError("no attribute '_modules'")

    assert shown(Half()) == "a Half"


@pytest.mark.parametrize(
    ("seconds", "text"),
    [
        (0, "0 s"),
        (1e-9, "0.001 µs"),
        (0.00025, "250 µs"),
        (0.5, "0.5 s"),
        (8 / 15, "0.533 s"),
        (59.2, "59.2 s"),
        (100, "100 s"),
        (-2, "-2 s"),
        (3600.0333, "3,600 s"),
        (18_446_744_073.7, "18,446,744,074 s"),
    ],
)
def test_times_are_written_as_people_read_them(seconds: float, text: str) -> None:
    assert duration(seconds) == text


def test_a_range_of_times_is_one_where_both_ends_read_the_same() -> None:
    assert durations(0.6, 1.1) == "0.6 to 1.1 s"
    assert durations(0.0005, 1.1) == "500 µs to 1.1 s"
    assert durations(3599.9, 3600.1) == "3,600 s"
