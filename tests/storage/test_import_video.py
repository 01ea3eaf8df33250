"""Video files: the pictures that were put in come out, at their times, upright; bad files cost a sentence."""

from __future__ import annotations

import os
import random
import shutil
from fractions import Fraction
from pathlib import Path

import av
import numpy as np
import pytest
from storage.foreign import video
from storage.foreign_video import Frames, by_ffmpeg, moving, video_file

from dmotion_bench.errors import RecordingImportError, RecordingTruncated
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.fitting import Fit, fitted
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.video_recording import VideoRecording
from dmotion_bench.storage.video.file import VideoFile

OPTIONS = ImportOptions(size=48)
LIMITS = ImportLimits()


def recording(path: Path, **options: object) -> VideoRecording:
    """Read in this process, without what the import does to the pictures."""
    given = {"camera": None, "source_hz": None, "limits": LIMITS, **options}
    return VideoRecording(path, **given)  # type: ignore[arg-type]


def decoded(path: Path, **options: object) -> tuple[list[float], Frames]:
    """Times [s] and pictures, all of them."""
    one = recording(path, **options)
    (segment,) = one.survey().segments
    pictures = list(one.pictures(0, np.arange(len(segment.times_ns))))
    return (segment.times_ns / 1e9).tolist(), np.stack(pictures)


def refused(path: Path, folder: Path, match: str, options: ImportOptions = OPTIONS) -> str:
    """The import fails with this sentence and leaves nothing behind."""
    before = sorted(folder.rglob("*"))
    with pytest.raises(RecordingImportError, match=match) as caught:
        import_recordings([path], folder / "out", options)
    assert sorted(folder.rglob("*")) == before
    return str(caught.value)


@pytest.mark.parametrize(
    ("name", "kind"),
    [
        ("a.mp4", "h264"),
        ("a.mp4", "hevc"),
        ("a.mov", "h264"),
        ("a.mov", "png"),
        ("a.mkv", "h264"),
        ("a.mkv", "ffv1"),
        ("a.webm", "vp9"),
        ("a.avi", "h264"),
        ("a.avi", "ffv1"),
        ("a.avi", "raw"),
    ],
)
def test_the_pictures_that_were_put_in_come_out(tmp_path: Path, name: str, kind: str) -> None:
    frames = moving(30)
    times, found = decoded(video_file(tmp_path / name, frames, kind))
    np.testing.assert_array_equal(found, frames)
    np.testing.assert_allclose(times, np.arange(30) / 10, atol=1e-3)


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv", "a.avi"])
def test_pictures_that_are_stored_in_another_order(tmp_path: Path, name: str) -> None:
    frames = moving(30)
    encoder = ("libx264", "yuv444p", {"crf": "1", "x264-params": "bframes=3:b-adapt=0"})
    file = video_file(tmp_path / name, frames, encoder=encoder)
    with av.open(str(file)) as container:
        kinds = [frame.pict_type for frame in container.decode(video=0)]
    assert kinds.count(3) > 15  # drawn between an earlier and a later one
    times, found = decoded(file)
    assert np.abs(found.astype(int) - frames).max() < 20
    np.testing.assert_allclose(times, np.arange(30) / 10, atol=1e-3)


@pytest.mark.parametrize(
    "encoder",
    [
        ("libx265", "yuv444p", {"x265-params": "keyint=4:min-keyint=4:scenecut=0:bframes=3:open-gop=1:log-level=none"}),
        ("libx264", "yuv444p", {"x264-params": "keyint=12:min-keyint=12:scenecut=0:bframes=3:open-gop=1"}),
    ],
    ids=["hevc", "h264"],
)
def test_pictures_are_found_behind_key_frames_that_are_shown_later(
    tmp_path: Path, encoder: tuple[str, str, dict[str, str]]
) -> None:
    """A picture of an open group is stored after the key frame that is shown after it."""
    file = video_file(tmp_path / "a.mp4", moving(40), encoder=encoder)
    _, whole = decoded(file)
    assert len(whole) == 40
    for start in range(40):
        with VideoFile(file, pixels=LIMITS.pixels) as one:
            (found,) = one.frames_at([start / 10], within=0.05)
        np.testing.assert_array_equal(found, whole[start])


@pytest.mark.slow
def test_an_import_of_a_video_file(tmp_path: Path) -> None:
    frames = moving(31)
    report = import_recordings([video_file(tmp_path / "a.mp4", frames, rate=30)], tmp_path / "out", OPTIONS)
    dataset = Dataset.open(report.path)

    expected = np.stack([fitted(frame, 48, Fit.CROP) for frame in frames[::3]])
    np.testing.assert_array_equal(dataset.video(0), expected)
    assert (report.source_frames, report.source_hz, report.unreadable) == (31, pytest.approx(30), 0)
    assert (report.source_height, report.source_width) == (48, 64)
    assert dataset.spec.actions is None
    assert import_recordings([tmp_path / "a.mp4"], tmp_path / "out", OPTIONS).frames == report.frames


@pytest.mark.parametrize(("aspect", "said"), [(Fraction(4, 3), True), (Fraction(1), False), (None, False)])
def test_pixels_that_are_not_square_are_told_of(tmp_path: Path, aspect: Fraction | None, said: bool) -> None:
    file = video_file(tmp_path / "a.mp4", moving(2), pixel_aspect=aspect)
    hints = recording(file).survey().told
    assert ["a.mp4' are not square (4:3), and" in hint for hint in hints] == [True] * said
    sentence = refused(file, tmp_path, "the longest recording has 2 of them")  # which has nothing to do with it
    assert ("not square" in sentence) is said


@pytest.mark.parametrize(("flags", "said"), [("+ildct+ilme", True), ("", False)])
def test_interlaced_pictures_are_told_of(tmp_path: Path, flags: str, said: bool) -> None:
    settings = {"flags": flags} if flags else {}
    file = video_file(tmp_path / "a.mkv", moving(5), encoder=("mpeg2video", "yuv420p", settings))
    told = recording(file).survey().told
    assert [sentence.startswith("5 of 5 pictures in ") for sentence in told] == [True] * said


def test_the_suffix_does_not_decide(tmp_path: Path) -> None:
    frames = moving(5)
    video_file(tmp_path / "a.mkv", frames).rename(tmp_path / "recording")
    np.testing.assert_array_equal(decoded(tmp_path / "recording")[1], frames)


@pytest.mark.slow
@pytest.mark.skipif(shutil.which("ffmpeg") is None, reason="needs the program ffmpeg")
@pytest.mark.parametrize(
    ("name", "encoder"),
    [
        ("a.mp4", ("libx264", "yuv420p", {"crf": "30", "bf": "3", "x264-params": "chromaloc=1"})),
        ("a.mp4", ("libsvtav1", "yuv420p", {"crf": "40", "preset": "12"})),
        ("a.mkv", ("libx264", "yuv444p", {"crf": "30"})),
        ("a.webm", ("libvpx", "yuv420p", {"auto-alt-ref": "1", "lag-in-frames": "10"})),
        ("a.webm", ("libvpx-vp9", "yuv420p", {"auto-alt-ref": "1", "lag-in-frames": "10"})),
        ("a.avi", ("mpeg4", "yuv420p", {"bf": "2"})),
        ("a.avi", ("mjpeg", "yuvj420p", {})),
        ("a.mp4", ("mpeg4", "yuv420p", {})),
    ],
)
def test_another_decoder_sees_the_same(tmp_path: Path, name: str, encoder: tuple[str, str, dict[str, str]]) -> None:
    frames = moving(40, 96, 128)
    if encoder[0] == "mpeg4":  # ffmpeg 5 takes its colours to stand between the pixels, where MPEG-4 does not have them
        frames = np.repeat(frames[..., :1], 3, axis=3)
    file = video_file(tmp_path / name, frames, encoder=encoder)
    _, found = decoded(file)
    expected = by_ffmpeg(file, 96, 128)
    assert len(found) == len(expected) == 40  # hidden pictures are not shown
    assert np.abs(found.astype(int) - expected).max() <= 2


def test_colours_follow_the_matrix_that_the_file_names(tmp_path: Path) -> None:
    colours = np.array([[200, 30, 30], [30, 200, 30], [40, 60, 220], [230, 230, 40]], np.uint8)
    frame = np.repeat(np.repeat(colours.reshape(2, 2, 3), 32, axis=0), 32, axis=1)
    for matrix, red, blue in (("bt709", 0.2126, 0.0722), ("smpte170m", 0.299, 0.114)):
        luma = frame @ np.array([red, 1 - red - blue, blue])
        planes = [luma, (frame[..., 2] - luma) / (2 - 2 * blue), (frame[..., 0] - luma) / (2 - 2 * red)]
        scaled = [16 + 219 / 255 * planes[0], *(128 + 224 / 255 * plane for plane in planes[1:])]
        stored = av.VideoFrame.from_ndarray(np.rint(np.stack(scaled)).astype(np.uint8), format="yuv444p")
        with av.open(str(tmp_path / f"{matrix}.mp4"), "w") as container:
            settings = {"qp": "0", "x264-params": f"colormatrix={matrix}"}
            stream = container.add_stream("libx264", rate=10, options=settings)
            stream.height, stream.width, stream.pix_fmt = 64, 64, "yuv444p"  # type: ignore[union-attr]
            stored.pts = 0
            container.mux(stream.encode(stored))  # type: ignore[union-attr]
            container.mux(stream.encode(None))  # type: ignore[union-attr]
        assert np.abs(decoded(tmp_path / f"{matrix}.mp4")[1][0].astype(int) - frame).max() <= 2


@pytest.mark.parametrize("name", ["a.mp4", "a.mkv"])
def test_times_are_those_of_the_pictures(tmp_path: Path, name: str) -> None:
    times = [0.0, 0.1, 0.2, 0.5, 0.6, 1.4, 1.5, 1.6]
    frames = moving(8)
    file = video_file(tmp_path / name, frames, times=[5 + t_s for t_s in times])
    found, pictures = decoded(file)
    np.testing.assert_allclose(found, times, atol=2e-3)
    np.testing.assert_array_equal(pictures, frames)

    report = import_recordings([file], tmp_path / "out", ImportOptions(size=48, max_gap_s=0.7))
    assert Dataset.open(report.path).lengths.tolist() == [7, 3]  # 0 to 0.6 s and 1.4 to 1.6 s


@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
@pytest.mark.parametrize("mirrored", [(False, False), (True, False), (False, True)])
def test_pictures_are_turned_as_the_file_says(tmp_path: Path, degrees: int, mirrored: tuple[bool, bool]) -> None:
    frames = moving(3)
    file = video_file(tmp_path / "a.mp4", frames, rotation=(degrees, *mirrored))
    turned = np.rot90(frames, degrees // 90, axes=(1, 2))
    if mirrored[0]:
        turned = turned[:, :, ::-1]
    if mirrored[1]:
        turned = turned[:, ::-1]
    np.testing.assert_array_equal(decoded(file)[1], turned)
    survey = recording(file).survey()
    assert (survey.height, survey.width) == turned.shape[1:3]


@pytest.mark.slow
def test_several_streams_are_to_be_chosen_from(tmp_path: Path) -> None:
    frames = [moving(5), moving(5)[::-1]]
    with av.open(str(tmp_path / "a.mkv"), "w") as container:
        for _ in frames:
            stream = container.add_stream("ffv1", rate=10)
            stream.height, stream.width, stream.pix_fmt = 48, 64, "bgr0"  # type: ignore[union-attr]
        for number in range(5):
            for stream, pictures in zip(container.streams.video, frames, strict=True):
                frame = av.VideoFrame.from_ndarray(pictures[number], format="rgb24").reformat(format="bgr0")
                frame.pts = number
                container.mux(stream.encode(frame))
    refused(tmp_path / "a.mkv", tmp_path, "has 2 video streams; choose one with '--camera': 0, 1")
    refused(tmp_path / "a.mkv", tmp_path, "no video stream 'top'; choose .*: 0, 1", ImportOptions(camera="top"))
    np.testing.assert_array_equal(decoded(tmp_path / "a.mkv", camera="1")[1], frames[1])


def test_a_rate_can_be_given_in_place_of_the_times(tmp_path: Path) -> None:
    file = video_file(tmp_path / "a.mp4", moving(6), times=[0, 0.1, 0.15, 3, 9, 9.1])
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=48, hz=5, source_hz=5))
    assert (report.episodes, report.frames, report.source_hz) == (1, 6, 5)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("a.mkv", "h264"), ("a.webm", "vp9"), ("a.avi", "raw"), ("a.mp4", "h264")])
def test_a_file_that_was_cut_off(tmp_path: Path, name: str, kind: str) -> None:
    frames = moving(60)
    file = video_file(tmp_path / name, frames, kind, options={"movflags": "faststart"} if kind == "h264" else None)
    file.write_bytes(file.read_bytes()[: file.stat().st_size * 2 // 3])
    with pytest.raises(RecordingTruncated, match=r"is cut off: .*'--salvage'"):
        import_recordings([file], tmp_path / "out", OPTIONS)

    found = decoded(file, salvage=True)[1]
    assert 20 <= len(found) < 60
    np.testing.assert_array_equal(found, frames[: len(found)])
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=48, salvage=True))
    assert any(f"is cut off or damaged after {len(found)} pictures (" in told for told in report.advice)


@pytest.mark.slow
def test_a_cut_file_whose_index_stood_at_its_end(tmp_path: Path) -> None:
    file = video_file(tmp_path / "a.mp4", moving(60))
    file.write_bytes(file.read_bytes()[:-500])
    sentence = refused(file, tmp_path, "is cut off: .* nothing in it can be read without what is missing")
    assert "--salvage" not in sentence
    refused(file, tmp_path, "cannot be read", ImportOptions(salvage=True))


@pytest.mark.slow
def test_damage_is_named_with_its_time_and_can_be_left_out(tmp_path: Path) -> None:
    frames = moving(60)
    file = video_file(tmp_path / "a.mkv", frames)
    with av.open(str(file)) as container:
        (packet,) = [packet for packet in container.demux(video=0) if packet.pts == 2000]
        place = file.read_bytes().index(bytes(packet)) + packet.size // 2
    content = bytearray(file.read_bytes())
    content[place : place + 10] = b"\xff" * 10
    file.write_bytes(content)
    refused(file, tmp_path, r"the video .*a.mkv' has a picture at \d\.\d+ s that is damaged: .*'--salvage'")

    times, found = decoded(file, salvage=True)
    kept = np.rint(np.array(times) * 10).astype(int)
    assert 12 <= len(found) < 60
    np.testing.assert_array_equal(found, frames[kept])  # nothing is drawn on top of a damaged picture
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=48, salvage=True))
    assert report.unreadable == 60 - len(found)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), [("a.mp4", "h264"), ("a.mkv", "ffv1"), ("a.avi", "raw"), ("a.webm", "vp9")])
def test_a_changed_byte_never_surprises(tmp_path: Path, name: str, kind: str) -> None:
    whole = video_file(tmp_path / name, moving(12), kind).read_bytes()
    for seed in range(8):
        chance, content = random.Random(seed), bytearray(whole)
        for _ in range(3):
            content[chance.randrange(len(content))] = chance.randrange(256)
        (tmp_path / name).write_bytes(content)
        try:
            report = import_recordings([tmp_path / name], tmp_path / f"out{seed}", OPTIONS)
            assert report.source_frames <= 13
        except RecordingImportError:
            assert not (tmp_path / f"out{seed}").exists()


@pytest.mark.slow
def test_a_picture_that_is_too_large_is_not_decoded(tmp_path: Path) -> None:
    file = video_file(tmp_path / "a.mkv", video(3, 512, 512), "ffv1")
    refused(
        file,
        tmp_path,
        "pictures of 512x512 pixels, more than the 100,000 that",
        ImportOptions(limits=ImportLimits(pixels=100_000)),
    )


@pytest.mark.slow
def test_a_video_that_takes_too_much_memory(tmp_path: Path) -> None:
    black = np.zeros((4096, 4096, 3), np.uint8)
    file = video_file(tmp_path / "a.mkv", [black] * 3, encoder=("libx264", "yuv444p", {"preset": "ultrafast"}))
    tight = ImportOptions(limits=ImportLimits(reader_bytes=96 * MIB))
    refused(file, tmp_path, "takes more than 96 MiB of memory to be decoded; .*'--max-memory 192'", tight)


@pytest.mark.slow
def test_memory_does_not_grow_with_the_video(tmp_path: Path) -> None:
    frames = [np.zeros((512, 512, 3), np.uint8)] * 400  # 300 MiB when they are decoded
    file = video_file(tmp_path / "a.mp4", frames, encoder=("libx264", "yuv420p", {"preset": "ultrafast"}))
    options = ImportOptions(size=32, limits=ImportLimits(reader_bytes=128 * MIB))
    assert import_recordings([file], tmp_path / "out", options).frames == 400


def test_more_pictures_than_can_be_imported(tmp_path: Path) -> None:
    file = video_file(tmp_path / "a.mp4", moving(20))
    refused(file, tmp_path, "more than the 10 pictures", ImportOptions(size=48, limits=ImportLimits(frames=10)))


@pytest.mark.parametrize("head", [b"#EXTM3U\n", b"ffconcat version 1.0\n", b"<?xml version='1.0'?><MPD>"])
def test_playlists_are_no_videos(tmp_path: Path, head: bytes) -> None:
    video_file(tmp_path / "secret.mp4", moving(5))
    (tmp_path / "a.mp4").write_bytes(head + b"file secret.mp4\n" * 20)
    refused(tmp_path / "a.mp4", tmp_path, "is no recording that can be imported")


def test_a_file_without_video(tmp_path: Path) -> None:
    with av.open(str(tmp_path / "a.mp4"), "w") as container:
        stream = container.add_stream("aac", rate=8000)
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.rate = 8000
        container.mux(stream.encode(frame))  # type: ignore[union-attr]
        container.mux(stream.encode(None))  # type: ignore[union-attr]
    refused(tmp_path / "a.mp4", tmp_path, "has no video stream that can be decoded")


@pytest.mark.slow
def test_a_folder_of_videos_is_many_recordings(tmp_path: Path) -> None:
    (tmp_path / "clips").mkdir()
    for number in (10, 2, 1):
        video_file(tmp_path / f"clips/clip{number}.mp4", moving(number + 5))
    report = import_recordings([tmp_path / "clips"], tmp_path / "out", OPTIONS)
    assert Dataset.open(report.path).lengths.tolist() == [6, 7, 15]


def test_recordings_of_several_kinds_in_a_folder(tmp_path: Path) -> None:
    (tmp_path / "mixed").mkdir()
    video_file(tmp_path / "mixed/a.mp4", moving(5))
    (tmp_path / "mixed/b.mcap").write_bytes(b"")
    refused(tmp_path / "mixed", tmp_path, r"of several kinds \(mcap, video\); name the ones you mean")


def test_a_name_that_is_no_text_stands_in_the_recipe_as_its_bytes(tmp_path: Path) -> None:
    file = tmp_path / os.fsdecode(b"caf\xe9.mp4")
    try:
        video_file(tmp_path / "a.mp4", moving(12)).rename(file)
    except OSError:
        pytest.skip("this file system takes names of UTF-8 alone")
    dataset = Dataset.open(import_recordings([file], tmp_path / "out", OPTIONS).path)
    assert dataset.recipe.parameters["file_0"] == "caf\\xe9.mp4"
