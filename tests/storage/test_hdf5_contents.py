"""What is found in HDF5 files that are made to be searched for ever."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pytest

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports import hdf5_contents
from dmotion_bench.storage.imports.hdf5_recording import Hdf5Recording
from dmotion_bench.storage.imports.limits import ImportLimits


def in_itself(group: h5py.Group) -> None:
    for number in range(40):
        group[f"g{number}"] = group


def by_levels(group: h5py.Group) -> None:
    for _ in range(6):
        inner = group.create_group("0")
        for number in range(1, 40):
            group[str(number)] = inner
        group = inner


@pytest.mark.parametrize("lead", [in_itself, by_levels])
def test_groups_with_many_names_are_looked_at_no_oftener_than_a_file_may_ask_for(
    lead: Callable[[h5py.Group], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each of the levels has forty names for the next one: four thousand million paths to nothing."""
    file = tmp_path / "circles.hdf5"
    with h5py.File(file, "w") as opened:
        lead(opened.create_group("data/demo_0/obs"))
    looked, own = [], hdf5_contents.own
    monkeypatch.setattr(hdf5_contents, "own", lambda *asked: looked.append(1) or own(*asked))
    with pytest.raises(RecordingImportError, match="has no pictures"):
        Hdf5Recording(file, camera=None, actions=None, source_hz=None, default_hz=10.0, limits=ImportLimits())
    assert len(looked) < 20_000


def test_data_sets_come_in_natural_order_with_those_below_them(tmp_path: Path) -> None:
    with h5py.File(tmp_path / "some.hdf5", "w") as opened:
        for name in ("b10", "b9/y", "b9/x", "a"):
            opened[name] = np.zeros(1)
        assert list(hdf5_contents.datasets(opened)) == ["a", "b9/x", "b9/y", "b10"]
