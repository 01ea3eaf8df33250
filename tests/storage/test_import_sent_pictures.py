"""Video over topics whose messages come in another order than their pictures, or were lost."""

from __future__ import annotations

from pathlib import Path

import foxglove
import numpy as np
import pytest
from foxglove.channels import CompressedVideoChannel
from foxglove.messages import CompressedVideo, Timestamp
from storage.foreign import START, steady
from storage.foreign_video import Frames, moving, packets

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.recording import Clock
from dmotion_bench.storage.imports.sent_pictures import as_shown

OPTIONS = ImportOptions(size=48, actions="/action")
B_FRAMES = {
    "h264": ("libx264", "yuv444p", {"crf": "4", "x264-params": "bframes=2:b-adapt=0:b-pyramid=none:keyint=12"}),
    "h265": (
        "libx265",
        "gbrp",
        {"x265-params": "lossless=1:keyint=12:bframes=2:b-adapt=0:b-pyramid=0:repeat-headers=1:log-level=none"},
    ),
}


def recording(path: Path, sent: list[bytes], form: str, logged: list[int], stamps: list[int] | None = None) -> Path:
    """Packets and their times, and the number of each picture as a command at the time at which it is taken."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        camera = CompressedVideoChannel("/video", context=context)
        actions = foxglove.Channel("/action", message_encoding="json", context=context)
        for number, t_ns in enumerate(steady(len(sent))):
            actions.log(b'{"action": %d}' % number, log_time=t_ns)
        for data, t_ns, stamp_ns in zip(sent, logged, stamps or logged, strict=True):
            stamp = Timestamp(sec=stamp_ns // 10**9, nsec=stamp_ns % 10**9)
            camera.log(CompressedVideo(timestamp=stamp, frame_id="", data=data, format=form), log_time=t_ns)
    return path


def imported(file: Path, options: ImportOptions = OPTIONS) -> tuple[ImportReport, Dataset]:
    report = import_recordings([file], file.with_suffix(f".{options.clock}"), options)
    return report, Dataset.open(report.path)


def same(dataset: Dataset, frames: Frames) -> None:
    """Every frame is nearest to the picture that was taken then."""
    shown = dataset.video(0).astype(int)
    apart = [[np.abs(one - other).mean() for other in frames.astype(int)] for one in shown]
    assert np.argmin(apart, axis=1).tolist() == list(range(len(frames)))


def in_order_of_sending(count: int) -> list[int]:
    """The pictures as they are sent with two B-frames: 0 3 1 2 6 4 5, from each key frame on."""
    order: list[int] = []
    for first in range(0, count, 12):
        last = min(first + 12, count) - 1
        order.append(first)
        for late in range(first + 3, last + 3, 3):
            order += [min(late, last), *range(late - 2, min(late, last))]
    return order


@pytest.mark.parametrize("form", B_FRAMES)
def test_pictures_of_b_frames_stand_when_they_were_taken(tmp_path: Path, form: str) -> None:
    """An encoder that waits for two pictures sends the first one when it gets the third."""
    frames, late = moving(24, 48, 48), steady(26)[2:]
    sent = packets(frames, *B_FRAMES[form])
    report, dataset = imported(recording(tmp_path / "a.mcap", sent, form, late))
    same(dataset, frames)
    assert dataset.rows[0].start_ns == START
    assert [dataset.spec.actions.names[number] for number in dataset.states(0).actions] == list(map(str, range(23)))
    (told,) = [one for one in report.advice if "B-frames" in one]
    assert "count for the pictures in turn, 2 pictures earlier" in told
    assert "--clock header" not in told
    by_stamp, again = imported(
        recording(tmp_path / "b.mcap", sent, form, late, late), ImportOptions(size=48, clock=Clock.HEADER)
    )
    same(again, frames)
    assert any("B-frames" in one for one in by_stamp.advice)


def test_time_stamps_of_the_pictures_are_better_than_turns(tmp_path: Path) -> None:
    frames = moving(24, 48, 48)
    sent, stamps = packets(frames, *B_FRAMES["h264"]), [steady(24)[number] for number in in_order_of_sending(24)]
    file = recording(tmp_path / "a.mcap", sent, "h264", steady(28)[4:], stamps)
    report, _ = imported(file)
    assert any("tell more: use '--clock header'" in one for one in report.advice)
    told, dataset = imported(file, ImportOptions(size=48, actions="/action", clock=Clock.HEADER))
    same(dataset, frames)
    assert dataset.rows[0].start_ns == START
    assert not any("B-frames" in one for one in told.advice)


def test_a_pause_does_not_move_pictures(tmp_path: Path) -> None:
    numbers = np.array([0, 2, 3, 1, 5, 6, 4])
    paused = 10**9 * np.array([0, 1, 2, 3, 60, 61, 62])
    np.testing.assert_array_equal(as_shown(paused[numbers], numbers), paused - 2 * 10**9)
    np.testing.assert_array_equal(as_shown(paused, numbers), paused)  # they are the pictures' own


def test_messages_in_disorder_are_refused(tmp_path: Path) -> None:
    sent = packets(moving(24, 48, 48), *B_FRAMES["h264"])
    times = steady(24)
    times[10], times[11] = times[11], times[10]
    with pytest.raises(RecordingImportError, match=r"time goes backwards by .* at message"):
        imported(recording(tmp_path / "a.mcap", sent, "h264", times))


@pytest.mark.slow
def test_times_that_skip_a_picture_of_a_video_are_told(tmp_path: Path) -> None:
    settings = {"lossless": "1", "g": "12", "lag-in-frames": "0"}
    sent, times = packets(moving(40, 64, 64), "libvpx-vp9", "gbrp", settings), steady(40)

    def told(name: str, lost: tuple[int, ...], times: list[int] = times) -> list[str]:
        kept = [place for place in range(40) if place not in lost]
        file = recording(tmp_path / name, [sent[at] for at in kept], "vp9", [times[at] for at in kept])
        return [one for one in imported(file, ImportOptions(size=64))[0].advice if "lacks pictures" in one]

    (sentence,) = told("a.mcap", (4, 17, 18, 19, 30))
    assert sentence.startswith("by its times the video on '/video' lacks pictures in 3 places: if their messages were")
    assert not told("b.mcap", ())
    assert not told("c.mcap", (11, 22, 23))  # key frames come next
    uneven = (np.array(times) + np.arange(40) % 3 * 40_000_000).tolist()
    assert not told("d.mcap", (4, 17), uneven)
    late = [t_ns + (place in (4, 17)) * 80_000_000 for place, t_ns in enumerate(times)]
    assert not told("e.mcap", (), late)


def test_pictures_of_h265_that_need_a_lost_one_are_left_out(tmp_path: Path) -> None:
    settings = "lossless=1:keyint=12:bframes=0:repeat-headers=1:log-level=none"
    frames, times = moving(40, 48, 48), steady(40)
    sent = packets(frames, "libx265", "gbrp", {"x265-params": settings})
    kept = [place for place in range(40) if place not in (4, 30)]
    file = recording(tmp_path / "a.mcap", [sent[at] for at in kept], "h265", [times[at] for at in kept])
    report, dataset = imported(file, ImportOptions(size=48))
    whole = [*range(4), *range(12, 30), *range(36, 40)]
    shown = np.concatenate([dataset.video(number) for number in range(len(dataset))])
    np.testing.assert_array_equal(shown, frames[whole])
    assert any(one.startswith("pictures are missing in 2 places, for 0.7 to 0.9 s") for one in report.advice)
