"""An outsider in an empty folder fetches what an entry needs and checks it: from files alone, the entry holds."""

from __future__ import annotations

import hashlib
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from dmbench_command import dmbench
from object_storage import Storage, object_storage

import dmotion_bench as dm
from dmotion_bench.scoring.references import published_results
from dmotion_bench.workspace import Workspace
from leaderboard.entry import Entry, published_entry
from leaderboard.entry_file import write_entry
from leaderboard.paper import label_count

pytestmark = pytest.mark.slow
RUN = "dmotion-grid_world-tiny-s0"


@pytest.fixture(scope="module")
def server() -> Iterator[Storage]:
    with object_storage() as storage:
        yield storage


@pytest.fixture(params=["folder", "bucket"])
def place(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """Where the author publishes."""
    if request.param == "folder":
        return str(tmp_path / "place")
    server: Storage = request.getfixturevalue("server")
    for name, value in server.environment.items():
        monkeypatch.setenv(name, value)
    return "s3://data/results"


@pytest.fixture
def outsider(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """An empty workspace, the current one from now on."""
    found = Workspace(tmp_path / "outsider")
    found.root.mkdir()
    return found


def write_published(folder: Path) -> None:
    """An entry that a paper has published, which needs neither weights nor data."""
    row = published_results()[0]
    write_entry(published_entry(row, label_count(row.environment, row.labels)), folder)


def test_an_outsider_checks_an_entry_from_files_alone(
    workspace: Workspace,
    outsider: Workspace,
    sound: Entry,
    place: str,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = write_entry(sound, tmp_path / "entries")
    pushed = dmbench(["share", "push", str(entry), "--to", place], capsys, monkeypatch)
    assert pushed.code == 0, pushed.err
    shutil.rmtree(workspace.root)
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(outsider.root))
    assert "not checked" in dmbench(["leaderboard", "check", str(entry)], capsys, monkeypatch).out

    checked = dmbench(["leaderboard", "check", str(entry), "--from", place], capsys, monkeypatch)

    assert checked.out.startswith(f"holds          {RUN} ({len(sound.figures)} figures, "), checked.out
    assert checked.code == 0
    assert [path.name for path in outsider.all_runs()] == [RUN]
    samples = (outsider.runs / RUN / "report" / "samples.parquet").read_bytes()
    assert hashlib.sha256(samples).hexdigest() == sound.content["samples"]["sha256"]
    again = dmbench(["share", "pull", str(entry), "--from", place], capsys, monkeypatch)
    assert again.out.count("was here already") == 2
    assert f"Check with 'dmbench leaderboard check {entry}'." in again.out


def test_a_forged_entry_does_not_hold_with_what_its_author_published(
    workspace: Workspace,
    outsider: Workspace,
    sound: Entry,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dm.share_push([RUN, "grid_world-tiny"], tmp_path / "place")
    figures = {name: dict(figure) for name, figure in sound.figures.items()}
    figures["mse"]["mean"] = 0.9 * (figures["mse"]["mean"] or 0)
    entry = write_entry(Entry(dict(sound.content) | {"figures": figures}), tmp_path / "entries")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(outsider.root))
    words = ["leaderboard", "check", "--quick", str(entry), "--from", str(tmp_path / "place")]
    checked = dmbench(words, capsys, monkeypatch)
    assert checked.code == 1
    assert checked.out.startswith("DOES NOT HOLD")
    assert "mse.mean is said to be" in checked.out


def test_what_is_not_published_is_said_and_the_others_are_checked(
    workspace: Workspace,
    outsider: Workspace,
    sound: Entry,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    dm.share_push([RUN, "grid_world-tiny"], tmp_path / "place")
    write_published(tmp_path / "entries")
    write_entry(sound, tmp_path / "entries")
    away = write_entry(Entry(dict(sound.content) | {"weights": "0" * 64, "run": "away"}), tmp_path / "entries")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(outsider.root))
    words = ["leaderboard", "check", "--quick", str(tmp_path / "entries"), "--from", str(tmp_path / "place")]
    checked = dmbench(words, capsys, monkeypatch)
    assert f"not fetched: {away.name}: " in checked.err
    assert "has no run with the weights 000000000000" in checked.err
    assert sorted(line.split("  ")[0] for line in checked.out.splitlines() if line[0] != " ") == [
        "holds", "holds", "not checked",
    ]  # fmt: skip


@pytest.mark.parametrize("trouble", ["another run's name", "damaged"])
def test_what_cannot_be_fetched_ends_no_other_entrys_check(
    workspace: Workspace,
    outsider: Workspace,
    sound: Entry,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
    trouble: str,
) -> None:
    place = tmp_path / "place"
    dm.share_push([RUN, "grid_world-tiny"], place)
    if trouble == "damaged":
        next(path for path in place.rglob("files/*") if path.stat().st_size > 1000).write_bytes(b"of another length")
    else:
        (outsider.runs / RUN).mkdir(parents=True)
    write_entry(sound, tmp_path / "entries")
    write_published(tmp_path / "entries")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(outsider.root))
    words = ["leaderboard", "check", "--quick", str(tmp_path / "entries"), "--from", str(place)]
    checked = dmbench(words, capsys, monkeypatch)
    assert checked.err.startswith(f"not fetched: {RUN}"), checked.err
    assert sorted(line.split("  ")[0] for line in checked.out.splitlines() if line[0] != " ") == [
        "holds", "not checked",
    ]  # fmt: skip


def test_a_place_that_is_none_ends_the_check(
    outsider: Workspace,
    sound: Entry,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    entry = write_entry(sound, tmp_path / "entries")
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(outsider.root))
    words = ["leaderboard", "check", str(entry), "--from", "ftp://somewhere/else"]
    assert "ftp" in dmbench(words, capsys, monkeypatch).sentence()
