"""A recording goes on after anything, and a folder never holds two recipes."""

from __future__ import annotations

import dataclasses
import os
from pathlib import Path

import pytest
from killed_writes import each_kill
from noise_world import files_of, noise_episode, noise_lengths, noise_spec, write_noise

from dmotion_bench.errors import DatasetError, FolderInUse, RecipeMismatch, StorageFull, UsageError
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.atomic import atomic_file
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import FolderLock
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.staging import staged
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.versions import with_earlier

SPEC = noise_spec()
RECIPE = DatasetRecipe(environment="noise", episodes=7, frames=6, shard_episodes=3)


def write_shard(writer: DatasetWriter, index: int) -> None:
    lengths = noise_lengths(writer.recipe.episodes)
    writer.write_shard(index, (noise_episode(one, lengths[one], SPEC) for one in writer.episodes_of(index)))


def test_shards_in_any_order_and_after_interruptions_give_the_same_bytes(tmp_path: Path) -> None:
    write_noise(tmp_path / "at once")
    for index in (2, 0, 1):
        with DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC) as writer:
            assert index in writer.missing
            write_shard(writer, index)
            if not writer.missing:
                writer.finish()
    assert files_of(tmp_path / "d") == files_of(tmp_path / "at once")


def test_extending_keeps_full_shards_and_gives_what_recording_at_once_gives(tmp_path: Path) -> None:
    write_noise(tmp_path / "d", episodes=7)
    before = files_of(tmp_path / "d")
    extended = dataclasses.replace(RECIPE, episodes=11)
    with DatasetWriter.create_or_resume(tmp_path / "d", extended, SPEC) as writer:
        assert writer.missing == (2, 3)  # shard 2 had one episode of three
        for index in writer.missing:
            write_shard(writer, index)
        writer.finish()
    after = files_of(tmp_path / "d")
    for index in (0, 1):
        for kind in ("video", "labels"):
            assert after[f"{kind}/shard-0000{index}.mcap"] == before[f"{kind}/shard-0000{index}.mcap"]
    write_noise(tmp_path / "at once", episodes=11)
    assert after == files_of(tmp_path / "at once")


@pytest.mark.parametrize("kind", ["video", "labels"])
def test_a_shard_that_was_damaged_is_written_anew_when_a_data_set_is_extended(tmp_path: Path, kind: str) -> None:
    """Else the hash of the damaged file would become the one that is stated."""
    path = write_noise(tmp_path / "d", episodes=6).path
    damaged = path / kind / "shard-00000.mcap"
    content = bytearray(damaged.read_bytes())
    content[len(content) * 2 // 5] ^= 0x10
    damaged.write_bytes(content)
    write_noise(path, episodes=9)
    assert files_of(path) == files_of(write_noise(tmp_path / "at once", episodes=9).path)


def test_what_goes_on_with_other_packages_names_those_of_before_too(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    stated = []
    for index, numpy in enumerate(("1.0", "2.0", "2.0")):
        monkeypatch.setattr("dmotion_bench.storage.writer.versions", lambda _, numpy=numpy: {"numpy": numpy})
        with DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC) as writer:
            assert writer.versions == {"numpy": numpy}
            stated.append(Manifest.read(tmp_path / "d").versions)
            write_shard(writer, index)
            if not writer.missing:
                writer.finish()
    assert stated == [{"numpy": "1.0"}, {"numpy": "1.0, 2.0"}, {"numpy": "1.0, 2.0"}]
    assert Dataset.open(tmp_path / "d").manifest.versions == {"numpy": "1.0, 2.0"}


def test_what_was_begun_with_other_packages_and_holds_no_shard_names_only_those_of_now(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for numpy in ("1.0", "2.0"):
        monkeypatch.setattr("dmotion_bench.storage.writer.versions", lambda _, numpy=numpy: {"numpy": numpy})
        DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC).close()
    assert Manifest.read(tmp_path / "d").versions == {"numpy": "2.0"}


def test_versions_beyond_the_last_eight_are_left_out() -> None:
    stated: dict[str, str] = {}
    for version in range(20):
        stated = with_earlier(stated, {"numpy": f"{version}.0"})
    assert stated == {"numpy": ", ".join(f"{version}.0" for version in range(12, 20))}


def test_while_it_is_extended_a_data_set_is_incomplete(tmp_path: Path) -> None:
    write_noise(tmp_path / "d", episodes=7)
    DatasetWriter.create_or_resume(tmp_path / "d", dataclasses.replace(RECIPE, episodes=11), SPEC).close()
    with pytest.raises(DatasetError, match="--episodes 11"):
        Dataset.open(tmp_path / "d")


@pytest.mark.parametrize(
    ("change", "says"),
    [
        ({"seed": 1}, "seed is 0 there and 1 here"),
        ({"frames": 9}, "frames is 6 there and 9 here"),
        ({"environment": "other"}, "environment is 'noise' there and 'other' here"),
        ({"parameters": {"objects": 2}}, "parameters is {} there and {'objects': 2} here"),
        ({"episodes": 6}, "7 episodes, more than the 6 asked for"),
    ],
)
def test_another_recipe_is_refused_and_says_what_differs(tmp_path: Path, change: dict[str, object], says: str) -> None:
    write_noise(tmp_path / "d")
    before = files_of(tmp_path / "d")
    with pytest.raises(RecipeMismatch) as caught:
        DatasetWriter.create_or_resume(tmp_path / "d", dataclasses.replace(RECIPE, **change), SPEC)  # type: ignore[arg-type]
    assert says in str(caught.value)
    assert "--out" in str(caught.value)
    assert files_of(tmp_path / "d") == before


def test_an_environment_that_has_changed_is_another_recipe(tmp_path: Path) -> None:
    write_noise(tmp_path / "d")
    with pytest.raises(RecipeMismatch, match="has changed"):
        DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, dataclasses.replace(SPEC, step_ns=1))


def test_a_folder_with_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("ten years of work")
    with pytest.raises(UsageError, match="is not empty"):
        DatasetWriter.create_or_resume(tmp_path, RECIPE, SPEC)
    assert [file.name for file in tmp_path.iterdir()] == ["thesis.tex"]


def test_two_writers_do_not_share_a_folder(tmp_path: Path) -> None:
    first = DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC)
    with pytest.raises(FolderInUse, match=r"another dmbench .* or name another folder with '--out DIR'"):
        DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC)
    first.close()
    DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC).close()


def test_what_a_killed_process_leaves_is_taken_away_or_written_anew(tmp_path: Path) -> None:
    whole = files_of(write_noise(tmp_path / "whole").path)
    folder = write_noise(tmp_path / "d").path
    (folder / "video" / "shard-00002.mcap.00000123.part").write_bytes(b"half")
    (folder / "video" / "shard-00001.mcap").unlink()  # its labels were renamed first, then came the end
    (folder / "labels" / "shard-00002.mcap").write_bytes(b"\x89MCAP0\r\n")  # a broken disk
    with DatasetWriter.create_or_resume(folder, RECIPE, SPEC) as writer:
        assert writer.missing == (1, 2)
        for index in writer.missing:
            write_shard(writer, index)
        writer.finish()
    assert files_of(folder) == whole


def record(folder: Path) -> None:
    with DatasetWriter.create_or_resume(folder, RECIPE, SPEC) as writer:
        for index in writer.missing:
            write_shard(writer, index)
        writer.finish()


@pytest.mark.slow
def test_a_recording_that_was_killed_at_any_moment_goes_on(tmp_path: Path) -> None:
    whole, kills = files_of(write_noise(tmp_path / "whole").path), 0
    for moment in each_kill(lambda moment: record(tmp_path / f"{moment}")):
        record(tmp_path / f"{moment}")
        assert files_of(tmp_path / f"{moment}") == whole
        kills += 1
    assert kills > 20


def test_a_recipe_is_compared_with_what_another_writer_has_just_finished(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One that held the lock while this one was about to ask for it."""

    def late(path: Path, way_out: str) -> FolderLock:
        monkeypatch.undo()
        write_noise(path)
        return FolderLock(path, way_out)

    monkeypatch.setattr("dmotion_bench.storage.writer.FolderLock", late)
    with pytest.raises(RecipeMismatch, match="seed is 0 there and 1 here"):
        DatasetWriter.create_or_resume(tmp_path / "d", dataclasses.replace(RECIPE, seed=1), SPEC)
    assert len(Dataset.open(tmp_path / "d")) == 7


def test_only_a_folder_without_a_whole_shard_is_withdrawn(tmp_path: Path) -> None:
    with DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC) as writer:
        assert writer.withdraw() == "Nothing is recorded."
        assert not writer.path.exists()
    with DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC) as writer:
        write_shard(writer, 1)
        assert "3 of 7 episodes are recorded and kept; once the cause is mended, the same" in writer.withdraw()
    record(tmp_path / "d")
    assert files_of(tmp_path / "d") == files_of(write_noise(tmp_path / "whole").path)


def test_finish_wants_every_shard(tmp_path: Path) -> None:
    with DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC) as writer:
        write_shard(writer, 0)
        with pytest.raises(DatasetError, match="2 shards"):
            writer.finish()


def test_a_file_gets_its_name_after_its_bytes_are_safe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Bytes to the disk, then the name, then the name to the disk."""
    happened: list[str] = []
    rename = Path.replace

    def fsync(handle: int) -> None:
        happened.append("folder" if Path(f"/proc/self/fd/{handle}").resolve().is_dir() else "file")

    def replace(self: Path, target: Path) -> Path:
        happened.append("rename")
        return rename(self, target)

    monkeypatch.setattr(os, "fsync", fsync)
    monkeypatch.setattr(Path, "replace", replace)
    with atomic_file(tmp_path / "x") as file:
        file.write(b"bytes")
        assert not (tmp_path / "x").exists()
    assert happened == ["file", "rename", "folder"]


def test_a_folder_gets_its_name_after_its_files_are_safe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    synced: list[str] = []
    monkeypatch.setattr(os, "fsync", lambda handle: synced.append(Path(f"/proc/self/fd/{handle}").resolve().name))
    with staged(tmp_path / "out", ".exporting") as folder:
        (folder / "meta").mkdir()
        (folder / "meta" / "info.json").write_text("{}")
    assert set(synced) == {"content", "meta", "info.json", tmp_path.name}
    assert synced[-1] == tmp_path.name  # the folder's own name
    assert (tmp_path / "out" / "meta" / "info.json").read_text() == "{}"


def test_an_error_while_writing_leaves_the_old_file(tmp_path: Path) -> None:
    (tmp_path / "x").write_bytes(b"old")

    def write_half() -> None:
        with atomic_file(tmp_path / "x") as file:
            file.write(b"new")
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        write_half()
    assert [(one.name, one.read_bytes()) for one in tmp_path.iterdir()] == [("x", b"old")]


def test_a_full_disk_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As Linux says it; tests/recording fills a real file system."""

    def fsync(handle: int) -> None:
        raise OSError(28, "No space left on device")

    with DatasetWriter.create_or_resume(tmp_path / "d", RECIPE, SPEC) as writer:
        monkeypatch.setattr(os, "fsync", fsync)
        with pytest.raises(StorageFull, match="run the same command again"):
            write_shard(writer, 0)
    assert not list((tmp_path / "d" / "video").iterdir())
