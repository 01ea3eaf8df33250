"""The user's clips as a background: the recipe holds what they are, and nothing makes anybody read a path."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from noise_world import files_of
from storage.foreign_video import moving, video_file

import dmotion_bench as dm
from dmotion_bench.errors import InvalidSetting, RecordingImportError, UnknownName
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import environment_facts, record_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.fitting import Fit, fitted
from dmotion_bench.storage.manifest import record_words
from recorders.distractors import clips
from recorders.distractors.background import muted
from recorders.distractors.clips import EDGE, SIZE, load_clips, prepared_clips
from recorders.grid_world import GridWorld


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with two clips, and a workspace beside it."""
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path / "workspace"))
    (tmp_path / "mine").mkdir()
    video_file(tmp_path / "mine" / "a.mkv", moving(12), "ffv1")
    video_file(tmp_path / "mine" / "b.mkv", moving(20)[::-1], "ffv1", rate=20)
    return tmp_path / "mine"


@pytest.mark.slow
def test_clips_are_what_the_videos_show_at_ten_pictures_a_second(folder: Path) -> None:
    pictures = load_clips(prepared_clips(str(folder)))
    assert pictures.lengths.tolist() == [12, 10]
    wanted = [muted(fitted(picture, SIZE, Fit.CROP)) for picture in (*moving(12), *moving(20)[::-1][::2])]
    np.testing.assert_array_equal(pictures.frames, wanted)


@pytest.mark.slow
def test_a_recording_shows_them_behind_agent_and_objects(folder: Path) -> None:
    pictures = load_clips(prepared_clips(str(folder)))
    env = GridWorld(clips=prepared_clips(str(folder)), background=1.0)
    known = {picture[EDGE:-EDGE, EDGE:-EDGE].tobytes() for picture in pictures.frames}
    known |= {picture[EDGE:-EDGE, ::-1][:, EDGE:-EDGE].tobytes() for picture in pictures.frames}
    shown = list[bytes]()
    frame, info = env.reset(seed=2)
    for _ in range(6):
        behind = env.masks() == 0
        match = [one for one in known if (np.frombuffer(one, np.uint8).reshape(frame.shape) == frame)[behind].all()]
        assert match
        shown += match
        frame = env.step(int(np.flatnonzero(env.legal_actions())[0]))[0]
    assert len(set(shown)) >= 3  # it plays
    assert info["factors"] == {"background": 1.0, "background/texture": "clips"}


@pytest.mark.slow
def test_the_recipe_holds_their_hash_and_decides_the_bytes(folder: Path, tmp_path: Path) -> None:
    def asked(clips: str) -> tuple[str, ...]:
        return (f"clips={clips}", "shake=2")

    recipe = replace(recipe_for("grid_world", episodes=3, frames=6, tasks=0, settings=asked(str(folder))), seed=1)
    assert str(folder) not in repr(recipe)
    assert len(str(recipe.parameters["clips"])) == 64
    record_dataset(tmp_path / "one", replace(recipe, shard_episodes=2))
    (folder / "a.mkv").unlink()  # what was prepared is enough
    record_dataset(tmp_path / "two", replace(recipe, shard_episodes=2), LocalExecutor(2))
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")
    assert f"clips={recipe.parameters['clips']}" in record_words(Dataset.open(tmp_path / "one").recipe, tmp_path)
    again = recipe_for("grid_world", episodes=3, frames=6, tasks=0, settings=asked(str(recipe.parameters["clips"])))
    assert again.parameters == recipe.parameters
    other = recipe_for("grid_world", episodes=3, frames=6, tasks=0, settings=asked(str(folder)))
    assert other.parameters["clips"] != recipe.parameters["clips"]  # another content of the same folder


@pytest.mark.slow
@pytest.mark.parametrize("workers", [1, 2])
def test_they_are_kept_in_the_workspace_that_a_call_names(folder: Path, tmp_path: Path, workers: int) -> None:
    """Not in that of the process; the processes that record look there, too."""
    there = tmp_path / "named"
    small = {"episodes": 3, "frames": 4, "tasks": 0, "workers": workers}
    recorded = dm.record("grid_world", "tiny", settings={"clips": str(folder)}, workspace=there, **small)
    assert recorded.dataset == there / "data" / "grid_world-tiny"
    assert [file.parent for file in tmp_path.rglob("*.safetensors")] == [there / "clips"]
    with pytest.raises(InvalidSetting, match="are not here"):
        environment_facts(Dataset.open(recorded.dataset).recipe)  # after the call it is the process's own again


@pytest.mark.slow
def test_clips_that_are_gone_or_changed_are_refused(folder: Path, tmp_path: Path) -> None:
    recipe = recipe_for("grid_world", settings=[f"clips={folder}"])
    (kept,) = (tmp_path / "workspace" / "clips").iterdir()
    content = kept.read_bytes()
    kept.write_bytes(content[:-1] + bytes([content[-1] ^ 1]))
    with pytest.raises(InvalidSetting, match=r"does not hold the clips of the recipe.*--set clips=FOLDER"):
        environment_facts(recipe)
    kept.unlink()
    with pytest.raises(InvalidSetting, match="are not here: there is no"):
        environment_facts(recipe)


@pytest.mark.slow
def test_a_path_in_a_recipe_is_never_read(folder: Path) -> None:
    with pytest.raises(InvalidSetting, match=r"is no SHA-256 of prepared clips"):
        GridWorld(clips=str(folder))
    with pytest.raises(InvalidSetting, match="of textures or of clips"):
        GridWorld(clips=prepared_clips(str(folder)), textures="leaves")
    env = GridWorld(clips=prepared_clips(str(folder)))
    with pytest.raises(UnknownName, match="known: clips"):
        env.reset(seed=0, options={"background/texture": "leaves"})


def test_of_too_many_clips_the_first_ones_are_taken(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(clips, "MOST_PICTURES", 3)  # not two for each of the clips
    assert load_clips(prepared_clips(str(folder))).lengths.tolist() == [2]


@pytest.mark.parametrize("bad", ["absent", "empty", "text", "cut", "still"])
def test_folders_without_a_whole_video_are_a_sentence(bad: str, folder: Path, tmp_path: Path) -> None:
    place = tmp_path / bad
    sentence = {
        "absent": "there is no '",
        "empty": "holds no recording",
        "text": "is no MP4, MKV, WebM or AVI file",
        "cut": "cut off|damaged",
        "still": "lasts two pictures",
    }[bad]
    if bad != "absent":
        place.mkdir()
    if bad == "text":
        (place / "a.mp4").write_text("not a video at all, whatever it is called")
    elif bad == "cut":
        (place / "a.mkv").write_bytes((folder / "a.mkv").read_bytes()[:3000])
    elif bad == "still":
        video_file(place / "a.mkv", moving(1), "ffv1")
    with pytest.raises((RecordingImportError, InvalidSetting), match=sentence):
        recipe_for("grid_world", settings=[f"clips={place}"])
    assert not (tmp_path / "workspace").exists()
