"""The recorder's clock and the camera's own time stamps: jumps, bursts, and which advice can be followed."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from storage.foreign import ros_file, ros_image, steady

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Clock
from dmotion_bench.storage.imports.timeline import gaps_ns
from dmotion_bench.storage.imports.two_clocks import Jump, Times, apart_s, delay_ns, is_steadier, jumps

HOUR_NS = 3600 * 10**9
HALF_NS = 5 * 10**8
SMALL = ImportOptions(size=32)
WITH_ACTIONS = ImportOptions(size=32, actions="/action")


def taken(count: int = 40, hz: float = 30.0) -> Times:
    return np.array(steady(count, hz), np.int64)


def jumped(stamps_ns: Times, *at: tuple[int, int]) -> Times:
    """The times of recording, if the recorder's clock jumps at some pictures."""
    recorded = stamps_ns.copy()
    for picture, by_ns in at:
        recorded[picture:] += by_ns
    return recorded


def recording(folder: Path, recorded_ns: Times, stamps_ns: Times) -> Path:
    """A camera, and actions that the recorder's clock gives their times; the action is the number of the picture."""
    messages = []
    for number, (at, stamp) in enumerate(zip(recorded_ns.tolist(), stamps_ns.tolist(), strict=True)):
        frame = np.full((32, 32, 3), number, np.uint8)
        image = ros_image(stamp, 32, 32, "rgb8", 96, frame.tobytes())
        messages += [
            ("/camera", "sensor_msgs/msg/Image", at, image),
            ("/action", "std_msgs/msg/Int32", at, {"data": number}),
        ]
    return ros_file(folder, messages)


def test_a_jump_is_found_where_it_is() -> None:
    stamps, jitter = taken(), np.random.default_rng(0).integers(0, 200_000_000, 40)
    assert jumps(jumped(stamps, (20, HOUR_NS)), stamps) == [Jump(picture=20, by_ns=HOUR_NS)]
    twice = jumps(jumped(stamps, (10, HOUR_NS), (30, 2 * HOUR_NS)) + jitter, stamps)
    assert [jump.picture for jump in twice] == [10, 30]
    assert [round(jump.by_ns / HOUR_NS) for jump in twice] == [1, 2]


def test_a_simulator_s_clock_begins_at_0(tmp_path: Path) -> None:
    stamps = taken() - taken()[0]
    bursts = recording(tmp_path / "a", taken()[0] + stamps // HALF_NS * HALF_NS, stamps)
    header = ImportOptions(size=32, hz=30, clock=Clock.HEADER)
    dataset = Dataset.open(import_recordings([bursts], tmp_path / "out", header).path)
    assert dataset.video(0)[:, 0, 0, 0].tolist() == list(range(40))
    set_back = recording(tmp_path / "b", jumped(taken(), (20, -HALF_NS)), stamps)
    with pytest.raises(RecordingImportError, match="the recorder's clock was set back; use '--clock header'"):
        import_recordings([set_back], tmp_path / "no", SMALL)


def test_pictures_of_one_time_are_told_of(tmp_path: Path) -> None:
    stamps = taken()
    twice = recording(tmp_path / "a", np.repeat(stamps, 2), np.repeat(stamps, 2))
    report = import_recordings([twice], tmp_path / "twice", ImportOptions(size=8))
    assert any(one.startswith("40 of 80 pictures have the time of the one before") for one in report.advice)
    still = recording(tmp_path / "b", np.repeat(stamps[:1], 40), np.repeat(stamps[:1], 40))
    with pytest.raises(RecordingImportError, match=r"all pictures of a recording have one time\. .* '--source-hz'"):
        import_recordings([still], tmp_path / "still", ImportOptions(size=8))


def test_what_is_no_jump_of_the_recorder_s_clock() -> None:
    stamps = taken()
    assert jumps(stamps, stamps) == []
    assert jumps(stamps + 10 * HOUR_NS, stamps) == []  # another clock
    assert jumps(jumped(stamps, (20, 800_000_000)), stamps) == []  # a network may take as long from then on
    assert jumps(jumped(stamps, (20, HOUR_NS)), np.zeros(40, np.int64)) == []  # without stamps
    assert jumps(stamps, jumped(stamps, (20, HOUR_NS))) == []  # the camera's clock
    late = stamps.copy()
    late[20] += 2 * 10**9  # a message that was held up
    assert jumps(late, stamps) == []
    bursts = stamps[np.arange(1, 41) * 39 // 40 // 20 * 20] + 5 * 10**9
    assert jumps(bursts, 4 * stamps - 3 * stamps[0]) == []


def test_two_clocks_are_one_only_if_they_agree_throughout() -> None:
    stamps = taken()
    assert apart_s(stamps + 500_000_000, stamps) is None
    assert apart_s(stamps - 2 * 10**9, stamps) == -2
    assert apart_s(jumped(stamps, (20, HOUR_NS)), stamps) is not None
    assert apart_s(jumped(stamps, (30, HOUR_NS)), stamps) == 3600  # the median would say 0
    assert apart_s(jumped(stamps, (38, HOUR_NS)), stamps) is None  # two pictures are no episode


def test_an_interval_across_a_jump_is_no_gap() -> None:
    times = np.delete(jumped(taken(), (20, HOUR_NS)), range(30, 38))
    assert len(gaps_ns(times, hz=10)) == 2
    assert gaps_ns(times, hz=10, jumps=[20]).tolist() == [300_000_000]


@pytest.mark.parametrize("picture", [20, 30])
def test_a_clock_that_jumps_forward_is_told_of_without_wrong_advice(tmp_path: Path, picture: int) -> None:
    stamps = taken()
    file = recording(tmp_path / "bag", jumped(stamps, (picture, HOUR_NS)), stamps)
    jump = (
        f"{str(file)!r}: the recorder's clock jumped forward by 3,600 s after picture {picture}, while the camera's "
        "own time stamps go on"
    )
    report = import_recordings([file], tmp_path / "out", WITH_ACTIONS)
    assert report.episodes == 2
    cut = "an episode ends where the recorder's clock jumped; '--clock header' does not cut there"
    assert report.advice[:2] == (
        f"{jump}.",
        f"{cut}, but cannot be used with '--actions': the actions have the recorder's times.",
    )
    assert not any("pictures are missing" in told or "bursts" in told for told in report.advice)
    by_camera = ImportOptions(size=32, actions="/action", clock=Clock.HEADER)
    with pytest.raises(RecordingImportError) as caught:
        import_recordings([file], tmp_path / "none", by_camera)
    assert str(caught.value) == f"{jump}, so these are of another clock than the actions; use '--clock log'."

    alone = import_recordings([file], tmp_path / "alone", SMALL)
    assert alone.advice[:2] == (f"{jump}.", f"{cut}.")
    joined = import_recordings([file], tmp_path / "joined", ImportOptions(size=32, clock=Clock.HEADER))
    assert joined.episodes == 1
    assert Dataset.open(joined.path).video(0)[:, 0, 0, 0].tolist() == list(range(0, 40, 3))


def test_bursts_of_another_clock_than_the_actions_are_not_told_of_it(tmp_path: Path) -> None:
    stamps = taken()
    bursts = np.sort(stamps[np.arange(40) // 10 * 10] + np.arange(40) % 10 * 1_000_000)
    assert is_steadier(bursts, stamps)
    options = ImportOptions(size=32, actions="/action", max_gap_s=2)
    near = import_recordings([recording(tmp_path / "near", bursts, stamps)], tmp_path / "out", options)
    assert any(told.endswith("time stamps are steadier: use '--clock header'.") for told in near.advice)
    far = import_recordings([recording(tmp_path / "far", bursts, stamps - HOUR_NS)], tmp_path / "other", options)
    assert any(told.endswith("'--clock header' can be used without '--actions' alone.") for told in far.advice)
    assert not any("use '--clock header'" in told for told in far.advice)


@pytest.mark.parametrize(("late_ms", "said"), [(40, False), (60, True), (1100, False)])
def test_pictures_that_were_recorded_more_than_half_a_step_late_are_told_of(
    tmp_path: Path, late_ms: int, said: bool
) -> None:
    stamps = taken()
    late = recording(tmp_path / "late", stamps + late_ms * 1_000_000, stamps)
    told = import_recordings([late], tmp_path / "out", WITH_ACTIONS).advice
    start = "'/camera' was recorded 0.06 s after its own time stamps, more than half a step, and the actions go with"
    assert any(one.startswith(start) for one in told) == said
    assert any("after its own time stamps" in one for one in told) == said
    for options in (SMALL, ImportOptions(size=32, actions="/action", hz=5)):
        other = import_recordings([late], tmp_path / f"hz-{options.hz}", options).advice
        assert not any("after its own time stamps" in one for one in other)


def test_a_delay_that_the_time_stamps_do_not_tell() -> None:
    stamps = taken()
    assert delay_ns(stamps + 70_000_000, stamps) == 70_000_000
    assert delay_ns(stamps, stamps + 70_000_000) == 0
    assert delay_ns(stamps, np.zeros_like(stamps)) == 0
    assert delay_ns(stamps + HOUR_NS, stamps) == 0
