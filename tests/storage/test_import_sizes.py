"""Recordings whose pictures have several sizes, and what goes together."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
from storage.foreign import foxglove_file, steady, video

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.fitting import Fit, fitted
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.picture_sizes import Size, have_one_shape

OPTIONS = ImportOptions(size=16)


def files(folder: Path, sizes: Sequence[Size]) -> list[Path]:
    """A recording of each width and height."""
    return [
        foxglove_file(folder / f"{number}.mcap", video(4, height, width, seed=number), steady(4))
        for number, (width, height) in enumerate(sizes)
    ]


@pytest.mark.parametrize(
    ("one", "other", "have"),
    [
        ((640, 480), (320, 240), True),
        ((640, 480), (213, 160), True),  # a third, rounded
        ((1280, 720), (854, 480), True),
        ((1920, 1080), (1920, 1080), True),
        ((1920, 1080), (1920, 1088), False),
        ((640, 480), (640, 360), False),
        ((64, 48), (48, 64), False),
        ((64, 48), (80, 62), False),
    ],
)
def test_one_shape(one: Size, other: Size, have: bool) -> None:
    assert have_one_shape(one, other) == have_one_shape(other, one) == have


@pytest.mark.parametrize("fit", list(Fit))
def test_sizes_of_one_shape_are_imported_together_and_listed(tmp_path: Path, fit: Fit) -> None:
    found = files(tmp_path, [(32, 24), (64, 48), (32, 24)])
    report = import_recordings(found, tmp_path / "out", ImportOptions(size=16, fit=fit))
    told = "the recordings have pictures of 2 sizes, 32x24 (2), 64x48 (1), and all become frames of 16x16 pixels"
    assert report.advice[0].startswith(told)
    dataset = Dataset.open(report.path)
    for number, (height, width) in enumerate([(24, 32), (48, 64), (24, 32)]):
        pictures = video(4, height, width, seed=number)
        np.testing.assert_array_equal(dataset.video(number), [fitted(one, 16, fit) for one in pictures])


def test_one_size_is_not_told_of(tmp_path: Path) -> None:
    report = import_recordings(files(tmp_path, [(32, 24)] * 2), tmp_path / "out", OPTIONS)
    assert not any("sizes" in told for told in report.advice)


def test_another_shape_is_refused_or_left_out(tmp_path: Path) -> None:
    found = files(tmp_path, [(40, 24), (32, 24), (64, 48), (32, 24)])
    match = r"different proportions: 32x24 pixels in '.*1\.mcap', 40x24 in '.*0\.mcap'; .* with '--skip-damaged'"
    with pytest.raises(RecordingImportError, match=match):
        import_recordings(found, tmp_path / "out", OPTIONS)
    report = import_fleet(found, tmp_path / "out", OPTIONS, skip_damaged=True)
    assert report.episodes == 3
    ((path, why),) = report.skipped
    assert path == str(found[0])
    assert why.endswith("of 40x24 pixels, and 2 of the recordings have 32x24, which are other proportions.")
