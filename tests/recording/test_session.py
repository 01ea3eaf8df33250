"""A recording gives the same bytes however it is divided, killed and gone on with."""

from __future__ import annotations

import dataclasses
import json
import os
import platform
import random
import subprocess
import sys
import time
from collections.abc import Iterable
from pathlib import Path

import psutil
import pytest
from noise_world import files_of

from dmotion_bench import versions
from dmotion_bench.errors import DatasetError, DmbenchError, InvalidSetting, RecordingFailed, UnknownName, UsageError
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.local_executor import LocalExecutor, SerialExecutor
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import Progress, ShardJob, environment_facts, record_dataset, record_shard
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset

pytestmark = pytest.mark.slow

RECIPE = DatasetRecipe(environment="grid_world", episodes=90, frames=6, tasks=5, shard_episodes=3)
VARIED = DatasetRecipe(
    environment="robot_push",
    policy="push",
    episodes=16,
    frames=5,
    tasks=5,
    shard_episodes=2,
    parameters={"ranges": "shifted"},
    vary=("camera", "colour", "distractors", "friction", "light", "mass"),
)
RECORD = """
import json, sys
from pathlib import Path
from dmotion_bench.execution.local_executor import local_executor
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe

if __name__ == "__main__":
    recipe = json.loads(sys.argv[2])
    recipe["vary"] = tuple(recipe["vary"])
    show = lambda progress: print(progress.episodes, flush=True)
    record_dataset(Path(sys.argv[1]), DatasetRecipe(**recipe), local_executor(int(sys.argv[3])), show)
"""


@pytest.fixture(scope="module")
def at_once(tmp_path_factory: pytest.TempPathFactory) -> dict[str, bytes]:
    path = tmp_path_factory.mktemp("recording") / "d"
    record_dataset(path, RECIPE)
    return files_of(path)


def start(script: Path, dataset: Path, recipe: DatasetRecipe, workers: int) -> subprocess.Popen[str]:
    script.write_text(RECORD)
    words = [sys.executable, str(script), str(dataset), json.dumps(dataclasses.asdict(recipe)), str(workers)]
    return subprocess.Popen(words, stdout=subprocess.PIPE, text=True)


def processes_below(process: int) -> list[int]:
    return [one.pid for one in psutil.Process(process).children(recursive=True)]


def runs(process: int) -> bool:
    try:
        return Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX"
    except (FileNotFoundError, ProcessLookupError):
        return False


@pytest.mark.parametrize(
    ("recipe", "workers", "kills"),
    [(RECIPE, 1, 3), (RECIPE, 2, 2), (VARIED, 2, 2)],
    ids=["grid_world", "grid_world by two", "robot_push by two"],
)
def test_killed_at_any_moment_it_goes_on_and_gives_the_same_bytes(
    tmp_path: Path, recipe: DatasetRecipe, workers: int, kills: int
) -> None:
    generator = random.Random(workers)
    shards = -(-recipe.episodes // recipe.shard_episodes)
    for _ in range(kills):
        recording = start(tmp_path / "record.py", tmp_path / "d", recipe, workers)
        assert recording.stdout is not None
        assert recording.stdout.readline()  # it has begun
        for _ in range(generator.randrange(shards // kills)):
            recording.stdout.readline()  # a shard is done
        time.sleep(generator.random() * 0.04)
        workers_of_it = processes_below(recording.pid)
        recording.kill()
        recording.wait()
        deadline = time.monotonic() + 60
        while any(runs(one) for one in workers_of_it) and time.monotonic() < deadline:
            time.sleep(0.05)
        assert not any(runs(one) for one in workers_of_it)  # nobody goes on writing
        recording.stdout.close()
    record_dataset(tmp_path / "d", recipe)
    record_dataset(tmp_path / "at once", recipe)
    assert files_of(tmp_path / "d") == files_of(tmp_path / "at once")


def test_two_workers_write_the_same_bytes(tmp_path: Path, at_once: dict[str, bytes]) -> None:
    seen: list[Progress] = []
    recorded = record_dataset(tmp_path / "d", RECIPE, LocalExecutor(2), seen.append)
    assert files_of(tmp_path / "d") == at_once
    assert (recorded.episodes, recorded.frames) == (90, 540)
    assert recorded.bytes == sum(len(content) for name, content in at_once.items() if name.endswith(".mcap"))
    assert [one.episodes for one in seen] == list(range(0, 91, 3))
    assert seen[-1].frames == 540


def test_extending_gives_what_recording_at_once_gives(tmp_path: Path, at_once: dict[str, bytes]) -> None:
    record_dataset(tmp_path / "d", dataclasses.replace(RECIPE, episodes=40))
    first = files_of(tmp_path / "d")
    record_dataset(tmp_path / "d", RECIPE)
    assert files_of(tmp_path / "d") == at_once
    for index in range(13):  # 40 episodes are 13 full shards and one of a single episode
        name = f"video/shard-{index:05d}.mcap"
        assert first[name] == at_once[name]


def test_a_complete_recording_is_not_touched(tmp_path: Path) -> None:
    small = dataclasses.replace(RECIPE, episodes=6)
    record_dataset(tmp_path / "d", small)
    stamps = {file: file.stat().st_mtime_ns for file in (tmp_path / "d" / "video").iterdir()}
    again = record_dataset(tmp_path / "d", small)
    assert again.made.frames == 0
    assert {file: file.stat().st_mtime_ns for file in (tmp_path / "d" / "video").iterdir()} == stamps


def test_an_exception_in_the_middle_keeps_what_was_done(tmp_path: Path, at_once: dict[str, bytes]) -> None:
    class Broken(SerialExecutor):
        def map_unordered(self, function, jobs: Iterable):  # type: ignore[no-untyped-def, type-arg]
            for count, result in enumerate(super().map_unordered(function, jobs)):
                if count == 4:
                    raise ZeroDivisionError
                yield result

    with pytest.raises(ZeroDivisionError):
        record_dataset(tmp_path / "d", RECIPE, Broken())
    seen: list[Progress] = []
    record_dataset(tmp_path / "d", RECIPE, on_progress=seen.append)
    assert seen[0].episodes == 15  # the fifth shard was whole when the loop broke
    assert files_of(tmp_path / "d") == at_once


@pytest.mark.parametrize("kind", [RecordingFailed, UsageError])
def test_a_machine_that_fails_takes_no_work_of_the_others_away(
    tmp_path: Path, at_once: dict[str, bytes], kind: type[DmbenchError]
) -> None:
    class Failing(SerialExecutor):
        def __init__(self, done: int) -> None:
            self.done = done

        def map_unordered(self, function, jobs: Iterable):  # type: ignore[no-untyped-def, type-arg]
            for count, job in enumerate(jobs):
                if count == self.done:
                    raise kind("gym is not installed.")
                yield function(job)

    with pytest.raises(kind, match=r"^gym is not installed\. Nothing is recorded\.$"):
        record_dataset(tmp_path / "d", RECIPE, Failing(0))
    assert not (tmp_path / "d").exists()
    with pytest.raises(kind, match=r"12 of 90 episodes are recorded and kept; .* goes on where it stopped\.$"):
        record_dataset(tmp_path / "d", RECIPE, Failing(4))
    assert len(list((tmp_path / "d" / "video").iterdir())) == 4
    record_dataset(tmp_path / "d", RECIPE)
    assert files_of(tmp_path / "d") == at_once


def test_a_machine_with_another_version_of_a_package_makes_no_shard(
    tmp_path: Path, at_once: dict[str, bytes], monkeypatch: pytest.MonkeyPatch
) -> None:
    """So that a data set is never made by two versions and states one."""
    version, here = versions.version, versions.version("numpy")

    class OtherMachine(SerialExecutor):
        def map_unordered(self, function, jobs: Iterable):  # type: ignore[no-untyped-def, type-arg]
            for count, job in enumerate(jobs):
                if count == 2:
                    monkeypatch.setattr(versions, "version", lambda name: "1.2" if name == "numpy" else version(name))
                    monkeypatch.setattr(versions.platform, "node", lambda: "node-7")
                yield function(job)

    said = rf"the machine 'node-7' has numpy 1\.2, and the data set is made with numpy {here}; install the same"
    with pytest.raises(DatasetError, match=said):
        record_dataset(tmp_path / "d", RECIPE, OtherMachine())
    monkeypatch.undo()
    assert len(list((tmp_path / "d" / "video").iterdir())) == 2
    record_dataset(tmp_path / "d", RECIPE)
    assert files_of(tmp_path / "d") == at_once


def test_a_job_of_an_earlier_version_names_no_packages(tmp_path: Path) -> None:
    (tmp_path / "d").mkdir()
    spec = environment_facts(RECIPE)
    assert record_shard(ShardJob(dataset=tmp_path / "d", recipe=RECIPE, spec=spec, index=1)).index == 1
    versions.require_same({"python": platform.python_version(), "a package that is not here": "1.0"})


def test_a_worker_that_is_killed_is_a_sentence(tmp_path: Path) -> None:
    with pytest.raises(DmbenchError, match="run the same command again"):
        list(LocalExecutor(2).map_unordered(os._exit, [1, 2, 3]))


MEMORY = """
import dataclasses, resource, sys
from pathlib import Path
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe

recipe = DatasetRecipe(environment="grid_world", episodes=100, frames=12, tasks=5, shard_episodes=20)
for episodes in (100, 400):
    record_dataset(Path(sys.argv[1]) / str(episodes), dataclasses.replace(recipe, episodes=episodes))
    print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)  # [KiB]
"""


def test_memory_does_not_grow_with_the_number_of_episodes(tmp_path: Path) -> None:
    done = subprocess.run([sys.executable, "-c", MEMORY, tmp_path], capture_output=True, text=True, check=True)
    few, four_times_as_many = map(int, done.stdout.split())
    kept = 300 * 12 * 128 * 128 * 3 // 1024  # what the pictures alone would take
    assert four_times_as_many - few < kept / 8


def test_tasks_are_stored_and_can_be_reached(tmp_path: Path) -> None:
    record_dataset(tmp_path / "d", DatasetRecipe(environment="grid_world", episodes=40, frames=32, tasks=12))
    dataset = Dataset.open(tmp_path / "d")
    tasks = dataset.tasks()
    assert len(tasks) == 12
    for task in tasks:
        states = dataset.states(task.episode)
        there = states.objects.visible[task.start] > 0
        assert (states.objects.visible[task.goal][there] > 0).all()
        assert states.pushed[task.start : task.goal].sum() >= 2
        assert (states.objects.position[task.start][there] != states.objects.position[task.goal][there]).any()


def test_the_presets_are_the_environments(tmp_path: Path) -> None:
    paper = recipe_for("grid_world", Preset.PAPER)
    assert (paper.episodes, paper.frames, paper.tasks) == (700, 32, 100)
    assert paper.episodes * (paper.frames - 2) == 21_000  # the paper's triplets
    assert recipe_for("grid_world", Preset.TINY, episodes=7, seed=3).episodes == 7
    assert environment_facts(paper).objects[0].name == "red_circle"


def test_wrong_names_and_parameters_are_refused(tmp_path: Path) -> None:
    with pytest.raises(UnknownName, match="did you mean 'grid_world'"):
        recipe_for("grid_wrold")
    with pytest.raises(UnknownName, match="policy of grid_world named 'rondom'; did you mean 'random'"):
        record_dataset(tmp_path / "d", dataclasses.replace(RECIPE, policy="rondom"))
    with pytest.raises(InvalidSetting, match=r"cannot be made.*cells"):
        record_dataset(tmp_path / "d", dataclasses.replace(RECIPE, parameters={"cells": 7}))
    with pytest.raises(UnknownName, match="no factor of variation named 'light'; known: background"):
        record_dataset(tmp_path / "d", dataclasses.replace(RECIPE, vary=("light",)))
    with pytest.raises(UnknownName, match="executor"):
        make_executor("slrum", 2)
    assert not (tmp_path / "d").exists()
