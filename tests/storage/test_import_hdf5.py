"""HDF5 as robomimic, ALOHA and others write it: every demonstration comes in."""

from __future__ import annotations

import itertools
import re
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from storage.foreign import video
from storage.hdf5_files import CAM_HIGH, OPTIONS, aloha, filled_up, imported, packed, refused, robomimic

from dmotion_bench.actions import Discrete
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions


@pytest.mark.parametrize("packing", [{}, {"compression": "gzip", "chunks": (5, 16, 32, 3)}, {"compression": "lzf"}])
def test_every_demonstration_is_an_episode(tmp_path: Path, packing: dict[str, Any]) -> None:
    frames = video(20)
    file = robomimic(
        tmp_path / "a.hdf5", {"demo_10": frames[:8], "demo_2": frames[8:13], "demo_1": frames[13:]}, **packing
    )
    dataset = imported(file)
    assert dataset.lengths.tolist() == [7, 5, 8]
    np.testing.assert_array_equal(dataset.video(0), frames[13:])
    np.testing.assert_array_equal(dataset.video(1), frames[8:13])
    np.testing.assert_array_equal(dataset.video(2), frames[:8])
    assert dataset.spec.actions is None
    assert dataset.recipe.parameters["camera"] == "obs/agentview_image"


@pytest.mark.slow
def test_the_environment_s_rate_counts(tmp_path: Path) -> None:
    frames = video(20)
    dataset = imported(robomimic(tmp_path / "a.hdf5", {"demo_0": frames}, control_freq=20))
    np.testing.assert_array_equal(dataset.video(0), frames[::2])
    told = import_recordings([tmp_path / "a.hdf5"], tmp_path / "all", ImportOptions(size=32, source_hz=10))
    assert told.frames == 20


def test_salvage_is_said_to_do_nothing(tmp_path: Path) -> None:
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(5)})
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=32, salvage=True))
    assert "'--salvage' does nothing for HDF5 files and LeRobot data sets" in report.advice[0]


@pytest.mark.parametrize(
    ("given", "names", "numbers"),
    [
        (np.array([3, 3, -1, 3, 0]), ("-1", "0", "3"), [2, 2, 0, 2]),
        (np.array([[1], [0], [0], [1], [1]], np.uint8), ("0", "1"), [1, 0, 0, 1]),
        (np.array([True, False, False, True, True]), ("false", "true"), [1, 0, 0, 1]),
        (["up", "down", "down", "up", "up"], ("down", "up"), [1, 0, 0, 1]),
        (np.array([3, 3, -1, 3]), ("-1", "3"), [1, 1, 0, 1]),  # none for the last picture
    ],
)
def test_discrete_actions(tmp_path: Path, given: Any, names: tuple[str, ...], numbers: list[int]) -> None:
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(5)}, actions={"demo_0": given})
    dataset = imported(file, ImportOptions(size=32, actions="actions"))
    assert dataset.spec.actions == Discrete(names)
    assert dataset.states(0).actions.tolist() == numbers


def test_a_choice_that_is_always_the_same_is_told_of(tmp_path: Path) -> None:
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(5)}, actions={"demo_0": [0, 0, 0, 0, 1]})
    report = import_recordings([file], tmp_path / "out", ImportOptions(size=32, actions="actions"))
    assert any(one.startswith("all actions are '0', so they tell nothing.") for one in report.advice)


@pytest.mark.slow
def test_rows_of_whole_numbers_are_no_discrete_actions(tmp_path: Path) -> None:
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": video(5)}, actions={"demo_0": [[1, 2]] * 5})
    refused(
        file, "a measurement and no choice out of a few; .*leaving '--actions' out", ImportOptions(actions="actions")
    )
    short = robomimic(tmp_path / "b.hdf5", {"demo_0": video(5)}, actions={"demo_0": [1, 2]})
    refused(short, "has 2 int64 as actions in '/data/demo_0/actions'; .* 5 pictures", ImportOptions(actions="actions"))


@pytest.mark.slow
def test_cameras_are_found_by_path_or_by_name_and_listed(tmp_path: Path) -> None:
    frames = video(8)
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": frames[:4]})
    with h5py.File(file, "a") as opened:
        opened["data/demo_0/obs"].create_dataset("wrist", data=frames[4:, ..., :1])
    refused(file, "has 2 cameras; choose one:\n  --camera obs/agentview_image\n  --camera obs/wrist")
    refused(
        file,
        "has no 'front' for '--camera'; in '/data/demo_0' are:\n  actions 4 x 7 float64\n",
        ImportOptions(camera="front"),
    )
    refused(file, "has no 'q' for '--actions'", ImportOptions(camera="wrist", actions="q"))
    refused(file, r"for '--camera'; did you mean 'obs/agentview_image'\? In '/data", ImportOptions(camera="agentview"))
    near = ImportOptions(camera="wrist", actions="action")
    refused(file, r"has no 'action' for '--actions'; did you mean 'actions'\? In '/data/demo_0' are:", near)
    grey = imported(file, ImportOptions(size=32, camera="wrist"))
    np.testing.assert_array_equal(grey.video(0), np.repeat(frames[4:, ..., :1], 3, axis=3))


def test_a_file_without_demonstrations_is_one(tmp_path: Path) -> None:
    frames = video(6)
    with h5py.File(tmp_path / "episode_0.h5", "w") as file:
        file.create_dataset("observations/images/top", data=frames)
        file.create_dataset("action", data=np.zeros((6, 14)))
    np.testing.assert_array_equal(
        imported(tmp_path / "episode_0.h5", ImportOptions(size=32, camera="top")).video(0), frames
    )


def trajectories(path: Path, groups: Mapping[str, Mapping[str, np.ndarray]]) -> Path:
    with h5py.File(path, "w") as file:
        for group, inside in groups.items():
            for name, data in inside.items():
                file.create_dataset(f"{group}/{name}", data=data)
    return path


def test_demonstrations_may_stand_at_the_root(tmp_path: Path) -> None:
    """As ManiSkill has them, with an action less than there are pictures."""
    frames, cut = video(30), [0, 9, 18, 30]
    groups = {
        f"traj_{number}": {
            "obs/sensor_data/top/rgb": frames[start:end],
            "actions": np.full((end - start - 1, 2), number),
        }
        for number, (start, end) in enumerate(itertools.pairwise(cut))
    }
    dataset = imported(
        trajectories(tmp_path / "a.h5", groups),
        ImportOptions(size=32, actions="actions", action_fields=("actions.0",)),
    )
    assert dataset.lengths.tolist() == [9, 9, 12]
    np.testing.assert_array_equal(dataset.video(2), frames[18:])
    np.testing.assert_array_equal(dataset.states(1).actions, np.full((8, 1), 1))
    assert dataset.recipe.parameters["camera"] == "obs/sensor_data/top/rgb"


@pytest.mark.parametrize("kind", [None, (np.int64, ()), (np.float32, (1,))])
def test_demonstrations_that_are_called_so_need_no_table(
    tmp_path: Path, kind: tuple[type[np.generic], tuple[int, ...]] | None
) -> None:
    frames, cut = video(30), [0, 9, 18, 30]
    groups = {
        f"traj_{number}": {"rgb": frames[start:end]} for number, (start, end) in enumerate(itertools.pairwise(cut))
    }
    if kind is not None:
        for inside in groups.values():
            inside["actions"] = np.zeros((len(inside["rgb"]) - 1, *kind[1]), kind[0])
    dataset = imported(trajectories(tmp_path / "a.h5", groups))
    assert dataset.lengths.tolist() == [9, 9, 12]
    np.testing.assert_array_equal(dataset.video(1), frames[9:18])


@pytest.mark.slow
def test_cameras_at_the_root_are_no_demonstrations(tmp_path: Path) -> None:
    frames = video(12)
    cameras = {f"cam_{number}": {"rgb": frames[6 * number :][:6], "stamps": np.arange(6)} for number in range(2)}
    file = trajectories(tmp_path / "a.h5", cameras)
    refused(file, "has 2 cameras; choose one:\n  --camera cam_0/rgb\n  --camera cam_1/rgb")
    posed = {name: inside | {"pose": np.zeros((6, 7))} for name, inside in cameras.items()}
    other = trajectories(tmp_path / "b.h5", posed | {"": {"action": np.zeros((6, 2))}})
    refused(other, "has 2 cameras; choose one:\n  --camera cam_0/rgb")
    np.testing.assert_array_equal(imported(file, replace(OPTIONS, camera="cam_1/rgb")).video(0), frames[6:])


def test_episodes_in_another_group_than_data_are_told_where_to_go(tmp_path: Path) -> None:
    episodes = {f"episodes/ep_{number}": {"rgb": video(6), "action": np.zeros((6, 2))} for number in range(2)}
    way_out = "--camera episodes/ep_1/rgb\nIf each is of another episode, move the episodes' groups into 'data'."
    refused(trajectories(tmp_path / "a.h5", episodes), re.escape(way_out))
    views = {"": {"front": video(6), "wrist": video(6)}}
    refused(trajectories(tmp_path / "b.h5", views), "--camera wrist$")


@pytest.mark.parametrize("shape", [(1, 7), (2, 3), (2, 3, 2)])
def test_actions_in_tables_of_tables_are_rows_of_numbers(tmp_path: Path, shape: tuple[int, ...]) -> None:
    """As of two arms."""
    actions = np.random.default_rng(0).uniform(size=(9, *shape))
    file = trajectories(tmp_path / "a.h5", {"/": {"top": video(9), "action": actions}})
    dataset = imported(file, replace(OPTIONS, actions="action"))
    np.testing.assert_array_equal(dataset.states(0).actions, actions.reshape(9, -1)[:8])
    one = Dataset.open(
        import_recordings(
            [file], tmp_path / "one", replace(OPTIONS, actions="action", action_fields=("action.5",))
        ).path
    )
    np.testing.assert_array_equal(one.states(0).actions[:, 0], actions.reshape(9, -1)[:8, 5])


def test_a_replay_buffer_is_told_to_be_cut(tmp_path: Path) -> None:
    buffer = {"data": {"img": video(6)}, "meta": {"episode_ends": np.array([3, 6])}}
    refused(
        trajectories(tmp_path / "a.h5", buffer),
        "no demonstrations in 'data': .* a group of its own.* are:\n  data/img 6 x .*\n  meta/episode_ends 2 int64",
    )


@pytest.mark.parametrize(
    ("name", "marks"),
    [
        ("terminals", [0, 0, 1, 0, 0, 1, 0, 0, 1]),
        ("timeouts", np.array([[0, 0, 1, 0, 1, 1, 0, 0, 0]], bool).T),
        ("dones", [0.0, 0.0, 1.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]),
        ("is_first", [1, 0, 0, 1, 0, 0, 1, 0, 0]),
        ("step_type", [0, 1, 2, 0, 1, 2, 0, 1, 2]),
    ],
)
def test_episodes_one_behind_the_other_are_no_single_one(tmp_path: Path, name: str, marks: object) -> None:
    """As D4RL and V-D4RL keep them: an episode would lead from the end of one to the beginning of the next."""
    buffer = {"/": {"observations": video(9), "actions": np.zeros((9, 2)), name: np.array(marks)}}
    refused(
        trajectories(tmp_path / "a.h5", buffer), rf"several episodes.*'{name}' tells of 2 ends among its 9 pictures"
    )


@pytest.mark.parametrize("marks", [[0] * 9, [0] * 8 + [1], [0, 0, 0, 0, 0, 1, 1, 1, 1], [1] * 9, [0, 0, 1, 0, 0, 1]])
def test_marks_of_a_single_episode_do_not_part_it(tmp_path: Path, marks: list[int]) -> None:
    groups = {"/": {"observations": video(9), "terminals": np.array(marks)}}
    assert imported(trajectories(tmp_path / "a.h5", groups)).lengths.tolist() == [9]


def test_a_demonstration_in_a_group_of_its_own_may_succeed_several_times(tmp_path: Path) -> None:
    """As robomimic's ``dones`` say it."""
    groups = {"data/demo_0": {"obs/top": video(9), "dones": np.array([0, 0, 0, 1, 0, 0, 1, 1, 1])}}
    assert imported(trajectories(tmp_path / "a.h5", groups)).lengths.tolist() == [9]


@pytest.mark.slow
@pytest.mark.parametrize("channels_first", [False, True])
@pytest.mark.parametrize("kind", [np.uint8, np.float16, np.float32, np.float64])
def test_pixels_may_have_their_channels_first_and_be_fractions(
    tmp_path: Path, channels_first: bool, kind: type[np.generic]
) -> None:
    frames = video(6, 24, 32)
    stored = frames if kind is np.uint8 else (frames / 255).astype(kind)
    file = trajectories(tmp_path / "a.h5", {"obs": {"top": np.moveaxis(stored, 3, 1) if channels_first else stored}})
    np.testing.assert_array_equal(imported(file, replace(OPTIONS, size=24)).video(0), frames[:, :, 4:28])


@pytest.mark.parametrize(("wrong", "told"), [(1.01, "0 to 1.01"), (-0.5, "-0.5 to 0"), (np.nan, "nan to nan")])
def test_numbers_that_are_no_fractions_are_no_pictures(tmp_path: Path, wrong: float, told: str) -> None:
    pictures = np.zeros((5, 8, 8, 3), np.float32)
    pictures[3, 2, 2, 1] = wrong
    refused(
        trajectories(tmp_path / "a.h5", {"obs": {"top": pictures}}),
        rf"has numbers of {told} in picture 3 of '/obs/top'; pictures are bytes .* Write them as bytes\.",
    )


def test_bytes_are_taken_rather_than_fractions_and_stacks_are_no_pictures(tmp_path: Path) -> None:
    frames, zeros = video(6), np.zeros((6, 32, 32, 3))
    obs = {"rgb": frames, "points": zeros, "depth": zeros[..., :1], "stack": np.zeros((6, 4, 32, 32), np.uint8)}
    file = trajectories(tmp_path / "a.h5", {"obs": obs})
    np.testing.assert_array_equal(imported(file).video(0), frames)


@pytest.mark.parametrize("packing", [{}, {"chunks": True, "compression": "gzip"}], ids=["plain", "gzip"])
@pytest.mark.parametrize("varying", [False, True], ids=["filled up", "varying"])
@pytest.mark.parametrize(("form", "options"), [("PNG", {}), ("WebP", {"lossless": True})])
def test_packed_pictures(tmp_path: Path, packing: Any, varying: bool, form: str, options: Any) -> None:
    frames = video(7)
    files = packed(frames, form, **options)
    path = aloha(tmp_path / "episode_0.hdf5", files if varying else filled_up(files), **packing)
    dataset = imported(path)
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert dataset.recipe.parameters["camera"] == CAM_HIGH


@pytest.mark.parametrize("kind", [np.bytes_, np.void], ids=["texts", "blocks"])
def test_pictures_packed_into_texts(tmp_path: Path, kind: type[np.generic]) -> None:
    """As RoboTwin's scripts write them, all as long as the longest."""
    frames = video(7)
    files = [file.tobytes() for file in packed(frames, "PNG")]
    texts = np.array([kind(file.ljust(max(map(len, files)), b"\0")) for file in files])
    names = [f"scene-{number}" for number in range(7)]
    file = trajectories(tmp_path / "a.h5", {"observation/head": {"rgb": texts, "scene": np.array(names, "S")}})
    dataset = imported(file)
    np.testing.assert_array_equal(dataset.video(0), frames)
    assert dataset.recipe.parameters["camera"] == "observation/head/rgb"


def test_packed_jpeg_keeps_its_colours(tmp_path: Path) -> None:
    frames = np.zeros((4, 32, 32, 3), np.uint8)
    frames[..., 0] = 200
    shown = imported(aloha(tmp_path / "episode_0.hdf5", filled_up(packed(frames, "JPEG")))).video(0)
    np.testing.assert_allclose(shown, frames, atol=3)


@pytest.mark.slow
def test_next_observations_are_no_second_camera(tmp_path: Path) -> None:
    frames = video(8)
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": frames})
    with h5py.File(file, "a") as opened:
        opened["data/demo_0"].create_dataset("next_obs/agentview_image", data=np.zeros_like(frames))
    report = import_recordings([file], tmp_path / "first", OPTIONS)
    np.testing.assert_array_equal(Dataset.open(report.path).video(0), frames)
    with h5py.File(file, "a") as opened:
        opened["data/demo_0"].create_dataset("old_obs/agentview_image", data=np.zeros_like(frames))
    both = "has 2 data sets 'agentview_image'; choose one:\n  --camera obs/agentview_image\n  --camera old_obs/agent"
    refused(file, both, ImportOptions(camera="agentview_image"))


def test_demonstrations_without_pictures_are_told(tmp_path: Path) -> None:
    frames = video(8)
    file = robomimic(tmp_path / "a.hdf5", {"demo_0": frames[:0], "demo_1": frames, "demo_2": frames[:0]})
    report = import_recordings([file], tmp_path / "out", OPTIONS)
    assert report.episodes == 1
    assert f"2 of the 3 demonstrations in {str(file)!r} hold no picture." in report.advice


def test_cameras_that_look_like_demonstrations_are_told_of(tmp_path: Path) -> None:
    views = {"cam_left": video(6), "cam_right": video(6, seed=1)}
    report = import_recordings([robomimic(tmp_path / "a.hdf5", views)], tmp_path / "out", OPTIONS)
    assert report.episodes == 2
    told = "are called 'cam_left', 'cam_right', and each is imported as a demonstration. If they are cameras of one, "
    assert any(told in one for one in report.advice)
    numbered = {f"demo_{number}": video(6, seed=number) for number in range(2)}
    plain = import_recordings([robomimic(tmp_path / "b.hdf5", numbered)], tmp_path / "plain", OPTIONS)
    assert not any("are called" in one for one in plain.advice)
