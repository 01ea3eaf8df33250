"""A damaged episode of a recording that holds several is left out, as if it were not there."""

from __future__ import annotations

import io
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mortal_workers import kill_confined_readers
from noise_world import files_of
from PIL import Image
from storage.foreign import video

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.recording import fleet
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Recording

OPTIONS = ImportOptions(size=16, frames_per_episode=4, actions="actions")
SOUND = {f"demo_{number}": video(9, seed=number) for number in (2, 4, 6, 8, 10)}


def demonstrations(path: Path, given: Mapping[str, np.ndarray]) -> Path:
    """A file with packed pictures, whose contents are looked at only as they are unpacked."""
    path.parent.mkdir()
    with h5py.File(path, "w") as file:
        for name, frames in given.items():
            rows = file.create_dataset(f"data/{name}/obs/top", (len(frames),), h5py.vlen_dtype(np.uint8))
            for place, frame in enumerate(frames):
                Image.fromarray(frame).save(packed := io.BytesIO(), "PNG")
                rows[place] = np.frombuffer(packed.getvalue(), np.uint8)
            file[f"data/{name}/actions"] = np.stack([frames[:, 0, 0, 0], frames[:, 0, 0, 1]], 1) / 7
    return path


@pytest.fixture
def spoilt(tmp_path: Path) -> Path:
    """Damage of every kind among the demonstrations, also in the first and the last."""
    odd = {f"demo_{number}": video(9, seed=number) for number in (1, 3, 5, 7, 9)}
    path = demonstrations(tmp_path / "spoilt/a.h5", SOUND | odd | {"demo_11": video(9, 24, 24)})
    with h5py.File(path, "a") as file:
        del file["data/demo_1/obs/top"]
        file["data/demo_3/actions"][5, 1] = np.nan
        del file["data/demo_5/actions"]
        for name in ("demo_7", "demo_9"):  # the head stays whole
            file[f"data/{name}/obs/top"][6] = file[f"data/{name}/obs/top"][6][:300]
    return path


def same(one: Path, other: Path) -> None:
    """All but the recording's hash, which stands in the manifest."""
    ours, others = Dataset.open(one), Dataset.open(other)
    assert ours.spec == others.spec
    assert ours.lengths.tolist() == others.lengths.tolist()
    for episode in range(len(ours)):
        np.testing.assert_array_equal(ours.video(episode), others.video(episode))
        np.testing.assert_array_equal(ours.labels(episode).actions, others.labels(episode).actions)


@pytest.mark.slow
def test_damaged_episodes_are_left_out_as_if_they_were_not_there(
    spoilt: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fleet, "MOST_PARTS", 3)
    report = import_fleet([spoilt], tmp_path / "d", OPTIONS, skip_damaged=True)
    told = {path.rpartition("/")[2]: why for path, why in report.skipped}
    expected = {
        "demo_1": "lacks 'obs/top' in '/data/demo_1'",
        "demo_3": "nan",
        "demo_5": "lacks 'actions' in '/data/demo_5'",
        "demo_7": "picture 6 of '/data/demo_7/obs/top' is a damaged PNG file",
        "demo_9": "picture 6 of '/data/demo_9/obs/top' is a damaged PNG file",
        "demo_11": "pictures of 24x24 pixels, and 7 of the episodes have 32x32",
    }
    assert told.keys() == expected.keys()
    for name, says in expected.items():
        assert says in told[name], told[name]
    import_fleet([demonstrations(tmp_path / "sound/a.h5", SOUND)], tmp_path / "sound/d", OPTIONS)
    same(tmp_path / "d", tmp_path / "sound/d")
    two = make_executor("local", 2, tmp_path / "scratch")
    assert import_fleet([spoilt], tmp_path / "two", OPTIONS, two, skip_damaged=True).skipped == report.skipped
    assert files_of(tmp_path / "two") == files_of(tmp_path / "d")


@pytest.mark.slow
def test_an_episode_that_crashes_its_decoder_harms_none_after_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = demonstrations(tmp_path / "crash/a.h5", SOUND)
    opened = fleet.open_recording

    class Crashing:
        def __init__(self, recording: Recording) -> None:
            self._recording = recording

        def __getattr__(self, name: str) -> Any:
            return getattr(self._recording, name)

        def pictures(self, segment: int, wanted: np.ndarray) -> Iterator[np.ndarray]:
            if segment == 1:
                kill_confined_readers()
            yield from self._recording.pictures(segment, wanted)

    monkeypatch.setattr(fleet, "open_recording", lambda *given: Crashing(opened(*given)))
    report = import_fleet([path], tmp_path / "d", OPTIONS, skip_damaged=True)
    assert [name.rpartition("/")[2] for name, _ in report.skipped] == ["demo_4"]
    monkeypatch.undo()
    others = {name: frames for name, frames in SOUND.items() if name != "demo_4"}
    same(tmp_path / "d", import_fleet([demonstrations(tmp_path / "o/a.h5", others)], tmp_path / "o/d", OPTIONS).path)


def test_without_the_option_the_way_out_is_said(spoilt: Path, tmp_path: Path) -> None:
    with h5py.File(spoilt, "a") as file:
        del file["data/demo_1"]
    with pytest.raises(RecordingImportError, match=r"nan .* Leave such episodes out with '--skip-damaged'\.$"):
        import_fleet([spoilt], tmp_path / "d", OPTIONS)


@pytest.mark.slow
def test_a_recording_without_a_sound_episode_is_damaged(tmp_path: Path) -> None:
    path = demonstrations(tmp_path / "bad/a.h5", {"demo_0": video(9), "demo_1": video(9)})
    with h5py.File(path, "a") as file:
        for name in ("demo_0", "demo_1"):
            file[f"data/{name}/actions"][0] = np.inf
    other = demonstrations(tmp_path / "good/b.h5", SOUND)
    report = import_fleet([path, other], tmp_path / "d", OPTIONS, skip_damaged=True)
    assert [Path(one).name for one, _ in report.skipped] == ["a.h5"]
    assert "none of the 2 episodes can be imported; the first one: " in report.skipped[0][1]
    same(tmp_path / "d", import_fleet([other], tmp_path / "other", OPTIONS).path)
