"""Folders of pictures: one an episode, in the order that people mean, upright."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from storage.foreign import compressed, video

from dmotion_bench.errors import RecordingImportError, UsageError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.fitting import Fit
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport

OPTIONS = ImportOptions(size=32)


def fill(folder: Path, frames: np.ndarray, first: int = 0, name: str = "img{}.png") -> Path:
    """A folder with a numbered picture for each frame, written backwards."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in reversed(range(len(frames))):
        (folder / name.format(first + number)).write_bytes(compressed(frames[number], "png"))
    return folder


def imported(folder: Path, options: ImportOptions = OPTIONS) -> tuple[ImportReport, Dataset]:
    report = import_recordings([folder], folder.parent / "out", options)
    return report, Dataset.open(report.path)


def refused(folder: Path, match: str, options: ImportOptions = OPTIONS) -> None:
    with pytest.raises(RecordingImportError, match=match):
        import_recordings([folder], folder.parent / "out", options)
    assert not (folder.parent / "out").exists()


def test_the_second_picture_comes_before_the_tenth(tmp_path: Path) -> None:
    frames = video(12)
    folder = fill(tmp_path / "run", frames, first=1)
    (folder / ".thumbnail.png").write_bytes(b"hidden")
    (folder / "notes.txt").write_text("no picture")
    report, dataset = imported(folder)
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert (report.source_frames, report.source_hz, report.repeated) == (12, 10, 0)


def test_pictures_that_are_named_by_their_time_are_in_its_order(tmp_path: Path) -> None:
    frames = video(3)
    (tmp_path / "run").mkdir()
    for time, frame in zip((1_700_000_000.0001, 1_700_000_000.1, 1_700_000_000.1234567), frames, strict=True):
        (tmp_path / "run" / f"{time}.png").write_bytes(compressed(frame, "png"))
    np.testing.assert_array_equal(imported(tmp_path / "run")[1].video(0), frames)


def test_each_folder_is_an_episode(tmp_path: Path) -> None:
    frames = video(15)
    fill(tmp_path / "runs/episode10", frames[:4])
    fill(tmp_path / "runs/episode9", frames[4:9])
    fill(tmp_path / "runs/episode11", frames[9:])
    (tmp_path / "runs/empty").mkdir()
    _, dataset = imported(tmp_path / "runs")
    assert dataset.lengths.tolist() == [5, 4, 6]
    np.testing.assert_array_equal(dataset.video(0), frames[4:9])
    np.testing.assert_array_equal(dataset.video(2), frames[9:])


def test_a_camera_is_a_folder_in_each_episode(tmp_path: Path) -> None:
    frames = video(16)
    for number, camera in enumerate(("top", "wrist")):
        for episode in range(2):
            start = 8 * number + 4 * episode
            fill(tmp_path / f"runs/{episode}/{camera}", frames[start : start + 4])
    refused(tmp_path / "runs", "holds no recording", ImportOptions(camera="../top"))
    refused(tmp_path / "runs", "holds no recording")
    _, dataset = imported(tmp_path / "runs", ImportOptions(size=32, camera="wrist"))
    np.testing.assert_array_equal(np.concatenate([dataset.video(0), dataset.video(1)]), frames[8:])


@pytest.mark.parametrize("episode", ["run", "run/ep0"])
def test_a_camera_s_folder_comes_before_the_pictures_beside_it(tmp_path: Path, episode: str) -> None:
    frames = video(12)
    fill(tmp_path / episode, frames[:4])
    fill(tmp_path / episode / "wrist", frames[4:8])
    if episode != "run":
        (tmp_path / "run/overview.png").write_bytes(compressed(frames[0], "png"))
    report, dataset = imported(tmp_path / "run", replace(OPTIONS, camera="wrist"))
    np.testing.assert_array_equal(dataset.video(0), frames[4:8])
    assert ("not imported: overview.png." in report.advice[0]) == (episode != "run")


def test_pictures_of_the_folder_itself_need_no_camera(tmp_path: Path) -> None:
    frames = video(4)
    fill(tmp_path / "front", frames)
    _, dataset = imported(tmp_path / "front", replace(OPTIONS, camera="front"))
    np.testing.assert_array_equal(dataset.video(0), frames)


@pytest.mark.parametrize(
    ("folders", "where"), [(["."], "in it"), (["left", "right"], r"in folders in it \(left, right\)")]
)
def test_a_camera_that_no_folder_is_called_is_not_replaced_by_other_pictures(
    tmp_path: Path, folders: list[str], where: str
) -> None:
    for one in folders:
        fill(tmp_path / "run" / one, video(4))
    sentence = f"no folder in '.*run' is called 'wrist'; .* There are pictures {where}: leave out '--camera'"
    refused(tmp_path / "run", sentence, replace(OPTIONS, camera="wrist"))


@pytest.mark.parametrize(
    ("name", "other", "patterns"),
    [
        ("img{}_left.png", "img{}_right.png", ("img#_left.png", "img#_right.png")),
        ("frame_{}.png", "frame_{}.jpg", ("frame_#.png", "frame_#.jpg")),
    ],
)
def test_several_cameras_in_one_folder_are_no_video(
    tmp_path: Path, name: str, other: str, patterns: tuple[str, str]
) -> None:
    frames = video(40)
    for episode in range(2):
        fill(tmp_path / f"run/ep{episode}", frames[20 * episode :][:12], name=name)
        fill(tmp_path / f"run/ep{episode}", frames[20 * episode + 12 :][:4], name=other)
    listed = re.escape(f"\n  --camera '{patterns[0]}' (12 pictures)\n  --camera '{patterns[1]}' (4 pictures)")
    refused(tmp_path / "run", rf"ep0' have names of 2 patterns .* alone:{listed}$")
    refused(
        tmp_path / "run", r"are called 'x#.png', .* are:\s+--camera '(img|frame)", replace(OPTIONS, camera="x#.png")
    )
    report, dataset = imported(tmp_path / "run", replace(OPTIONS, camera=patterns[0]))
    assert report.episodes == 2
    np.testing.assert_array_equal(dataset.video(1), frames[20:32])
    assert dataset.recipe.parameters["camera"] == patterns[0]


def test_a_camera_may_be_a_folder_and_a_pattern_in_it(tmp_path: Path) -> None:
    frames = video(16)
    for number, name in enumerate(("{}_left.png", "{}_right.png")):
        fill(tmp_path / "run/ep0/rgb", frames[4 * number :][:4], name=name)
        fill(tmp_path / "run/ep0/thermal", frames[8 + 4 * number :][:4], name=name)
    _, dataset = imported(tmp_path / "run", replace(OPTIONS, camera="rgb/#_right.png"))
    np.testing.assert_array_equal(dataset.video(0), frames[4:8])


@pytest.mark.parametrize("name", ["{}.5.png", "img-{}.png", "a1_{}_2.png", "{}.png"])
def test_names_that_differ_in_their_numbers_are_of_one_camera(tmp_path: Path, name: str) -> None:
    frames = video(12)
    _, dataset = imported(fill(tmp_path / "run", frames, name=name))
    np.testing.assert_array_equal(dataset.video(0), frames)


def test_the_rate_of_the_pictures_can_be_told(tmp_path: Path) -> None:
    frames = video(30)
    report, dataset = imported(fill(tmp_path / "run", frames), ImportOptions(size=32, source_hz=30))
    np.testing.assert_array_equal(dataset.video(0), frames[::3])
    assert report.source_hz == pytest.approx(30)


@pytest.mark.parametrize("orientation", range(1, 9))
def test_pictures_are_turned_upright(tmp_path: Path, orientation: int) -> None:
    upright = np.zeros((32, 48, 3), np.uint8)
    upright[:16, :24] = 200
    undo = {
        2: Image.Transpose.FLIP_LEFT_RIGHT,
        3: Image.Transpose.ROTATE_180,
        4: Image.Transpose.FLIP_TOP_BOTTOM,
        5: Image.Transpose.TRANSPOSE,
        6: Image.Transpose.ROTATE_90,
        7: Image.Transpose.TRANSVERSE,
        8: Image.Transpose.ROTATE_270,
    }
    taken = Image.fromarray(upright)
    if orientation in undo:
        taken = taken.transpose(undo[orientation])
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = orientation
    (tmp_path / "run").mkdir()
    for number in range(3):
        taken.save(tmp_path / f"run/{number}.jpg", quality=100, subsampling=0, exif=exif)
    report, dataset = imported(tmp_path / "run", ImportOptions(size=32, fit=Fit.STRETCH))
    assert (report.source_height, report.source_width) == (32, 48)
    frame = dataset.video(0)[0].astype(int)
    assert frame[:14, :14].min() > 180
    assert max(frame[18:].max(), frame[:, 18:].max()) < 20


def test_pictures_of_several_sizes(tmp_path: Path) -> None:
    folder = fill(tmp_path / "run", video(3))
    (folder / "img7.png").write_bytes(compressed(video(1, 24, 32)[0], "png"))
    refused(folder, r"several sizes: 32x32 pixels in .*img0.png', 32x24 in .*img7.png'")


def deep(folder: Path, name: str = "{}.png", count: int = 4) -> Path:
    """A folder with pictures of 16 bits, whose upper 8 bits are 3, 4 ..."""
    folder.mkdir(parents=True, exist_ok=True)
    for number in range(count):
        Image.fromarray(np.full((32, 32), 256 * (3 + number) + 77, np.uint16)).save(folder / name.format(number))
    return folder


def test_depth_beside_pictures_is_refused(tmp_path: Path) -> None:
    frames = video(4)
    fill(tmp_path / "set/rgb", frames)
    deep(tmp_path / "set/depth")
    refused(tmp_path / "set", r"mixes pictures with what may be depth: '.*depth/0.png' .*choose with '--camera rgb'")
    with pytest.raises(
        RecordingImportError, match=r"16 bits a pixel, as depth is stored, and those in '.*rgb' are not"
    ):
        import_recordings([tmp_path / "set/depth", tmp_path / "set/rgb"], tmp_path / "out", OPTIONS)
    _, dataset = imported(tmp_path / "set", replace(OPTIONS, camera="rgb"))
    np.testing.assert_array_equal(dataset.video(0), frames)


def test_depth_among_pictures_is_refused(tmp_path: Path) -> None:
    folder = fill(tmp_path / "set", video(4), name="{}_rgb.png")
    deep(folder, "1{}_rgb.png")
    refused(folder, "mixes pictures with what may be depth: .* put the pictures that you mean into a folder of their")


def test_grey_pictures_of_16_bits_alone_keep_their_upper_8(tmp_path: Path) -> None:
    _, dataset = imported(deep(tmp_path / "set"))
    assert dataset.video(0)[:, 0, 0, 0].tolist() == [3, 4, 5, 6]


def test_a_damaged_picture(tmp_path: Path) -> None:
    frames = video(6)
    folder = fill(tmp_path / "run", frames)
    whole = (folder / "img4.png").read_bytes()
    (folder / "img4.png").write_bytes(whole[: len(whole) // 2])
    (folder / "img5.png").write_bytes(b"")
    refused(
        folder,
        r"the picture .*img5.png' has the format 'png', but its 0 bytes are no .* WebP file; import .* '--salvage'\.",
    )
    (folder / "img5.png").write_bytes(whole)
    refused(folder, r"the picture .*img4.png' is a damaged PNG file.*; import the others with '--salvage'")
    (folder / "img5.png").write_bytes(b"")
    report, dataset = imported(folder, ImportOptions(size=32, salvage=True))
    assert report.unreadable == 2
    np.testing.assert_array_equal(dataset.video(0), frames[[0, 1, 2, 3, 3, 3]])


@pytest.mark.parametrize("left", [0, 100])
def test_the_first_picture_of_a_folder_has_none_before_it(tmp_path: Path, left: int) -> None:
    for episode in range(2):
        fill(tmp_path / f"set/{episode}", video(5, seed=episode))
    first = tmp_path / "set/1/img0.png"
    first.write_bytes(first.read_bytes()[:left])
    with pytest.raises(RecordingImportError, match=r"set/1/img0.png' ") as caught:
        imported(tmp_path / "set")
    assert "--salvage" not in str(caught.value)
    match = "img0.png' .*, and no whole picture comes before it in its folder; move it elsewhere"
    refused(tmp_path / "set", match, ImportOptions(size=32, salvage=True))


def test_a_link_to_a_device_is_no_picture(tmp_path: Path) -> None:
    """/dev/zero would be read until the memory is full."""
    folder = fill(tmp_path / "run", video(5))
    (folder / "img5.png").symlink_to("/dev/null")
    refused(folder, "img5.png' is no ordinary file; import the others with '--salvage'")


def test_a_picture_bomb_is_not_unpacked(tmp_path: Path) -> None:
    folder = fill(tmp_path / "run", np.zeros((3, 600, 600, 3), np.uint8))
    refused(
        folder, "declares 600x600 pixels, more than the 100,000", ImportOptions(limits=ImportLimits(pixels=100_000))
    )
    refused(folder, "is a file of more than 0 MiB", ImportOptions(limits=ImportLimits(message_bytes=500)))


def test_the_same_pictures_make_the_same_data_set_and_others_do_not(tmp_path: Path) -> None:
    folder = fill(tmp_path / "run", video(5))
    first = imported(folder)[0]
    assert imported(folder)[0] == first
    (folder / "img9.png").write_bytes((folder / "img0.png").read_bytes())
    with pytest.raises(Exception, match="holds an import of 'run' with other contents: the files have changed since"):
        imported(folder)


def test_pictures_hold_no_actions(tmp_path: Path) -> None:
    folder = fill(tmp_path / "run", video(4))
    refused(folder, "holds pictures alone, no actions; leave out '--actions'", replace(OPTIONS, actions="/action"))


def test_an_episode_that_is_found_twice_is_refused(tmp_path: Path) -> None:
    """One copy could be trained on and the other be tested."""
    for number in range(3):
        fill(tmp_path / "all" / f"ep{number}", video(6))
    with pytest.raises(UsageError, match=r"ep1' is named twice"):
        import_recordings([tmp_path / "all", tmp_path / "all" / "ep1"], tmp_path / "out", OPTIONS)
    (tmp_path / "all" / "latest").symlink_to("ep2")
    with pytest.raises(UsageError, match=r"ep2' and '.*latest' are the same recording; leave one out"):
        import_recordings([tmp_path / "all"], tmp_path / "out", OPTIONS)
    assert not (tmp_path / "out").exists()
