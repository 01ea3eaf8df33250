"""What an entry says of its data set's recording: enough to record it again, and to know that it is the same."""

from __future__ import annotations

import hashlib
import json
import shlex
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import dmbench

from dmotion_bench.api.recording import record
from dmotion_bench.errors import EntryInvalid
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.board import make_boards
from leaderboard.board_tables import board_section
from leaderboard.build import build, entry_of_run
from leaderboard.check import check_entry
from leaderboard.entry import Entry
from leaderboard.entry_file import read_entry, write_entry
from leaderboard.page import make_page

RUN = "dmotion-grid_world-tiny-s0"


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    folder = tmp_path_factory.mktemp("recorded")
    settings = {"scene": "distracted", "noise": 4}
    recording = record("grid_world", "tiny", tasks=3, settings=settings, out=folder / "data", workers=1)
    return Dataset.open(recording.dataset)


@pytest.fixture
def entry(workspace: Workspace, recorded: Dataset) -> Entry:
    """The entry of a run, as if it had been scored on the recorded data set."""
    return _told(entry_of_run(workspace.runs / RUN), recorded.manifest.identity)


def _told(entry: Entry, identity: bytes, **facts: object) -> Entry:
    fingerprint = hashlib.sha256(identity).hexdigest()
    dataset = {**entry.content["dataset"], "fingerprint": fingerprint, **facts}
    return Entry({**entry.content, "dataset": dataset}, identity)


def _changed(identity: bytes, change: Callable[[dict[str, Any]], object]) -> bytes:
    told = json.loads(identity)
    change(told)
    return json.dumps(told, sort_keys=True).encode()


def _command(board_of: Entry) -> str:
    (board,) = make_boards([board_of])
    return board.recording


def test_a_built_folder_tells_of_what_its_runs_were_scored_on(workspace: Workspace, tmp_path: Path) -> None:
    build([workspace.runs / RUN], [], tmp_path / "out")

    (path,) = (tmp_path / "out/entries").glob(f"{RUN}*.json")
    dataset = Dataset.open(workspace.data / "grid_world-tiny")
    assert read_entry(path).recipe == dataset.recipe
    kept = tmp_path / f"out/entries/references/{dataset.fingerprint}.json"
    assert hashlib.sha256(kept.read_bytes()).hexdigest() == dataset.fingerprint


def test_the_command_of_a_board_records_the_same_data_set(
    entry: Entry,
    recorded: Dataset,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    (board,) = make_boards([entry])

    assert dmbench([*shlex.split(board.recording)[1:], "--workers", "1"], capsys, monkeypatch).code == 0

    assert Dataset.open(tmp_path / "data/grid_world-tiny").fingerprint == recorded.fingerprint
    assert f"Its data set is recorded by `{board.recording}`." in " ".join(board_section(board))
    assert f"It is recorded by <code>{board.recording}</code>." in make_page([entry])


@pytest.mark.parametrize(
    "change",
    [
        lambda told: told["recipe"].update(shard_episodes=7),
        lambda told: told["recipe"].update(environment="imported"),
    ],
)
def test_where_no_command_records_it_none_is_shown(entry: Entry, change: Callable[[dict[str, Any]], object]) -> None:
    identity = _changed(entry.identity, change)
    other = _told(entry, identity, environment=json.loads(identity)["recipe"]["environment"])

    assert other.recipe is not None
    assert other.record_words() == []


def test_what_others_say_of_their_data_set_goes_on_with_their_entries(
    entry: Entry, recorded: Dataset, tmp_path: Path
) -> None:
    given = write_entry(entry, tmp_path / "theirs")

    build([], [given], tmp_path / "out")
    build([], [given], tmp_path / "out")

    assert read_entry(tmp_path / "out/entries" / given.name).recipe == recorded.recipe
    (tmp_path / "out/entries" / given.name).unlink()
    build([], [], tmp_path / "out")
    assert not (tmp_path / f"out/entries/references/{recorded.fingerprint}.json").exists()


def test_an_entry_whose_data_set_is_not_here_says_how_to_record_it(entry: Entry, workspace: Workspace) -> None:
    missing = check_entry(entry, workspace).missing
    silent = check_entry(replace(entry, identity=b""), workspace).missing

    assert [one for one in missing if one.startswith("data set: ") and "; or record it: 'dmbench record grid" in one]
    assert not [one for one in silent if "record it" in one]


def test_what_is_not_the_entry_s_data_set_is_refused(entry: Entry, recorded: Dataset, tmp_path: Path) -> None:
    path = write_entry(entry, tmp_path)
    forged = _changed(entry.identity, lambda told: told["recipe"].update(tasks=4))

    (tmp_path / f"references/{recorded.fingerprint}.json").write_bytes(forged)
    with pytest.raises(EntryInvalid, match="holds something else than its name says"):
        read_entry(path)
    with pytest.raises(EntryInvalid, match="is not that of the data set that stands beside it"):
        replace(entry, identity=forged)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda told: told.pop("recipe"), "cannot be read: it.recipe is None"),
        (lambda told: told["recipe"].update(episodes=-1), "cannot be read: "),
        (lambda told: told["recipe"].update(parameters={"a": ["b"]}), "recipe.parameters is"),
        (lambda told: told["recipe"].update(environment="planar_push"), "is 'grid_world', not 'planar_push'"),
    ],
)
def test_a_data_set_that_cannot_be_is_refused(
    entry: Entry, change: Callable[[dict[str, Any]], object], said: str
) -> None:
    with pytest.raises(EntryInvalid, match=said):
        _told(entry, _changed(entry.identity, change))


def test_nothing_in_a_recipe_is_taken_for_markup_or_a_path(entry: Entry) -> None:
    scene = "`<u>` ``; rm"
    identity = _changed(entry.identity, lambda told: told["recipe"].update(parameters={"scene": scene}))
    (board,) = make_boards([_told(entry, identity, name="../../x")])

    assert shlex.split(board.recording)[-1] == "data/x"
    assert f"scene={scene}" in shlex.split(board.recording)
    assert f"recorded by ``` {board.recording} ```." in " ".join(board_section(board))
    page = make_page(board.entries)
    assert "<u>" not in page
    assert "&lt;u&gt;" in page
