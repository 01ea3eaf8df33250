"""Topics and fields that are named by a part of their names."""

from __future__ import annotations

from pathlib import Path

import foxglove
import pytest
from foxglove.channels import RawImageChannel
from storage.foreign import foxglove_file, raw_image, steady, video
from storage.hand_made import refused
from storage.hdf5_files import robomimic

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.continuous_commands import meant
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.mcap_topics import topics_with
from dmotion_bench.storage.imports.options import ImportOptions

TOPICS = ["/front/image_raw", "/front/image_raw/compressed", "/front/png", "/wrist/image_raw", "/front_left/raw"]


def cameras(path: Path, *topics: str) -> Path:
    """A file with cameras, and a topic that is none."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        channels = [RawImageChannel(topic, context=context) for topic in topics]
        facts = foxglove.Channel("/wrist/facts", message_encoding="json", context=context)
        for t_ns, frame in zip(steady(4), video(4), strict=True):
            facts.log(b'{"focus": 1}', log_time=t_ns)
            for channel in channels:
                channel.log(raw_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()), log_time=t_ns)
    return path


@pytest.mark.parametrize(
    ("part", "within"),
    [
        ("front", ["/front/image_raw", "/front/image_raw/compressed", "/front/png"]),
        ("wrist", ["/wrist/image_raw"]),
        ("front/image_raw", ["/front/image_raw"]),
        ("image_raw/compressed", ["/front/image_raw/compressed"]),
        ("/front_left", ["/front_left/raw"]),
        ("fron", []),
        ("image_raw/", ["/front/image_raw", "/front/image_raw/compressed", "/wrist/image_raw"]),
        ("/", []),
    ],
)
def test_topics_with_a_part(part: str, within: list[str]) -> None:
    assert topics_with(TOPICS, part) == within


@pytest.mark.parametrize("asked", ["wrist", "wrist/image_raw", "/wrist/image_raw"])
def test_a_camera_may_be_named_by_a_part_that_no_other_camera_has(tmp_path: Path, asked: str) -> None:
    file = cameras(tmp_path / "a.mcap", "/front/image_raw", "/wrist/image_raw")
    dataset = Dataset.open(import_recordings([file], tmp_path / "out", ImportOptions(size=32, camera=asked)).path)
    assert dataset.recipe.parameters["camera"] == "/wrist/image_raw"


@pytest.mark.parametrize(
    ("asked", "hint"),
    [
        ("front", "did you mean '/front/image_raw' or '/front/png'?"),
        ("/wirst/image_raw", "did you mean '/wrist/image_raw'?"),
        ("facts", "its topics are:"),
    ],
)
def test_cameras_that_hold_the_part_are_suggested_first(tmp_path: Path, asked: str, hint: str) -> None:
    file = cameras(tmp_path / "a.mcap", "/front/image_raw", "/front/png", "/wrist/image_raw")
    with pytest.raises(RecordingImportError) as caught:
        import_recordings([file], tmp_path / "out", ImportOptions(size=32, camera=asked))
    assert f"has no topic {asked!r} for '--camera'; {hint}" in str(caught.value)


def test_a_topic_of_actions_that_holds_the_part_is_suggested_first(tmp_path: Path) -> None:
    file = cameras(tmp_path / "a.mcap", "/front/image_raw")
    with pytest.raises(RecordingImportError, match="no topic 'facts' for '--actions'; did you mean '/wrist/facts'"):
        import_recordings([file], tmp_path / "out", ImportOptions(size=32, actions="facts"))


@pytest.mark.parametrize(
    ("field", "said"),
    [
        ("x", "did you mean 'linear.x' or 'angular.x'? Its"),
        ("liner.y", "did you mean 'linear.y'? Its"),
        ("speed", "its"),
    ],
)
def test_fields_whose_last_part_it_is_are_suggested_first(field: str, said: str) -> None:
    known = [f"{kind}.{axis}" for kind in ("linear", "angular") for axis in "xyz"]
    assert meant(known, field) == said


def test_recordings_with_different_cameras_are_one_data_set_only_where_one_camera_is_chosen(tmp_path: Path) -> None:
    topics = ("/camera/image", "/wrist/image")
    one, other = (
        foxglove_file(tmp_path / f"{number}.mcap", video(6, seed=number), steady(6), topic=topic)
        for number, topic in enumerate(topics)
    )
    sentence = refused(
        [one, other], tmp_path, f"different cameras: '/camera/image' in '{one}', '/wrist/image' in '{other}'"
    )
    assert "choose one with '--camera /camera/image' and leave" in sentence
    both = import_recordings([one, other], tmp_path / "both", ImportOptions(size=16, camera="image"))
    assert both.episodes == 2  # a part of both names: they are said to be one camera
    chosen = ImportOptions(size=16, camera="/camera/image")
    left = import_fleet([one, other], tmp_path / "left", chosen, skip_damaged=True)
    assert (left.episodes, [path for path, _ in left.skipped]) == (1, [str(other)])


def test_recordings_of_several_kinds_call_one_camera_differently(tmp_path: Path) -> None:
    told = foxglove_file(tmp_path / "a.mcap", video(6), steady(6))
    stored = robomimic(tmp_path / "b.hdf5", {"demo_0": video(6, seed=1)})
    assert import_recordings([told, stored], tmp_path / "out", ImportOptions(size=16)).episodes == 2
    wrist = robomimic(tmp_path / "c.hdf5", {"demo_0": video(6, seed=2)}, picture="obs/wrist")
    refused([stored, wrist], tmp_path, "different cameras: 'obs/agentview_image' in .*, 'obs/wrist' in")
