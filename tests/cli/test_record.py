"""``dmbench record``: what it prints, and that nothing that goes wrong costs more than a sentence."""

from __future__ import annotations

import json
import shlex
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest
from dmbench_command import Outcome, dmbench, finish, never_ending, start_dmbench
from noise_world import files_of

from dmotion_bench.sharing.place import plain_name
from dmotion_bench.storage.dataset import Dataset

Run = Callable[..., Outcome]
MANY = ("record", "grid_world", "--preset", "tiny", "--episodes", "2000", "--workers", "1", "--out")


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(words, capsys, monkeypatch)


def test_json_has_the_names_that_scripts_rely_on(run: Run, tmp_path: Path) -> None:
    outcome = run("record", "grid_world", "--preset", "tiny", "--json")
    assert (outcome.code, outcome.err) == (0, "")
    result = json.loads(outcome.out)
    assert set(result) == {"dataset", "episodes", "frames", "frames_per_s", "bytes_per_frame", "tasks"}
    assert result["dataset"] == str(tmp_path / "data" / "grid_world-tiny")
    assert (result["episodes"], result["frames"]) == (20, 240)
    assert result["frames_per_s"] > 0
    files = [file for kind in ("video", "labels") for file in (tmp_path / "data/grid_world-tiny" / kind).iterdir()]
    assert result["bytes_per_frame"] == round(sum(file.stat().st_size for file in files) / 240, 1)
    assert len(Dataset.open(Path(result["dataset"]))) == 20


@pytest.mark.slow
def test_the_same_command_completes_and_a_larger_number_extends(run: Run, tmp_path: Path) -> None:
    words = ("record", "grid_world", "--preset", "tiny", "--workers", "1")
    assert run(*words, "--episodes", "25").code == 0
    assert "the data set was complete already" in run(*words, "--episodes", "25").out
    first = files_of(tmp_path / "data" / "grid_world-tiny")
    assert run(*words, "--episodes", "45", "--json").code == 0
    assert run(*words, "--episodes", "45", "--out", str(tmp_path / "at once")).code == 0
    extended = files_of(tmp_path / "data" / "grid_world-tiny")
    assert extended == files_of(tmp_path / "at once")
    assert extended["video/shard-00000.mcap"] == first["video/shard-00000.mcap"]


@pytest.mark.parametrize(
    ("words", "says", "code"),
    [
        (("grid_wrold",), "no environment named 'grid_wrold'; did you mean 'grid_world'?", 2),
        (("grid_world", "--preset", "tinny"), "no preset named 'tinny'; did you mean 'tiny'?", 2),
        (
            ("planar_push", "--vary", "ligth"),
            "named 'ligth'; did you mean 'light'? Known: background, camera",
            2,
        ),
        (("grid_world", "--executor", "locla"), "no executor named 'locla'; did you mean 'local'?", 2),
    ],
)
def test_a_misspelt_name_gets_the_one_that_was_meant(
    run: Run, words: tuple[str, ...], says: str, code: int, tmp_path: Path
) -> None:
    outcome = run("record", *words)
    assert outcome.code == code
    assert says in outcome.sentence()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("words", [("--episodes", "0"), ("--frames", "1"), ("--workers", "0"), ("--colour", "red")])
def test_an_impossible_value_is_wrong_usage(run: Run, words: tuple[str, ...]) -> None:
    outcome = run("record", "grid_world", *words)
    assert outcome.code == 2
    assert words[0] in outcome.err


def test_fewer_tasks_than_asked_for_are_said(run: Run, tmp_path: Path) -> None:
    outcome = run("record", "grid_world", "--preset", "tiny", "--tasks", "100000")
    stored = len(Dataset.open(tmp_path / "data" / "grid_world-tiny").tasks())
    assert 0 < stored < 100000
    assert f"{stored} control tasks of the 100000 asked for" in outcome.out


def test_a_recording_that_is_repeated_takes_no_control_tasks_away(run: Run, tmp_path: Path) -> None:
    run("record", "grid_world", "--preset", "tiny", "--tasks", "2")
    before = files_of(tmp_path / "data")
    outcome = run("record", "grid_world", "--preset", "tiny")
    assert outcome.code == 1
    assert "was recorded with '--tasks 2', more than the 0 asked for; give this option again" in outcome.sentence()
    assert files_of(tmp_path / "data") == before


def test_another_recipe_is_refused_with_both_ways_out(run: Run, tmp_path: Path) -> None:
    run("record", "grid_world", "--preset", "tiny")
    before = files_of(tmp_path / "data")
    outcome = run("record", "grid_world", "--preset", "tiny", "--seed", "4")
    assert outcome.code == 1
    assert "seed is 0 there and 4 here" in outcome.sentence()
    assert "--seed 0 --set version=2 --out" in outcome.err
    assert "'--out DIR'" in outcome.err
    assert files_of(tmp_path / "data") == before


def test_ones_own_policy_gives_the_folder_a_name_that_can_be_shared(run: Run, tmp_path: Path) -> None:
    words = ("record", "grid_world", "--preset", "tiny", "--episodes", "2", "--frames", "4", "--tasks", "0")
    assert run(*words, "--policy", "own_policies:right").code == 0
    (folder,) = (tmp_path / "data").iterdir()
    assert folder.name == "grid_world-tiny-own_policies-right"
    assert plain_name(folder.name)
    assert run("share", "push", folder.name, "--to", str(tmp_path / "place")).code == 0


def test_variation_has_a_folder_of_its_own_and_the_command_that_goes_on_says_it(run: Run, tmp_path: Path) -> None:
    words = ("record", "planar_push", "--preset", "tiny", "--episodes", "2", "--frames", "4", "--workers", "1")
    varied = ("--vary", "light,friction", "--set", "objects=2", "--set", "shapes=square")
    assert run(*words, *varied).code == 0
    assert run(*words, *varied, "--ranges", "shifted").code == 0
    assert sorted(one.name for one in (tmp_path / "data").iterdir()) == [
        "planar_push-tiny-shifted",
        "planar_push-tiny-varied",
    ]
    shifted = tmp_path / "data" / "planar_push-tiny-shifted"
    assert "ranges" in run("data", "info", str(shifted)).out
    before = files_of(shifted)
    outcome = run(*words, "--vary", "light", "--out", str(shifted))
    assert outcome.code == 1
    command = outcome.err.split("To go on with it: ")[1].split("; for a new one")[0].strip("'\"")
    assert "--vary friction,light --set objects=2 --set shapes=square --ranges shifted" in command
    assert "the data set was complete already" in run(*shlex.split(command)[1:]).out
    assert files_of(shifted) == before


def test_a_file_in_the_folders_way_is_named(run: Run, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    outcome = run("record", "grid_world", "--preset", "tiny", "--out", str(tmp_path / "file" / "d"))
    assert outcome.code == 2
    assert "a file is in the way" in outcome.sentence()


def wait_for_shards(dataset: Path, more_than: int = 0) -> None:
    deadline = time.monotonic() + 60
    while len(list(dataset.glob("video/*.mcap"))) <= more_than:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def shards_of(dataset: Path) -> dict[str, tuple[int, bytes]]:
    """The number of each file and its bytes."""
    return {path.name: (path.stat().st_ino, path.read_bytes()) for path in dataset.glob("video/*.mcap")}


@pytest.mark.slow
def test_ctrl_c_leaves_it_resumable_and_says_how(run: Run, tmp_path: Path) -> None:
    recording = start_dmbench(
        [*MANY, str(tmp_path / "d")],
        tmp_path,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    wait_for_shards(tmp_path / "d")
    recording.send_signal(signal.SIGINT)
    outcome = finish(recording)
    assert outcome.code == 130
    assert "run the same command again" in outcome.sentence()
    looked = run("data", "check", str(tmp_path / "d"))
    assert looked.code == 1
    assert (
        "dmbench record grid_world --episodes 2000 --frames 12 --tasks 0 --seed 0 --set version=2 --out"
        in looked.sentence()
    )
    whole = shards_of(tmp_path / "d")
    again = start_dmbench([*MANY, str(tmp_path / "d")], tmp_path)
    wait_for_shards(tmp_path / "d", more_than=len(whole))
    again.kill()
    finish(again)
    after = shards_of(tmp_path / "d")
    assert len(after) > len(whole)
    assert whole.items() <= after.items()  # the same files with the same bytes: none was written anew


@pytest.fixture
def small_disk(tmp_path: Path) -> Iterator[Path]:
    """A file system of 300 KiB."""
    disk = tmp_path / "disk"
    disk.mkdir()
    mounted = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", "size=300k", "dmbench-test", str(disk)], capture_output=True, check=False
    )
    if mounted.returncode:
        pytest.skip("no permission to mount a small file system; the next test limits the size of files instead")
    yield disk
    subprocess.run(["umount", str(disk)], check=True)


@pytest.mark.slow
def test_a_full_disk_is_a_sentence_and_the_same_command_goes_on(run: Run, small_disk: Path, tmp_path: Path) -> None:
    words = ("record", "grid_world", "--preset", "tiny", "--episodes", "60", "--workers", "1", "--out")
    outcome = run(*words, str(small_disk / "d"))
    assert outcome.code == 1
    assert "no space left" in outcome.sentence()
    assert "run the same command again" in outcome.err
    assert not list(small_disk.rglob("*.part"))
    assert (small_disk / "d" / "video" / "shard-00000.mcap").exists()
    subprocess.run(["mount", "-o", "remount,size=2m", str(small_disk)], check=True)
    assert run(*words, str(small_disk / "d")).code == 0
    assert run(*words, str(tmp_path / "d")).code == 0
    assert files_of(small_disk / "d") == files_of(tmp_path / "d")


@pytest.mark.slow
def test_a_file_that_may_not_grow_is_a_full_disk(tmp_path: Path) -> None:
    recording = start_dmbench(
        ["record", "grid_world", "--preset", "tiny", "--workers", "1", "--out", str(tmp_path / "d")],
        tmp_path,
        file_bytes=20_000,
    )
    outcome = finish(recording)
    assert outcome.code == 1
    assert "no space left" in outcome.sentence()
    assert not list((tmp_path / "d").rglob("*.part"))
    assert not list((tmp_path / "d" / "video").iterdir())


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("--frames", "9999999999999"), "recipe.frames is 9,999,999,999,999; it can be 1 to 1,000,000"),
        (("--frames", "100000"), "an episode of 128x128 pixels can have 8,"),
        (("--episodes", "2000000000"), "recipe.episodes is 2,000,000,000; it can be 1 to 1,000,000"),
        (("--tasks", "2000000000"), "recipe.tasks is 2,000,000,000; it can be 0 to 100,000"),
    ],
)
def test_what_cannot_be_recorded_is_said_at_once(run: Run, words: tuple[str, ...], says: str, tmp_path: Path) -> None:
    outcome = run("record", "grid_world", *words)
    assert outcome.code == 2
    assert says in outcome.sentence()
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("out", [".", "", "./", "/"])
def test_a_folder_without_a_name_is_a_folder_or_a_sentence(
    run: Run, out: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = ("record", "grid_world", "--preset", "tiny", "--episodes", "2", "--workers", "1", "--out", out)
    empty = tmp_path / "empty"
    empty.mkdir()
    monkeypatch.chdir(empty)
    if out == "/":
        assert "is not empty and holds no data set; name another folder" in run(*words).sentence()
        return
    assert run(*words).code == 0
    assert len(Dataset.open(empty)) == 2
    monkeypatch.chdir(tmp_path)
    assert "is not empty and holds no data set; name another folder" in run(*words).sentence()


@pytest.mark.slow
def test_a_folder_that_is_deleted_meanwhile_is_not_half_made_again(tmp_path: Path) -> None:
    for workers in ("1", "2"):
        recording = start_dmbench([*MANY[:-2], workers, "--out", str(tmp_path / "d")], tmp_path)
        wait_for_shards(tmp_path / "d")
        (tmp_path / "d").rename(tmp_path / f"moved {workers}")
        outcome = finish(recording)
        assert outcome.code == 1
        assert "was deleted, moved or replaced while it was written; run the same command again" in outcome.sentence()
        assert not (tmp_path / "d").exists()


def test_a_working_folder_that_is_gone_is_named(run: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").mkdir()
    monkeypatch.chdir(tmp_path / "gone")
    (tmp_path / "gone").rmdir()
    outcome = run("record", "grid_world", "--preset", "tiny")
    assert outcome.code == 2
    assert "the working folder was deleted" in outcome.sentence()


def test_a_name_that_is_not_utf_8_is_noticed_before_the_work(run: Run, tmp_path: Path) -> None:
    outcome = run("record", "grid_world", "--preset", "tiny", "--out", f"{tmp_path}/\udcff")
    assert outcome.code == 2
    assert "is not UTF-8 text" in outcome.sentence()
    assert not list(tmp_path.iterdir())


@pytest.mark.slow
def test_closed_streams_change_nothing(tmp_path: Path) -> None:
    """What is opened next gets the number of a closed stream, and then all that is said goes into it."""
    words = " ".join(["record grid_world --preset tiny --episodes 4 --workers 2 --out"])
    for number, closed in enumerate(("2>&-", ">&-", "<&-", "<&- >&- 2>&-")):
        command = f"{shlex.quote(sys.executable)} -c 'from dmotion_bench.cli import main; main()' {words}"
        done = subprocess.run(["sh", "-c", f"{command} {tmp_path}/{number} {closed}"], check=False, timeout=120)
        assert done.returncode == 0
        assert files_of(tmp_path / str(number)) == files_of(tmp_path / "0")
    wrong = f"{shlex.quote(sys.executable)} -c 'from dmotion_bench.cli import main; main()' record grid_wrold 2>&-"
    assert subprocess.run(["sh", "-c", wrong], check=False, timeout=120).returncode == 2


@pytest.mark.slow
@pytest.mark.parametrize("workers", ["1", "2"])
@pytest.mark.parametrize("sign", [signal.SIGTERM, signal.SIGHUP])
def test_a_signal_ends_it_like_ctrl_c(tmp_path: Path, workers: str, sign: signal.Signals) -> None:
    recording = start_dmbench([*MANY[:-2], workers, "--out", str(tmp_path / "d")], tmp_path)
    wait_for_shards(tmp_path / "d")
    children = psutil.Process(recording.pid).children(recursive=True)
    recording.send_signal(sign)
    outcome = finish(recording)
    assert outcome.code == 128 + sign
    assert "run the same command again" in outcome.sentence()  # and no word of a resource_tracker
    assert not never_ending(children)


@pytest.mark.parametrize("sign", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_while_the_command_is_still_loading_costs_a_sentence(sign: signal.Signals) -> None:
    source = f"""
import os, sys

class Signals:
    def find_spec(self, name, *_):
        if name == "dmotion_bench.cli.app":
            os.kill(os.getpid(), {sign.value})

sys.meta_path.insert(0, Signals())
from dmotion_bench.cli import main
main()
"""
    done = subprocess.run([sys.executable, "-c", source, "info"], capture_output=True, text=True, check=False)
    assert done.returncode == 128 + sign
    assert (
        Outcome(done.returncode, done.stdout, done.stderr).sentence().startswith("dmbench: interrupted; run the same")
    )
