"""The last command of a recording leads to no picture: it may be empty, and only it, in every format."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from storage.continuous_recordings import TWIST, imported, json_file, refused, twists
from storage.foreign import video
from storage.hdf5_files import robomimic
from storage.lerobot_sets import LENGTHS, v3

from dmotion_bench.storage.imports.options import ImportOptions

LEROBOT = ImportOptions(size=32, actions="action", action_fields=("action.0", "action.1"))
HDF5 = ImportOptions(size=32, actions="actions")
NOTHING = [[1.0, np.nan], [np.inf, 0.0], [None, 1.0], [], None]
"""Rows of two numbers that hold no command."""


def lerobot(folder: Path, empty: Sequence[int], nothing: Any) -> Path:
    """A data set whose actions count its rows; those with some numbers hold something else."""
    file = v3(folder, video(sum(LENGTHS))) / "data/chunk-000/file-000.parquet"
    rows = [nothing if row in empty else [float(row), -float(row)] for row in range(sum(LENGTHS))]
    table = parquet.read_table(file)
    column = pa.array(rows, pa.list_(pa.float32()))
    parquet.write_table(table.set_column(table.column_names.index("action"), "action", column), file)
    return folder


@pytest.mark.parametrize("nothing", NOTHING)
def test_the_last_row_of_a_lerobot_episode(tmp_path: Path, nothing: Any) -> None:
    ends = [sum(LENGTHS[: one + 1]) for one in range(3)]
    dataset = imported(lerobot(tmp_path / "a", [end - 1 for end in ends], nothing), tmp_path / "out", LEROBOT)
    assert dataset.lengths.tolist() == LENGTHS
    for number, end in enumerate(ends):
        expected = np.arange(end - LENGTHS[number], end - 1)
        np.testing.assert_array_equal(dataset.states(number).actions, np.stack([expected, -expected], axis=1))
    said = "lacks numbers|different numbers|a command must be finite"
    refused(lerobot(tmp_path / "b", [ends[1] - 2], nothing), said, LEROBOT)
    refused(lerobot(tmp_path / "c", [ends[1] - 1, ends[1] - 2], nothing), said, LEROBOT)


def test_the_last_row_of_an_hdf5_demonstration(tmp_path: Path) -> None:
    def file(name: str, rows: int, empty: int) -> Path:
        numbers = np.arange(2.0 * rows).reshape(rows, 2)
        numbers[empty, 1] = np.nan
        return robomimic(tmp_path / name, {"demo_0": video(5)}, actions={"demo_0": numbers})

    dataset = imported(file("a.hdf5", 5, 4), tmp_path / "out", HDF5)
    np.testing.assert_array_equal(dataset.states(0).actions, [[0, 1], [2, 3], [4, 5], [6, 7]])
    refused(file("b.hdf5", 5, 3), r"holds 'actions.1' = nan in command 3; a command must be finite", HDF5)
    refused(file("c.hdf5", 4, 3), "holds 'actions.1' = nan in command 3", HDF5)  # it leads to the last picture


def test_a_last_row_without_a_choice(tmp_path: Path) -> None:
    def file(name: str, words: list[str]) -> Path:
        return robomimic(tmp_path / name, {"demo_0": video(4)}, actions={"demo_0": words})

    dataset = imported(file("a.hdf5", ["up", "down", "up", ""]), tmp_path / "out", HDF5)
    assert dataset.states(0).actions.tolist() == [1, 0, 1]
    refused(file("b.hdf5", ["up", "", "up", "up"]), "holds '', a measurement and no choice out of a few", HDF5)


def test_a_message_after_the_last_picture(tmp_path: Path) -> None:
    """As a controller sends it that is shut down."""
    dataset = imported(twists(tmp_path / "a", [0.5, 1.0, 2.0, np.nan], delay_ns=100_000_000), tmp_path / "out")
    assert dataset.states(0).actions[:, 0].tolist() == [0.5, 1.0, 2.0]
    between = twists(tmp_path / "b", [0.5, 1.0, np.nan, np.nan], delay_ns=100_000_000)
    refused(between, "message 2 on '/cmd_vel' holds 'linear.x' = nan; a command must be finite; cut the recording")

    words = dataclasses.replace(TWIST, action_fields=())
    choices = [{"action": name} for name in ("up", "down", "up", "down", None)]
    assert imported(json_file(tmp_path / "c.mcap", choices, 5), tmp_path / "words", words).lengths.tolist() == [5]
    refused(
        json_file(tmp_path / "d.mcap", choices, 6), "message 4 on '/cmd_vel' holds nothing, which is no choice", words
    )


def test_messages_before_the_first_command(tmp_path: Path) -> None:
    """As a controller sends them that is not in charge yet: nothing is commanded until the first number."""
    dataset = imported(twists(tmp_path / "a", [np.nan, np.nan, 2.0, 3.0, 4.0]), tmp_path / "out")
    assert dataset.states(0).actions[:, 0].tolist() == [2.0, 3.0, 4.0]
    np.testing.assert_array_equal(dataset.video(0), video(6)[2:])
    refused(twists(tmp_path / "b", [np.nan, 1.0, np.nan, 3.0]), "message 2 on '/cmd_vel' holds 'linear.x' = nan")


def test_no_message_holds_a_command(tmp_path: Path) -> None:
    empty = twists(tmp_path / "a", [np.nan] * 3, delay_ns=1_000_000_000)
    refused(empty, "message 0 on '/cmd_vel' holds 'linear.x' = nan")
    none = json_file(tmp_path / "b.mcap", [{"action": ""}] * 3)
    refused(none, "message 0 on '/cmd_vel' holds nothing, which", dataclasses.replace(TWIST, action_fields=()))


def test_a_demonstration_of_one_picture_has_no_command(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "a.hdf5", "w") as file:
        for name, count in (("demo_0", 4), ("demo_1", 1)):
            file.create_dataset(f"data/{name}/obs/top", data=video(count))
            file.create_dataset(f"data/{name}/actions", data=np.zeros((count - 1, 2)))
    long = dataclasses.replace(HDF5, min_frames=5)
    refused(
        tmp_path / "a.hdf5", "no episode of at least 5 frames .* allow shorter episodes with '--min-frames 3'", long
    )
