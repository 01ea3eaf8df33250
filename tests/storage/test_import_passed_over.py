"""What lies beside the recordings and is not imported is told; what is imported does not change by it."""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from storage.foreign import compressed, foxglove_file, steady, video
from storage.foreign_video import video_file

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports import passed_over
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport

OPTIONS = ImportOptions(size=16, source_hz=10)
BY_TIMES = ImportOptions(size=16)
"""Of recordings that say when their pictures were taken."""
COUNT = 10


@pytest.fixture
def root(tmp_path: Path) -> Path:
    (tmp_path / "root").mkdir()
    return tmp_path / "root"


def mcap(path: Path, seed: int = 0) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    return foxglove_file(path, video(6, seed=seed), steady(6 + 6 * seed)[-6:])


def pictures(folder: Path, seed: int = 0, count: int = 6) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    for number, frame in enumerate(video(count, seed=seed)):
        (folder / f"{number}.png").write_bytes(compressed(frame, "png"))
    return folder


def imported(root: Path, options: ImportOptions = OPTIONS, paths: list[Path] | None = None) -> ImportReport:
    return import_recordings([root] if paths is None else paths, root.parent / "out", options)


def told(root: Path, options: ImportOptions = OPTIONS) -> str:
    """What is told of a folder; the data set has only its ten good episodes."""
    report = imported(root, options)
    assert report.episodes == COUNT
    return " ".join(report.advice)


def episodes(root: Path, make: Callable[[Path, int], Path], name: str = "ep{}") -> None:
    for number in range(COUNT):
        make(root / name.format(number), number)


def test_nothing_is_told_of_what_is_imported_as_a_whole(root: Path) -> None:
    episodes(root, pictures)
    (root / "notes.txt").write_text("")
    (root / "ep0" / "times.csv").write_text("")
    (root / ".trash").mkdir()
    (root / ".trash" / "old.mp4").write_bytes(b"")
    assert told(root) == ""


def test_hidden_files_are_no_recordings_in_subfolders_either(root: Path) -> None:
    for number in range(COUNT):
        mcap(root / f"ep{number}" / "front.mcap", number)
        (root / f"ep{number}" / "._front.mcap").write_bytes(b"\x00\x05\x16\x07")  # as macOS leaves them
    assert told(root, BY_TIMES) == ""


def test_recordings_in_folders_beside_recordings(root: Path) -> None:
    episodes(root, mcap, "ep{}.mcap")
    mcap(root / "more" / "ep10.mcap", 10)
    mcap(root / "days" / "monday" / "morning" / "ep11.mcap", 11)
    pictures(root / "seen", 12)
    (root / "thumbnail.jpg").write_bytes(b"")
    sentence = told(root, BY_TIMES)
    assert f"4 files and folders in {str(root)!r} were not imported: days/monday/, more/, seen/ and 1 more." in sentence
    paths = [root, root / "more", root / "seen", root / "days" / "monday"]
    everything = import_recordings(paths, root.parent / "everything", OPTIONS)
    assert everything.episodes == COUNT + 3
    assert f"1 file or folder in {str(root)!r} was not imported: thumbnail.jpg." in everything.advice[0]


@pytest.mark.parametrize(
    ("name", "way"),
    [("a.bag", "rosbags-convert"), ("a.db3", "rosbags-convert"), ("a.wmv", "ffmpeg"), ("a.ts", "ffmpeg")],
)
def test_recordings_of_formats_that_are_not_read(root: Path, name: str, way: str) -> None:
    episodes(root, mcap, "ep{}.mcap")
    (root / name).write_bytes(b"")
    sentence = told(root, BY_TIMES)
    assert f"not imported: {name}. Files of the kind {Path(name).suffix} are not read: convert" in sentence
    assert way in sentence


def test_an_episode_of_pictures_that_are_not_read(root: Path) -> None:
    episodes(root, pictures)
    (root / "ep10").mkdir()
    (root / "ep10" / "0.bmp").write_bytes(b"")
    assert "not imported: ep10/. Files of the kind .bmp are not read: convert pictures into PNG files." in told(root)


def test_an_episode_that_calls_its_camera_otherwise(root: Path) -> None:
    episodes(root, pictures, "ep{}/color")
    episodes(root, pictures, "ep{}/depth")
    pictures(root / "ep10" / "Color")
    sentence = told(root, ImportOptions(size=16, camera="color"))
    assert "1 file or folder" in sentence
    assert "not imported: ep10/. " in sentence
    assert "'--camera color' takes what is called exactly so." in sentence


def test_links_that_lead_nowhere(root: Path) -> None:
    episodes(root, mcap, "ep{}.mcap")
    (root / "ep10.mcap").symlink_to(root / "gone.mcap")
    (root / "ep11").symlink_to(root / "ep11")
    (root / "again.mcap").symlink_to(root / "more" / "ep12.mcap")
    sentence = told(root, BY_TIMES)
    assert "3 files and folders" in sentence
    assert "not imported: again.mcap, ep10.mcap, ep11. A link leads nowhere" in sentence


def test_a_picture_that_is_a_link_to_nothing_is_no_skipped_frame(root: Path) -> None:
    pictures(root / "ep0")
    (root / "ep0" / "3.png").unlink()
    (root / "ep0" / "3.png").symlink_to(root / "gone.png")
    with pytest.raises(RecordingImportError, match=r"cannot read '.*3.png': No such file"):
        imported(root)


@pytest.mark.parametrize("stray", ["overview.png", "calibration/0.png"])
def test_few_pictures_beside_episodes_are_not_taken_for_the_recording(root: Path, stray: str) -> None:
    episodes(root, pictures, "day/ep{}" if "/" in stray else "ep{}")
    (root / stray).parent.mkdir(exist_ok=True)
    (root / stray).write_bytes((pictures(root.parent / "other") / "0.png").read_bytes())
    with pytest.raises(RecordingImportError, match="are too few for an episode, and other recordings") as caught:
        imported(root)
    assert ("day/." in str(caught.value)) == ("/" in stray)
    named = [root / "day"] if "/" in stray else sorted(root.glob("*/"))
    assert imported(root, paths=named).episodes == COUNT


def test_deeper_episodes_beside_pictures(root: Path) -> None:
    episodes(root, pictures)
    pictures(root / "day1" / "ep0", 11)
    pictures(root / "day1" / "ep1", 12)
    assert "not imported: day1/. What" in told(root)


def test_what_a_folder_without_an_episode_holds_besides_is_said(root: Path) -> None:
    foxglove_file(root / "a.mcap", video(2), steady(2))
    mcap(root / "more" / "b.mcap")
    with pytest.raises(RecordingImportError, match=r"no episode of at least 3 frames .* not imported: more/"):
        imported(root, BY_TIMES)


def test_a_folder_without_a_recording_is_told_where_some_lie(root: Path) -> None:
    (root / "bag1").mkdir()
    (root / "bag1" / "a.db3").write_bytes(b"")
    with pytest.raises(RecordingImportError, match=r"holds no recording: .*: bag1/\. .* convert bags with 'rosbags"):
        imported(root)
    pictures(root / "a" / "b" / "ep0")
    pictures(root / "a" / "b" / "ep1")
    with pytest.raises(RecordingImportError, match=r"lie deeper in it: a/b/\. Name these folders, or with '--camera"):
        imported(root)
    with pytest.raises(RecordingImportError, match=r"lie deeper in it: a/b/\. Name these folders\.$"):
        imported(root, ImportOptions(size=16, camera="top"))
    assert imported(root, paths=[root / "a" / "b"]).episodes == 2


def test_many_other_files_end_the_search(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(passed_over, "_MOST_FILES", 5)
    episodes(root, mcap, "ep{}.mcap")
    for number in range(9):
        (root / "more").mkdir(exist_ok=True)
        (root / "more" / f"{number}.txt").write_text("")
    assert "holds more than 5 other files" in told(root, BY_TIMES)


@pytest.fixture
def closed(root: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder that cannot be read, as a file's mode does not stop an administrator."""
    folder = root / "ep3"
    listed, scanned = Path.iterdir, os.scandir

    def check(path: object) -> None:
        if Path(str(path)) == folder:
            raise PermissionError(13, "Permission denied", str(folder))

    def iterdir(path: Path) -> Iterator[Path]:
        check(path)
        return listed(path)

    def scandir(path: str | Path = ".") -> object:
        check(path)
        return scanned(path)

    monkeypatch.setattr(Path, "iterdir", iterdir)
    monkeypatch.setattr(os, "scandir", scandir)
    return folder


@pytest.mark.parametrize("kind", ["pictures", "mcap"])
def test_a_folder_that_cannot_be_read_is_a_damaged_recording(root: Path, closed: Path, kind: str) -> None:
    options = OPTIONS if kind == "pictures" else BY_TIMES
    for number in range(COUNT):
        folder = root / f"ep{number}"
        pictures(folder, number) if kind == "pictures" else mcap(folder / f"{number}.mcap", number)
    with pytest.raises(RecordingImportError, match=r"cannot read the folder '.*ep3': Permission denied\."):
        imported(root, options)
    report = import_fleet([root], root.parent / "out", options, skip_damaged=True)
    assert report.episodes == COUNT - 1
    assert [path for path, _ in report.skipped] == [str(closed)]
    assert "not imported" not in " ".join(report.advice)
    np.testing.assert_array_equal(Dataset.open(report.path).lengths, 6)
    with pytest.raises(RecordingImportError, match="cannot read the folder"):
        imported(closed)


def clips(root: Path, names: tuple[str, ...] = ("front.mp4", "wrist.mp4")) -> Path:
    """Two folders with a video of each name, and one that lacks the first of them."""
    for number in range(3):
        (root / f"ep{number}").mkdir()
        for camera, name in enumerate(names[number == 2 :]):
            video_file(root / f"ep{number}" / name, video(6, seed=3 * number + camera))
    return root


@pytest.mark.slow
def test_videos_of_the_same_names_in_several_folders_may_be_cameras(root: Path) -> None:
    report = imported(clips(root))
    assert report.episodes == 5
    sentence = f"2 folders in {str(root)!r} hold videos of the same names: front.mp4, wrist.mp4. If they are several"
    assert sentence in report.advice[0]
    assert f"with '--camera front' or '{root}/*/front.mp4': a data set has one camera." in report.advice[0]


def test_views_of_the_same_numbers_in_one_folder_may_be_cameras(root: Path) -> None:
    for number in range(3):
        for camera, name in enumerate(("front", "wrist")[number == 2 :]):
            video_file(root / f"run_{number}_{name}.mp4", video(6, seed=3 * number + camera))
    video_file(root / "wide_7.mp4", video(6, seed=10))
    report = imported(root)
    assert report.episodes == 6
    assert (
        f"the names of the videos in {str(root)!r} have several patterns with the same numbers ('#' is a number): "
        "'run_#_front', 'run_#_wrist'. If they are several cameras, import one of them, such as with "
        "--camera 'run_#_front': a data set has one camera."
    ) in report.advice
    chosen = import_recordings([root], root.parent / "chosen", ImportOptions(size=16, camera="run_#_front"))
    recipe = Dataset.open(chosen.path).recipe.parameters
    assert [recipe[f"file_{number}"] for number in range(chosen.episodes)] == ["run_0_front.mp4", "run_1_front.mp4"]
    assert "patterns" not in " ".join(chosen.advice)


@pytest.mark.slow
def test_a_camera_s_videos_are_chosen_by_their_name(root: Path) -> None:
    clips(root)
    report = imported(root, ImportOptions(size=16, camera="front"))
    assert report.episodes == 2
    np.testing.assert_array_equal(Dataset.open(report.path).recipe.parameters["file_1"], "front.mp4")
    assert "not imported: ep2/. What" in report.advice[0]
    assert "same names" not in " ".join(report.advice)
    with pytest.raises(RecordingImportError, match=r"no video in .*root' is called 'Front'; .* are: front, wrist\."):
        imported(root, ImportOptions(size=16, camera="Front"))


@pytest.mark.slow
def test_a_number_is_a_stream_and_no_name_of_a_file(root: Path) -> None:
    report = imported(clips(root, ("0.mp4", "1.mp4")), ImportOptions(size=16, camera="0"))
    assert report.episodes == 5
    assert f"such as with '{root}/*/0.mp4': a data set" in report.advice[0]


@pytest.mark.slow
def test_numbered_videos_in_folders_of_different_length_are_no_cameras(root: Path) -> None:
    for day in range(3):
        (root / f"day{day}").mkdir()
        for number in range(day + 1):
            video_file(root / f"day{day}" / f"clip{number}.mp4", video(6, seed=10 * day + number))
    assert "same names" not in " ".join(imported(root).advice)


def test_a_name_cannot_write_to_the_terminal(root: Path) -> None:
    episodes(root, pictures)
    (root / "ep3" / "\x1b[2Jgone\n.bmp").write_bytes(b"BM")
    said = told(root)
    assert "x1b[2Jgone" in said
    assert said.isprintable()
