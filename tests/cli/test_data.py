"""``dmbench data info``, ``check`` and ``repair``: what they print, and how they end."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from dmbench_command import Outcome, dmbench
from killed_writes import Killed
from noise_world import files_of, write_noise
from storage.foreign import foxglove_file, steady, video

from dmotion_bench.cli.progress import QUIET
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.repair import salvage

Run = Callable[..., Outcome]
RECIPE = DatasetRecipe(environment="grid_world", episodes=10, frames=5, tasks=2, shard_episodes=4)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("data") / "grid"
    record_dataset(path, RECIPE)
    return path


@pytest.fixture
def folder(recorded: Path, tmp_path: Path) -> Path:
    """The only data set of the workspace."""
    shutil.copytree(recorded, tmp_path / "data" / "grid")
    return tmp_path / "data" / "grid"


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(("data", *words), capsys, monkeypatch)


def test_info_says_how_it_was_made(run: Run, folder: Path) -> None:
    said = run("info").out
    for part in ("grid_world, policy random, seed 0", "10: 8 train, 1 validation, 1 test", "50 frames in 3 shards"):
        assert part in said


def test_one_shard_is_one_shard(run: Run, tmp_path: Path) -> None:
    record_dataset(tmp_path / "data" / "small", DatasetRecipe(environment="grid_world", episodes=2, frames=5))
    assert "10 frames in 1 shard\n" in run("info").out


def test_info_names_what_was_set_and_what_varies(run: Run, folder: Path) -> None:
    manifest = folder / "dataset.json"
    content = json.loads(manifest.read_text())
    content["recipe"] |= {"parameters": {"scene": "distracted", "version": 2}, "vary": ["noise", "shake"]}
    manifest.write_text(json.dumps(content | {"complete": False, "shards": [], "tables": {}}))
    assert "policy random, seed 0, scene=distracted, version=2, varying noise, shake\n" in run("info").out


def test_info_of_an_import_names_what_matters(run: Run, tmp_path: Path) -> None:
    files = [foxglove_file(tmp_path / f"bag_{number}.mcap", video(4, seed=number), steady(4)) for number in range(12)]
    for name, some in (("many", files), ("two", files[:2])):
        assert run("import", *map(str, some), "--size", "16", "--out", str(tmp_path / "data" / name)).code == 0
    said = run("info", "many").out
    made_by = "import of 12 recordings: bag_0.mcap ... bag_11.mcap; seed 0, camera=/camera, size=16, hz=10.0, fit=crop"
    assert f"made by      {made_by}\n" in said
    (made_with,) = [line for line in said.splitlines() if line.startswith("made with")]
    assert "numpy" in made_with
    assert not any(simulator in made_with for simulator in ("gymnasium", "pymunk", "pybullet"))
    assert "import of 2 recordings: bag_0.mcap, bag_1.mcap; seed 0" in run("info", "two").out
    told = json.loads(run("info", "many", "--json").out)
    assert len(told["recipe"]["parameters"]["sha256_11"]) == 64


def test_info_as_json(run: Run, folder: Path) -> None:
    told = json.loads(run("info", "grid", "--json").out)
    assert told["recipe"]["environment"] == "grid_world"
    assert (told["episodes"], told["frames"], told["labels"], told["complete"]) == (10, 50, "present", True)
    assert told["video_bytes"] == sum(file.stat().st_size for file in (folder / "video").iterdir())
    assert told["split"] == {"train": 8, "validation": 1, "test": 1}


def test_info_of_an_unfinished_recording_says_how_to_go_on(run: Run, folder: Path) -> None:
    manifest = folder / "dataset.json"
    content = json.loads(manifest.read_text())
    manifest.write_text(json.dumps(content | {"complete": False, "shards": [], "tables": {}}))
    outcome = run("info")
    assert outcome.code == 0
    assert "not finished: 3 of 3 shards are there" in outcome.out
    assert "dmbench record grid_world --episodes 10 --frames 5 --tasks 2 --seed 0 --set version=1 --out" in outcome.out
    checked = run("check")
    assert checked.code == 1
    assert "dmbench record grid_world" in checked.sentence()


def test_info_prints_nothing_that_moves_the_cursor(run: Run, folder: Path) -> None:
    manifest = folder / "dataset.json"
    content = json.loads(manifest.read_text())
    content["recipe"]["policy"] = "random\x1b[2J\nstate        complete"
    content["versions"]["numpy"] = "2\r\x07"
    manifest.write_text(json.dumps(content | {"complete": False, "shards": [], "tables": {}}))
    said = run("info").out
    assert said.replace("\n", "").isprintable()
    assert r"policy random\x1b[2J\nstate        complete, seed 0" in said
    assert not any(line.startswith("state        complete") for line in said.splitlines())


def test_a_sound_data_set(run: Run, folder: Path) -> None:
    assert run("check").out == f"{folder} is sound: 10 episodes, 50 frames, labels present.\n"
    assert json.loads(run("check", "--json").out) == {
        "dataset": str(folder),
        "sound": True,
        "damages": [],
        "labels": "present",
        "episodes": 10,
        "frames": 50,
    }
    assert "nothing was changed" in run("repair").out


def test_a_flipped_byte_is_found_and_mended(run: Run, folder: Path) -> None:
    before = files_of(folder)
    file = folder / "video" / "shard-00001.mcap"
    content = bytearray(file.read_bytes())
    content[2000] ^= 1
    file.write_bytes(content)
    checked = run("check")
    assert checked.code == 1
    assert checked.out == "video/shard-00001.mcap has other bytes than were recorded\n"
    assert f"dmbench data repair {folder}" in checked.sentence()
    assert json.loads(run("check", "--json").out)["damages"][0]["file"] == "video/shard-00001.mcap"
    mended = run("repair", "--json")
    assert json.loads(mended.out) == {
        "dataset": str(folder),
        "how": "restored",
        "shards": [1],
        "episodes_lost": [],
        "original": None,
    }
    assert files_of(folder) == before


def test_a_repair_that_loses_episodes_says_which_and_where_the_original_is(run: Run, tmp_path: Path) -> None:
    folder = write_noise(tmp_path / "data" / "noise").path
    file = folder / "video" / "shard-00001.mcap"
    file.write_bytes(file.read_bytes()[:100])
    outcome = run("repair")
    assert outcome.code == 0
    assert "4 episodes were kept and 3 are lost" in outcome.out
    assert str(folder.parent / "damaged" / "noise") in outcome.out
    assert run("check").code == 0  # the repaired one is still the only one of the workspace


@pytest.mark.parametrize("command", ["info", "check", "repair"])
def test_what_is_not_there_is_named(run: Run, command: str, tmp_path: Path) -> None:
    missing = run(command)
    assert missing.code == 1
    assert "dmbench record" in missing.sentence()
    write_noise(tmp_path / "data" / "noise-tiny")
    misspelt = run(command, "noise-tny")
    assert misspelt.code == 2
    assert "did you mean 'noise-tiny'?" in misspelt.sentence()


def test_a_recording_is_no_data_set_yet(run: Run, tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(b"")
    failed = run("info", str(tmp_path / "a.mcap"))
    assert failed.code == 1
    assert "is a file, no data set; a recording becomes one with 'dmbench data import" in failed.sentence()


def test_another_version_of_the_format(run: Run, folder: Path) -> None:
    manifest = folder / "dataset.json"
    manifest.write_text(manifest.read_text().replace("dmbench/1", "dmbench/9"))
    for command in ("info", "check", "repair"):
        outcome = run(command)
        assert outcome.code == 1
        assert "'dmbench/9'" in outcome.sentence()


@pytest.mark.parametrize("how", ["by name", "by path", "as the only one", "on another disk"])
def test_a_repair_that_was_killed_at_its_end_is_finished(
    tmp_path: Path, run: Run, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    """The damaged original is moved away already, and nothing stands in its place."""
    path = write_noise(tmp_path / ("disk" if how == "on another disk" else "data") / "noise").path
    if how == "on another disk":
        (tmp_path / "data").mkdir()
        (tmp_path / "data/noise").symlink_to(path)
    (path / "video/shard-00001.mcap").write_bytes(b"nothing left")
    rename, killed = Path.rename, False

    def kill_after_the_first(moved: Path, to: Path) -> Path:
        nonlocal killed
        if killed:
            raise Killed
        killed = True
        return rename(moved, to)

    with monkeypatch.context() as patch:
        patch.setattr(Path, "rename", kill_after_the_first)
        with pytest.raises(Killed):
            salvage(path)
    assert not path.exists()
    monkeypatch.delenv(QUIET, raising=False)
    words = {"by path": [str(path)], "as the only one": []}.get(how, ["noise"])
    said = run("repair", *words)
    assert (said.code, said.out.strip()) == (0, f"{tmp_path / 'data/noise'} is sound; nothing was changed.")
    assert "noise is there again: its repair was killed at its end" in said.err
    assert [one.name for one in sorted(path.parent.iterdir())] == ["damaged", "noise"]
