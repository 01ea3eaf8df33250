"""Recordings that are imported beside each other make the data set of recordings imported in turn."""

from __future__ import annotations

import json
import signal
import time
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import psutil
import pytest
from dmbench_command import dmbench, finish, never_ending, start_dmbench
from mortal_workers import Deadly, kill_confined_readers
from noise_world import files_of
from pretend_slurm import use_slurm
from storage.foreign import compressed, foxglove_compressed_file, foxglove_file, steady, video
from storage.foreign_video import video_file

from dmotion_bench.errors import DatasetCorrupt, DatasetError, RecordingImportError
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.recording import fleet, surveys
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Recording
from dmotion_bench.storage.imports.search import sources_in
from dmotion_bench.storage.imports.sources import Kind, Source
from dmotion_bench.storage.shard import ShardReceipt, shard_range, write_shard

OPTIONS = ImportOptions(size=16, frames_per_episode=5)
COUNT = 30


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Files of 10 to 39 frames: 135 episodes in seven shards."""
    folder = tmp_path_factory.mktemp("recordings")
    for number in range(COUNT):
        count = 10 + number
        foxglove_file(folder / f"{number:02d}.mcap", video(count, seed=number), steady(count))
    return folder


@pytest.fixture(scope="module")
def in_turn(recordings: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    out = tmp_path_factory.mktemp("in_turn") / "d"
    import_recordings([recordings], out, OPTIONS)
    return files_of(out)


@pytest.fixture
def spoilt(recordings: Path, tmp_path: Path) -> Path:
    """A copy with a file cut short, one of no bytes, one of other proportions, and one with a broken picture."""
    folder = tmp_path / "spoilt"
    folder.mkdir()
    for path in recordings.glob("*.mcap"):
        (folder / path.name).write_bytes(path.read_bytes())
    whole = (folder / "03.mcap").read_bytes()
    (folder / "03.mcap").write_bytes(whole[: len(whole) // 2])
    (folder / "07.mcap").write_bytes(b"")
    for name in ("11.mcap", "20.mcap"):
        (folder / name).unlink()
    foxglove_file(folder / "11.mcap", video(9, 20, 24), steady(9))
    foxglove_file(folder / "20.mcap", [*video(9), np.zeros((32, 31, 3), np.uint8)], steady(10))
    return folder


def _sound(recordings: Path) -> list[Path]:
    spoilt = ("03.mcap", "07.mcap", "11.mcap", "20.mcap")
    return [path for path in sorted(recordings.glob("*.mcap")) if path.name not in spoilt]


@pytest.fixture(params=["serial", "local", "slurm"])
def deadly(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Executor | None:
    """None, and executors in which a worker is killed."""
    if request.param == "serial":
        return None
    monkeypatch.setenv("PYTHONPATH", str(Path(__file__).parent.parent))
    if request.param == "slurm":
        use_slurm(tmp_path / "slurm", monkeypatch)
    return Deadly(make_executor(request.param, 2, tmp_path / "scratch"), tmp_path / "died")


@pytest.mark.slow
def test_a_machine_with_another_version_of_a_package_makes_no_shard(recordings: Path, tmp_path: Path) -> None:
    with (
        patch("dmotion_bench.storage.writer.versions", lambda _: {"numpy": "0.1"}),
        pytest.raises(DatasetError, match=r"has numpy .*, and the data set is made with numpy 0\.1; install the same"),
    ):
        import_fleet([recordings], tmp_path / "d", OPTIONS)
    assert not list(tmp_path.rglob("shard-*"))


@pytest.mark.slow
def test_whoever_imports_them_the_bytes_are_the_same(
    recordings: Path,
    in_turn: dict[str, bytes],
    tmp_path: Path,
    deadly: Executor | None,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(fleet, "MOST_PARTS", 3)
    told: list[tuple[str, int, int]] = []
    report = import_fleet(
        [recordings], tmp_path / "d", OPTIONS, deadly, progress=lambda *one: told.append(one), jobs=tmp_path
    )
    assert files_of(tmp_path / "d") == in_turn
    assert deadly is None or (tmp_path / "died").exists()
    assert report == import_recordings([recordings], tmp_path / "d", OPTIONS)
    assert told[0] == ("looking through the recordings", 0, COUNT)
    assert told[-1] == ("importing", report.episodes, report.episodes)
    assert not list(tmp_path.glob("*.json")) + list(tmp_path.glob("*.importing"))


@pytest.mark.slow
def test_damaged_recordings_are_left_out_as_if_they_had_not_been_named(
    spoilt: Path, recordings: Path, tmp_path: Path
) -> None:
    import_recordings(_sound(recordings), tmp_path / "sound", OPTIONS)
    report = import_fleet([spoilt], tmp_path / "d", OPTIONS, skip_damaged=True)
    assert files_of(tmp_path / "d") == files_of(tmp_path / "sound")
    assert [Path(path).name for path, _ in report.skipped] == ["03.mcap", "07.mcap", "11.mcap", "20.mcap"]
    for (path, why), says in zip(
        report.skipped, ("03.mcap", "07.mcap", "24x20 pixels, and 26", "20.mcap"), strict=True
    ):
        assert says in why, (path, why)
    again = import_fleet([spoilt], tmp_path / "d", OPTIONS, skip_damaged=True)
    assert again == report


@pytest.mark.slow
def test_a_decoder_that_crashes_harms_no_recording_after_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    clips, crashed = [tmp_path / f"{number}.mp4" for number in range(4)], "1.mp4"
    for number, clip in enumerate(clips):
        video_file(clip, video(20, seed=number))
    opened = surveys.open_recording

    def crashing(source: Source, options: ImportOptions, confinement: Confinement) -> Recording:
        recording = opened(source, options, confinement)
        if source.path.name == crashed:
            kill_confined_readers()
        return recording

    assert len(surveys._parts_of_sources(sources_in(clips, None))) == 1  # one decoder for all of them
    import_recordings([path for path in clips if path.name != crashed], tmp_path / "others", OPTIONS)
    monkeypatch.setattr(surveys, "open_recording", crashing)
    report = import_fleet(clips, tmp_path / "d", OPTIONS, skip_damaged=True)
    assert [Path(path).name for path, _ in report.skipped] == [crashed]
    assert files_of(tmp_path / "d") == files_of(tmp_path / "others")


def test_recordings_are_looked_through_in_parts_of_a_bounded_size(tmp_path: Path) -> None:
    sizes = (1, 2, surveys.BYTES_TOGETHER, 3, 4, *[1] * surveys.MOST_TOGETHER)
    sources = [Source(path=tmp_path / f"{number:02d}.mcap", kind=Kind.MCAP) for number in range(len(sizes))]
    for source, size in zip(sources, sizes, strict=True):
        with source.path.open("wb") as file:
            file.truncate(size)
    parts = surveys._parts_of_sources([*sources, Source(path=tmp_path, kind=Kind.PICTURES)])
    assert [number for part in parts for number in part] == list(range(len(sizes) + 1))
    assert [len(part) for part in parts] == [2, 1, surveys.MOST_TOGETHER, 2, 1]


@pytest.mark.slow
def test_damage_that_shows_when_pictures_are_unpacked_costs_one_more_pass(
    recordings: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(path: Path) -> bool:
        return path.name in ("03.mcap", "07.mcap", "11.mcap", "20.mcap")

    opened = fleet.open_recording
    passes = []

    class Broken:
        def __init__(self, recording) -> None:
            self._recording = recording

        def __getattr__(self, name: str):
            return getattr(self._recording, name)

        def pictures(self, segment: int, wanted):
            yield from self._recording.pictures(segment, wanted[:3])
            raise RecordingImportError(f"a picture of {self._recording.path.name} is damaged")

    def opening(source, *rest):
        recording = opened(source, *rest)
        return Broken(recording) if broken(source.path) else recording

    monkeypatch.setattr(fleet, "open_recording", opening)
    written = fleet._written
    monkeypatch.setattr(fleet, "_written", lambda *given: passes.append(1) or written(*given))
    with pytest.raises(RecordingImportError, match="a picture of 03"):
        import_fleet([recordings], tmp_path / "d", OPTIONS)
    assert not list(tmp_path.iterdir())
    passes.clear()
    report = import_fleet([recordings], tmp_path / "d", OPTIONS, skip_damaged=True)
    assert [Path(path).name for path, _ in report.skipped] == ["03.mcap", "07.mcap", "11.mcap", "20.mcap"]
    assert len(passes) == 2
    import_recordings(_sound(recordings), tmp_path / "sound", OPTIONS)
    assert files_of(tmp_path / "d") == files_of(tmp_path / "sound")


@pytest.mark.slow
def test_a_damaged_picture_at_the_start_of_a_shard_is_the_one_before_it(tmp_path: Path) -> None:
    options = replace(OPTIONS, frames_per_episode=3, salvage=True)
    count = 3 * 102  # 102 episodes, 50 in a shard
    pictures = [compressed(frame, "jpeg") for frame in video(count)]
    for broken in (3 * 50, 3 * 100 + 1):
        pictures[broken] = pictures[broken][:-200]
    file = foxglove_compressed_file(tmp_path / "a.mcap", pictures, steady(count), "jpeg")
    whole = import_recordings([file], tmp_path / "in_turn", options)

    first = import_fleet([file], tmp_path / "fleet", options)
    assert (first.unreadable, whole.unreadable) == (2, 2)
    assert files_of(tmp_path / "fleet") == files_of(tmp_path / "in_turn")

    written: list[int] = []

    def interrupted(*given: Any) -> ShardReceipt:
        if len(written) == 1:
            raise KeyboardInterrupt
        written.append(given[3])
        return write_shard(*given)

    with patch.object(fleet, "write_shard", interrupted), pytest.raises(KeyboardInterrupt):
        import_fleet([file], tmp_path / "again", options)
    import_fleet([file], tmp_path / "again", options)
    assert written == [0]  # the first shard stood, and the picture before the second one was unpacked all the same
    assert files_of(tmp_path / "again") == files_of(tmp_path / "in_turn")


def test_without_the_option_the_first_damaged_one_is_said(spoilt: Path, tmp_path: Path) -> None:
    with pytest.raises(RecordingImportError, match=r"07\.mcap' is empty"):  # which shows before any is read
        import_fleet([spoilt], tmp_path / "d", OPTIONS)
    (spoilt / "07.mcap").unlink()
    with pytest.raises(RecordingImportError, match=r"03\.mcap"):
        import_fleet([spoilt], tmp_path / "d", OPTIONS)
    with pytest.raises(RecordingImportError, match="none of the 1 recordings can be imported; the first one"):
        import_fleet([spoilt / "03.mcap"], tmp_path / "d", OPTIONS, skip_damaged=True)
    assert not (tmp_path / "d").exists()


@pytest.mark.slow
def test_an_interrupted_import_goes_on(recordings: Path, in_turn: dict[str, bytes], tmp_path: Path) -> None:
    words = ("data", "import", str(recordings), "--size", "16", "--frames-per-episode", "5", "--out")
    process = start_dmbench((*words, str(tmp_path / "d"), "--workers", "2"), tmp_path)
    content = tmp_path / "d.importing" / "content"
    while not list(content.glob("video/*.mcap")):
        assert process.poll() is None, process.communicate()
        time.sleep(0.002)
    children = psutil.Process(process.pid).children(recursive=True)
    process.send_signal(signal.SIGINT)
    outcome = finish(process)
    assert outcome.code == 130
    assert "Run the same command again to go on where it stopped." in outcome.sentence()
    assert not never_ending(children)
    kept = {path: path.stat().st_ino for path in content.glob("video/*.mcap")}
    assert kept
    done = finish(start_dmbench((*words, str(tmp_path / "d"), "--workers", "2", "--json"), tmp_path))
    assert done.code == 0, done.err
    assert files_of(tmp_path / "d") == in_turn
    found = {path.name: path.stat().st_ino for path in (tmp_path / "d" / "video").glob("*.mcap")}
    assert {path.name: number for path, number in kept.items()}.items() <= found.items()  # not written anew


@pytest.mark.slow
def test_the_command_names_what_it_leaves_out(
    spoilt: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ("data", "import", str(spoilt), "--size", "16", "--skip-damaged", "--out", str(tmp_path / "d"))
    told = dmbench(words, capsys, monkeypatch)
    assert told.code == 0, told.err
    assert "4 recordings or episodes are left out:" in told.out
    as_json = dmbench((*words, "--json"), capsys, monkeypatch)
    assert len(json.loads(as_json.out)["skipped"]) == 4


def test_an_episode_is_found_without_reading_the_others(
    recordings: Path, in_turn: dict[str, bytes], tmp_path: Path
) -> None:
    import_recordings([recordings], tmp_path / "d", OPTIONS)
    dataset = Dataset.open(tmp_path / "d")
    wanted = dataset.video(60)
    shards = sorted((tmp_path / "d" / "video").glob("*.mcap"))
    for path in (one for number, one in enumerate(shards) if number != 60 // dataset.recipe.shard_episodes):
        content = path.read_bytes()
        third = len(content) // 3
        path.write_bytes(content[:third] + bytes(third) + content[2 * third :])
        own = shard_range(dataset.recipe, shards.index(path))
        with pytest.raises(DatasetCorrupt):
            _read(Dataset.open(tmp_path / "d"), own)
    assert np.array_equal(Dataset.open(tmp_path / "d").video(60), wanted)


def _read(dataset: Dataset, episodes: range) -> None:
    for episode in episodes:
        dataset.video(episode)
