"""LeRobot data sets as others write them: v2.1 and v3, with videos and with pictures in the tables or beside them."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from dataclasses import replace
from functools import partial
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as parquet
import pytest
from storage.foreign import compressed, video
from storage.foreign_video import moving
from storage.lerobot_sets import CAMERA, IMAGE, LENGTHS, OPTIONS, START, refused, same, v3, v21

from dmotion_bench.errors import RecipeMismatch
from dmotion_bench.recording.fleet import import_fleet
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports import import_plan
from dmotion_bench.storage.imports.confinement import ConfinedRecording
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.lerobot_recording import LeRobotRecording
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.options import ImportOptions


@pytest.mark.slow
@pytest.mark.parametrize("chunk", [1000, 2])
def test_the_older_format_with_videos(tmp_path: Path, chunk: int) -> None:
    frames = moving(15, 32, 32)
    same(v21(tmp_path / "set", frames, "video", chunk), frames)


@pytest.mark.slow
def test_the_older_format_with_pictures(tmp_path: Path) -> None:
    frames = video(15)
    same(v21(tmp_path / "set", frames, "image"), frames)


@pytest.mark.slow
@pytest.mark.parametrize("row_group", [1, 4, 100])
def test_pictures_in_the_table(tmp_path: Path, row_group: int) -> None:
    frames = video(15)
    same(v3(tmp_path / "set", frames, row_group=row_group), frames)


@pytest.mark.slow
@pytest.mark.parametrize("dash", ["-", "_"])
def test_pictures_beside_the_table(tmp_path: Path, dash: str) -> None:
    frames = video(15)
    folder = v3(tmp_path / "set", frames, with_bytes=False)
    for episode, start in enumerate(START):
        pictures = folder / f"images/{CAMERA}/episode{dash}{episode:06d}"
        pictures.mkdir(parents=True)
        for number in range(LENGTHS[episode]):
            (pictures / f"frame{dash}{number:06d}.png").write_bytes(compressed(frames[start + number], "png"))
    same(folder, frames)


@pytest.mark.parametrize("made", [v3, partial(v21, kind="video")], ids=["v3", "v2.1"])
def test_hidden_files_do_not_count(tmp_path: Path, made: Callable[[Path, np.ndarray], Path]) -> None:
    """macOS leaves them beside each file on a disk of another system."""
    folder = made(tmp_path / "set", moving(15, 32, 32))
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["observation.images.wrist"] = info["features"][CAMERA] | {"dtype": "video"}  # not downloaded
    (folder / "meta/info.json").write_text(json.dumps(info))
    before = LeRobotRecording(folder, camera=None, actions=None, limits=ImportLimits())
    count, digest = len(before.survey().segments), before.sha256()
    for films in ("videos/observation.images.wrist/chunk-000", "videos/chunk-000/observation.images.wrist"):
        (folder / films).mkdir(parents=True)
        (folder / films / "file.mp4").touch()
    for file in [one for one in folder.rglob("*") if one.is_file()]:
        file.with_name(f"._{file.name}").write_bytes(b"\x00\x05\x16\x07")
        if file.name == "file.mp4":
            file.unlink()
    after = LeRobotRecording(folder, camera=None, actions=None, limits=ImportLimits())
    assert (len(after.survey().segments), after.sha256()) == (count, digest)


@pytest.mark.slow
def test_only_wanted_pictures_are_unpacked_and_paths_are_not_followed(tmp_path: Path) -> None:
    frames = video(15)
    folder = v3(tmp_path / "set", frames)
    import_recordings([folder], tmp_path / "half", ImportOptions(size=32, hz=5))
    np.testing.assert_array_equal(Dataset.open(tmp_path / "half").video(0), frames[[0, 2, 4]])

    outside = v3(tmp_path / "outside", frames, with_bytes=False)
    refused(outside, "lacks the file 'images/observation.images.top/episode-000000/frame-000000.png'")


def test_the_cameras_of_a_data_set_with_pictures_are_listed(tmp_path: Path) -> None:
    folder = v3(tmp_path / "set", video(15))
    refused(folder, f"has no camera 'front'; its cameras are: '{CAMERA}'", ImportOptions(camera="front"))


@pytest.mark.slow
def test_an_episode_without_its_video_can_be_left_out(tmp_path: Path) -> None:
    frames = video(15)
    folder = v21(tmp_path / "set", frames, "video")
    lacking = f"videos/chunk-000/{CAMERA}/episode_000001.mp4"
    (folder / lacking).unlink()
    refused(folder, rf"lacks the file '{lacking}'\. Leave such episodes out with '--skip-damaged'\.")
    report = import_fleet([folder], tmp_path / "out", OPTIONS, skip_damaged=True)
    assert [path for path, _ in report.skipped] == [f"{folder}: episode 1"]
    in_turn = import_recordings([folder], tmp_path / "in_turn", replace(OPTIONS, skip_damaged=True))
    assert in_turn.skipped == report.skipped
    dataset = Dataset.open(report.path)
    assert dataset.lengths.tolist() == [LENGTHS[0], LENGTHS[2]]
    np.testing.assert_array_equal(dataset.video(1), frames[START[2] :])


@pytest.mark.slow
@pytest.mark.parametrize("place", ["info", "video_info"])
def test_depth_is_no_camera(tmp_path: Path, place: str) -> None:
    folder = v3(tmp_path / "set", video(15))
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["observation.depth"] = {"dtype": "image", place: {"video.is_depth_map": True}}
    (folder / "meta/info.json").write_text(json.dumps(info))
    sentence = f"holds depth in 'observation.depth', and depth is no picture; its cameras are: '{CAMERA}'"
    refused(folder, sentence, ImportOptions(size=32, camera="depth"))
    assert import_recordings([folder], tmp_path / "out", OPTIONS).episodes == 3


@pytest.mark.slow
def test_grey_pictures_of_16_bits_are_depth(tmp_path: Path) -> None:
    refused(v3(tmp_path / "set", np.full((15, 8, 8), 5000, np.uint16)), "grey with 16 bits a pixel, as depth is stored")


@pytest.mark.slow
def test_actions_are_found_by_the_last_part_of_their_name(tmp_path: Path) -> None:
    folder = v3(tmp_path / "set", video(15))
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"] |= {"teleop.stamp": info["features"].pop("timestamp"), "other.stamp": {"dtype": "float32"}}
    (folder / "meta/info.json").write_text(json.dumps(info))
    refused(folder, "more than one feature 'stamp' for '--actions'", replace(OPTIONS, actions="stamp"))
    refused(
        folder,
        "no feature 'tion' for '--actions'; did you mean 'action'. Its features are: action, other",
        replace(OPTIONS, actions="tion"),
    )
    info["features"]["robot.action"] = info["features"].pop("action")
    (folder / "meta/info.json").write_text(json.dumps(info))
    file = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    names = ["robot.action" if name == "action" else name for name in table.column_names]
    parquet.write_table(table.rename_columns(names), file)
    same(folder, video(15))


@pytest.mark.slow
def test_damaged_pictures_and_tables_are_named(tmp_path: Path) -> None:
    frames = video(15)
    folder = v3(tmp_path / "set", frames)
    file = folder / "data/chunk-000/file-000.parquet"
    table = parquet.read_table(file)
    for number, change, match in (
        (6, b"no picture", r"a picture that has the format 'png', but .* \(frame 1 of episode 1\)"),
        (6, compressed(frames[0], "png")[:-2000], r"a picture that is a damaged PNG file.* \(frame 1 of episode 1\)"),
        (6, compressed(video(1, 24, 32)[0], "png"), "mixes picture sizes: 32x24 pixels at frame 1 of episode 1"),
    ):
        stored = table[CAMERA].to_pylist()
        stored[number] = {"bytes": change, "path": None}
        place = table.column_names.index(CAMERA)
        parquet.write_table(table.set_column(place, CAMERA, pa.array(stored, IMAGE)), file)
        refused(folder, match)
    parquet.write_table(table.drop_columns([CAMERA]), file)
    refused(folder, f"lacks the column '{CAMERA}'")
    parquet.write_table(table.slice(0, 12), file)
    refused(folder, "lacks rows of episode 2")
    file.write_bytes(file.read_bytes()[:-100])
    refused(folder, "has a damaged table")


@pytest.mark.slow
@pytest.mark.parametrize("line", ["{", "[1]", '{"episode_index": 0}', '{"episode_index": -1, "length": 3}', "9" * 5000])
def test_a_damaged_list_of_episodes(tmp_path: Path, line: str) -> None:
    folder = v21(tmp_path / "set", moving(15, 32, 32), "video")
    (folder / "meta/episodes.jsonl").write_text(line + "\n")
    refused(folder, r"has a damaged 'episodes.jsonl'|an episode without a place")


@pytest.mark.slow
def test_a_missing_list_of_episodes_is_named(tmp_path: Path) -> None:
    folder = v3(tmp_path / "set", video(sum(LENGTHS)))
    for table in folder.glob("meta/episodes/*/*.parquet"):
        table.unlink()
    refused(folder, "lacks 'meta/episodes/chunk-000/file-000.parquet', the table of its episodes")


def corrected(folder: Path) -> None:
    """Change which stretch belongs to which episode."""
    if (folder / "meta/episodes.jsonl").is_file():
        lines = (folder / "meta/episodes.jsonl").read_text().splitlines()[:2]
        (folder / "meta/episodes.jsonl").write_text("\n".join(lines))
        return
    file = folder / "meta/episodes/chunk-000/file-000.parquet"
    parquet.write_table(parquet.read_table(file).slice(0, 2), file)


@pytest.mark.slow
@pytest.mark.parametrize("made", [lambda folder: v3(folder, video(15)), lambda folder: v21(folder, video(15), "image")])
def test_a_corrected_list_of_episodes_is_another_recording(tmp_path: Path, made: Callable[[Path], Path]) -> None:
    folder = made(tmp_path / "set")
    first = import_recordings([folder], tmp_path / "out", OPTIONS)
    assert import_recordings([folder], tmp_path / "out", OPTIONS) == first
    corrected(folder)
    with pytest.raises(RecipeMismatch, match="an import of 'set' with other contents: the files have changed since"):
        import_recordings([folder], tmp_path / "out", OPTIONS)
    assert import_recordings([folder], tmp_path / "again", OPTIONS).episodes == 2


@pytest.mark.slow
def test_an_import_by_an_earlier_version_is_told_apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The hash left the list of episodes out; the episodes themselves are the same."""
    folder = v3(tmp_path / "set", video(15))
    recording = LeRobotRecording(folder, camera=None, actions=None, limits=ImportLimits())
    earlier = hashlib.sha256()
    for name in ("data/chunk-000/file-000.parquet", "meta/info.json"):
        earlier.update(hashlib.sha256((folder / name).read_bytes()).digest())
    assert recording.sha256() != earlier.hexdigest()
    with monkeypatch.context() as before:
        before.setattr(ConfinedRecording, "sha256", lambda self: earlier.hexdigest())
        import_recordings([folder], tmp_path / "out", OPTIONS)
    said = r"an earlier version of dmbench imported it, .* list of episodes\); name another folder with '--out DIR'"
    with pytest.raises(RecipeMismatch, match=said):
        import_recordings([folder], tmp_path / "out", OPTIONS)
    assert len(Dataset.open(tmp_path / "out")) == 3
    with pytest.raises(RecipeMismatch, match=r"other options: '--size' is [0-9]+ there and 16 here; name"):
        import_recordings([folder], tmp_path / "out", ImportOptions(size=16))


@pytest.mark.slow
def test_an_import_that_this_version_makes_otherwise_is_said(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = v3(tmp_path / "set", video(15))
    with monkeypatch.context() as before:
        before.setattr(import_plan, "cut", lambda pieces, **lengths: pieces[:1] if len(pieces[0]) != 4 else [])
        import_recordings([folder], tmp_path / "out", OPTIONS)
    with pytest.raises(RecipeMismatch, match="what an earlier version of dmbench has made of these recordings"):
        import_recordings([folder], tmp_path / "out", OPTIONS)


@pytest.mark.slow
def test_two_actions_of_one_name_are_refused(tmp_path: Path) -> None:
    folder = v3(tmp_path / "set", video(sum(LENGTHS)))
    info = json.loads((folder / "meta/info.json").read_text())
    info["features"]["action"]["dmbench_actions"] = ["up", "up"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    refused(folder, "names two actions 'up'", ImportOptions(size=32, camera="top", actions="action"))


@pytest.mark.parametrize("place", ["meta/episodes/chunk-000/file-000.parquet", "data/chunk-000/file-001.parquet"])
def test_a_pipe_among_the_tables_is_not_waited_for(tmp_path: Path, place: str) -> None:
    folder = v3(tmp_path / "set", video(sum(LENGTHS)))
    (folder / place).unlink(missing_ok=True)
    os.mkfifo(folder / place)
    refused(folder, "no ordinary file")


def test_a_pipe_in_place_of_the_list_of_episodes_is_not_waited_for(tmp_path: Path) -> None:
    folder = v21(tmp_path / "set", video(sum(LENGTHS)), "image")
    (folder / "meta/episodes.jsonl").unlink()
    os.mkfifo(folder / "meta/episodes.jsonl")
    refused(folder, "no ordinary file")
