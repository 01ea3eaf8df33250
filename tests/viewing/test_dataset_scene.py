"""What an .rrd of a data set holds, read back and compared with the data set."""

from __future__ import annotations

import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import rerun.blueprint as rrb
from made_up_import import write_import
from noise_world import MOVES, noise_spec, write_noise
from pushed_squares import SPEC
from rrd_contents import lane, layout_of, read, rgba, static, tabs_of, values

from dmotion_bench.errors import StorageFull, ViewerError
from dmotion_bench.specs import MASK_AGENT
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.viewing.dataset import dataset_scene
from dmotion_bench.viewing.labels import _below, action_curves, brightened, log_numbers
from dmotion_bench.viewing.live import recording_to
from dmotion_bench.viewing.scene import Scene, Tab, recording_file, write_scene

EPISODE = 3
THINGS = [*SPEC.objects, SPEC.agent]


@pytest.fixture(scope="module")
def written(dataset: Dataset, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("dataset") / "scene.rrd"
    write_scene(dataset_scene(dataset, [1, EPISODE]), path)
    return path


def test_the_video_is_there_to_the_last_bit(dataset: Dataset, written: Path) -> None:
    for episode in (1, EPISODE):
        column = values(written, f"/episode_{episode}/camera", "Image:buffer")
        assert [frame for frame, _ in column] == list(range(8))
        shown = np.array([buffer for _, (buffer,) in column], np.uint8)
        np.testing.assert_array_equal(shown.reshape(8, 64, 64, 3), dataset.video(episode))


def test_only_the_episodes_asked_for(written: Path) -> None:
    assert {path.split("/")[1] for path in read(written)} - {"", "__properties"} == {"episode_1", f"episode_{EPISODE}"}


def test_what_a_training_is_given_of_the_labels_is_told(written: Path) -> None:
    (text,) = static(written, f"/episode_{EPISODE}/about", "TextDocument:text")
    assert "a training gets as many actions as its label budget allows, and nothing else" in text


def test_masks_and_their_legend_have_the_objects_own_colours(dataset: Dataset, written: Path) -> None:
    column = values(written, f"/episode_{EPISODE}/masks", "SegmentationImage:buffer")
    shown = np.array([buffer for _, (buffer,) in column], np.uint8).reshape(8, 64, 64)
    np.testing.assert_array_equal(shown, dataset.labels(EPISODE).masks)
    (legend,) = static(written, "/", "AnnotationContext:context")
    known = {one["class_id"]: one["class_description"]["info"] for one in legend}
    assert {number: known[number]["label"] for number in (1, 2, 3)} == {
        1: "green square",
        2: "red square",
        3: "blue square",
    }
    for number, thing in ((1, SPEC.agent), (2, SPEC.objects[0]), (3, SPEC.objects[1])):
        assert known[number]["color"] == rgba(thing.color)


@pytest.mark.parametrize(
    ("color", "shown"), [((35, 35, 40), (105, 105, 110)), ((0, 200, 0), (0, 200, 0)), ((0, 0, 0), (110, 110, 110))]
)
def test_dark_things_are_lifted_from_the_dark(color, shown) -> None:
    assert brightened(color) == shown


def test_a_name_stands_below_the_lower_end_of_a_thing() -> None:
    masks = np.zeros((1, 100, 100), np.uint8)
    for row in range(60):  # an arm that reaches in from the left at a slant
        masks[0, row, row : row + 6] = MASK_AGENT
    masks[0, 90:100, 40:51] = 2
    ((block, arm),) = _below(masks, [2, MASK_AGENT])
    assert abs(arm[0] - 61) <= 4  # its hand is at 59 to 64, its middle at 32
    assert arm[1] == 59
    assert block.tolist() == [45, 93]  # not outside the picture


def test_rings_are_around_the_things_and_gone_ones_have_none(dataset: Dataset, written: Path) -> None:
    labels = dataset.labels(EPISODE)
    pixel = np.concatenate([labels.objects.pixel, labels.agent.pixel], axis=1)
    for frame, centres in values(written, f"/episode_{EPISODE}/camera/places", "Ellipses2D:centers"):
        there = pixel[frame][np.isfinite(pixel[frame]).all(-1)]
        np.testing.assert_allclose(centres, np.tile(there + 0.5, (2, 1)))  # Rerun's pixels begin at their corners


def test_places_in_metres_are_named_after_their_things(dataset: Dataset, written: Path) -> None:
    labels = dataset.labels(EPISODE)
    path = f"/episode_{EPISODE}/world/things"
    ids = dict(values(written, path, "Points3D:class_ids"))
    places = dict(values(written, path, "Points3D:positions"))
    assert ids[0] == [2, 3, MASK_AGENT]
    assert ids[7] == [2, MASK_AGENT]  # the blue square is gone by then
    np.testing.assert_allclose(places[7], [*labels.objects.position[7, :1], *labels.agent.position[7]], rtol=1e-6)


def test_trails_follow_what_has_moved(dataset: Dataset, written: Path) -> None:
    labels = dataset.labels(EPISODE)
    path = f"/episode_{EPISODE}/camera/trails"
    strips, ids = (
        dict(values(written, path, "LineStrips2D:strips")),
        dict(values(written, path, "LineStrips2D:class_ids")),
    )
    trail = strips[5][ids[5].index(MASK_AGENT)]
    np.testing.assert_allclose(trail, labels.agent.pixel[:6, 0] + 0.5)
    assert all(3 not in at_frame for at_frame in ids.values())  # the blue square never moves


def test_the_lanes_say_what_happens(dataset: Dataset, written: Path) -> None:
    labels = dataset.labels(EPISODE)
    actions = [SPEC.actions.names[action] for action in labels.actions]
    assert lane(written, f"/episode_{EPISODE}/action", 8) == [*actions, None]
    moved = np.abs(np.diff(labels.objects.position[:, 0], axis=0)).max(-1) > SPEC.push_threshold
    expected = ["pushed" if now else None for now in moved]
    assert lane(written, f"/episode_{EPISODE}/pushed/red_square", 8) == [*expected, None]
    assert lane(written, f"/episode_{EPISODE}/pushed/blue_square", 8) == [*[None] * 5, "pushed", "gone", "gone"]
    colors = static(written, f"/episode_{EPISODE}/pushed/red_square", "StateConfiguration:colors")
    assert colors[0] == rgba(SPEC.objects[0].color)


def test_it_plays_at_the_pace_of_the_recording(dataset: Dataset, written: Path) -> None:
    panel = layout_of(written)["/time_panel"]
    assert panel["TimePanelBlueprint:timeline"] == ["frame"]
    assert panel["TimePanelBlueprint:fps"] == [1e9 / dataset.spec.step_ns]
    assert tabs_of(written) == ["Episode 1", f"Episode {EPISODE}"]


def test_the_text_says_which_split_an_episode_is_of(dataset: Dataset, rrd: Path) -> None:
    episodes = {name: int(dataset.split(name)[0]) for name in ("train", "validation", "test")}
    write_scene(dataset_scene(dataset, list(episodes.values())), rrd)
    for name, episode in episodes.items():
        (text,) = static(rrd, f"/episode_{episode}/about", "TextDocument:text")
        assert f"in the **{name}** split" in text
        assert f"episodes of `{dataset.recipe.environment}`, policy `{dataset.recipe.policy}`" in text


def test_without_labels_the_video_is_shown_alone(dataset: Dataset, tmp_path: Path, rrd: Path) -> None:
    copy = tmp_path / "unlabelled"
    shutil.copytree(dataset.path, copy)
    shutil.rmtree(copy / "labels")
    write_scene(dataset_scene(Dataset.open(copy), [0]), rrd)
    assert {path for path in read(rrd) if path.startswith("/episode")} == {"/episode_0/camera", "/episode_0/about"}
    assert "no labels" in static(rrd, "/episode_0/about", "TextDocument:text")[0]


def test_where_nobody_knows_of_objects_no_lane_says_that_none_moves(
    dataset: Dataset, tmp_path: Path, rrd: Path
) -> None:
    write_scene(dataset_scene(write_import(tmp_path / "import", dataset), [0]), rrd)
    assert "/episode_0/action" in read(rrd)
    assert "/episode_0/moved" not in read(rrd)


def test_a_file_whose_end_could_not_be_written_is_not_kept(
    dataset: Dataset, rrd: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Rerun writes in a thread of its own, and does not say it when the disk is full at the very end."""
    write_scene(dataset_scene(dataset, [0]), rrd)
    whole = rrd.read_bytes()
    cut = rrd.with_name("cut.rrd")

    with pytest.raises(ViewerError, match="its end is missing"), recording_file(cut) as file:
        file.write_bytes(whole[:-100])
    with recording_file(cut) as file:
        file.write_bytes(whole)
    assert cut.read_bytes() == whole

    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=100))
    with pytest.raises(StorageFull, match="no space left"), recording_file(cut):
        raise AssertionError("Rerun would wait for ever")
    assert cut.read_bytes() == whole
    assert sorted(path.name for path in rrd.parent.iterdir()) == sorted(("cut.rrd", rrd.name))


def test_two_commands_can_write_the_same_file(dataset: Dataset, rrd: Path) -> None:
    write_scene(dataset_scene(dataset, [0]), rrd)
    whole, file = rrd.read_bytes(), rrd.with_name("both.rrd")
    beside = file.with_name("both.rrd.part")
    beside.write_text("somebody else's")
    with recording_file(file) as first:
        first.write_bytes(whole)
        with recording_file(file) as second:
            second.write_bytes(whole * 2)
        assert file.read_bytes() == whole * 2
    assert file.read_bytes() == whole
    assert beside.read_text() == "somebody else's"
    beside.unlink()
    assert sorted(path.name for path in rrd.parent.iterdir()) == ["both.rrd", rrd.name]


def test_what_fails_while_a_recording_is_made_is_not_laid_to_the_file(rrd: Path) -> None:
    with pytest.raises(RuntimeError, match="shapes do not fit"), recording_to("work", rrb.Blueprint(), file=rrd):
        raise RuntimeError("shapes do not fit")
    assert not list(rrd.parent.iterdir())


def test_a_file_is_replaced_whole_or_not_at_all(dataset: Dataset, rrd: Path) -> None:
    scene = dataset_scene(dataset, [0])
    write_scene(scene, rrd)
    before = rrd.read_bytes()

    def fail(_recording: object) -> None:
        raise KeyError

    with pytest.raises(KeyError):
        write_scene(type(scene)(name="broken", tabs=scene.tabs, step_ns=1, background=fail), rrd)
    assert rrd.read_bytes() == before
    assert [path.name for path in rrd.parent.iterdir()] == [rrd.name]


def test_continuous_actions_are_a_curve_a_number(tmp_path: Path, rrd: Path) -> None:
    moved = write_noise(tmp_path / "noise", spec=noise_spec(actions=MOVES))
    actions = moved.states(0).actions
    tab = Tab(
        name="actions",
        layout=rrb.Horizontal(action_curves("/episode_0")),
        log=lambda recording: log_numbers(recording, "/episode_0/action", MOVES, actions),
    )
    scene = Scene(name="noise", tabs=(tab,), step_ns=moved.spec.step_ns, background=lambda recording: None)
    write_scene(scene, rrd)
    for place in range(MOVES.width):
        column = values(rrd, f"/episode_0/action/{place}", "Scalars:scalars")
        assert [frame for frame, _ in column] == list(range(len(actions)))
        assert [number for _, (number,) in column] == actions[:, place].tolist()
