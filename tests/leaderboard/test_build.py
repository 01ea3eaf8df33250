"""From a workspace to a folder that is a leaderboard."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench.errors import EntryInvalid, UsageError
from dmotion_bench.reproduction.settled import Page
from dmotion_bench.scoring.references import published_results
from dmotion_bench.workspace import Workspace
from leaderboard.build import build
from leaderboard.entry import Entry, published_entry, schema_text
from leaderboard.entry_file import read_entries, write_entry
from leaderboard.paper import label_count


@pytest.mark.slow
def test_runs_tables_and_others_entries_stand_on_one_page(
    workspace: Workspace, changed: Callable[..., Entry], tmp_path: Path
) -> None:
    theirs = changed(run="theirs-s0", model="theirs", weights="1" * 64)
    given = write_entry(theirs, tmp_path / "theirs")

    built = build(workspace.all_runs(), [given], tmp_path / "out")

    entries = read_entries(tmp_path / "out/entries")
    assert (built.measured, built.published, built.left_out) == (4, 22, {})
    assert sum(entry.is_measured for entry in entries) == 4
    assert theirs in entries
    assert (tmp_path / "out/schema.json").read_text() == schema_text()
    page = built.page.read_text()
    assert "theirs" in page
    assert page.count("data:image/webp") >= 4


def test_runs_without_a_report_are_left_out_and_it_is_said(workspace: Workspace, tmp_path: Path) -> None:
    runs = workspace.all_runs()
    shutil.rmtree(runs[0] / "report")
    manifest = json.loads((runs[1] / "run.json").read_text())
    manifest["result"]["weights"] = "0" * 64
    (runs[1] / "run.json").write_text(json.dumps(manifest))

    built = build(runs, [], tmp_path / "out")

    assert built.measured == 1
    assert "dmbench score" in built.left_out[runs[0].name]
    assert "of an earlier training" in built.left_out[runs[1].name]


@pytest.mark.slow
def test_building_again_changes_nothing_and_asks_no_model(
    workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def files() -> dict[str, bytes]:
        return {str(path): path.read_bytes() for path in (tmp_path / "out").rglob("*") if path.is_file()}

    build(workspace.all_runs(), [], tmp_path / "out")
    first = files()

    def ask(*_: Any) -> None:
        raise AssertionError("a model was asked")

    monkeypatch.setattr("leaderboard.build.take_pictures", ask)
    build(workspace.all_runs(), [], tmp_path / "out")

    assert files() == first


def test_a_build_that_breaks_off_is_done_again_although_the_clock_was_ahead(
    workspace: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def end() -> str:
        raise KeyboardInterrupt

    shutil.rmtree(workspace.data)
    page = build(workspace.all_runs()[:1], [], tmp_path / "out").page
    os.utime(page, (2**32, 2**32))
    with monkeypatch.context() as patch:
        patch.setattr("leaderboard.build.schema_text", end)  # called once all entries are written
        with pytest.raises(KeyboardInterrupt):
            build(workspace.all_runs(), [], tmp_path / "out")
    assert Page(tmp_path / "out").is_behind()
    build(workspace.all_runs(), [], tmp_path / "out")
    assert not Page(tmp_path / "out").is_behind()
    assert all(run.name in page.read_text() for run in workspace.all_runs())


def test_without_its_data_set_a_run_has_an_entry_without_pictures(workspace: Workspace, tmp_path: Path) -> None:
    shutil.rmtree(workspace.data)

    built = build(workspace.all_runs(), [], tmp_path / "out")

    assert built.measured == 3
    assert not any(entry.pictures for entry in read_entries(tmp_path / "out/entries"))


def test_an_empty_workspace_shows_the_tables(tmp_path: Path) -> None:
    built = build([], [], tmp_path / "out")

    assert (built.measured, built.published) == (0, 22)
    assert "Published results alone" in built.page.read_text()


def test_no_given_entry_replaces_what_was_published_or_given_before(tmp_path: Path) -> None:
    row = published_results()[0]
    paper = published_entry(row, label_count(row.environment, row.labels))
    figures = {"mse": dict(paper.figures["mse"]) | {"mean": 0.5}}
    forged, first, second = (
        Entry(dict(paper.content) | change)
        for change in ({"figures": figures}, {"source": "mine"}, {"source": "mine", "figures": figures})
    )
    given = [write_entry(entry, tmp_path / name) for entry, name in ((forged, "a"), (first, "b"), (second, "c"))]
    assert [forged.slug, first.slug] == [paper.slug, second.slug]

    built = build([], given, tmp_path / "out")

    entries = read_entries(tmp_path / "out/entries")
    assert [entry in entries for entry in (paper, forged, first, second)] == [True, False, True, False]
    assert set(built.left_out) == {f"{paper.slug}.json", f"{first.slug}.json"}
    assert build([], [tmp_path / "out/entries"], tmp_path / "again").left_out == {}


def test_a_page_of_another_kind_is_left_as_it_is(tmp_path: Path) -> None:
    page = tmp_path / "index.html"
    page.write_text("somebody's")
    with pytest.raises(UsageError, match=r"index\.html' is no leaderboard's page"):
        build([], [], tmp_path)
    assert [(page.name, page.read_text())] == [(file.name, file.read_text()) for file in tmp_path.iterdir()]


def test_no_page_is_written_among_data_sets_and_runs(workspace: Workspace) -> None:
    data, (run, *_) = workspace.datasets()[0], workspace.all_runs()
    for folder, kind in ((data, "a data set"), (data.parent, "a data set"), (run, "a run"), (run.parent, "a run")):
        before = sorted(folder.iterdir())
        with pytest.raises(UsageError, match=rf"holds {kind} and no leaderboard .*; name another folder"):
            build([], [], folder)
        assert sorted(folder.iterdir()) == before


def test_what_is_no_entry_stops_the_build(tmp_path: Path) -> None:
    (tmp_path / "bad.json").write_text("{}")
    (tmp_path / "empty").mkdir()

    with pytest.raises(EntryInvalid, match=r"bad\.json"):
        build([], [tmp_path / "bad.json"], tmp_path / "out")
    with pytest.raises(EntryInvalid, match="holds no entry"):
        build([], [tmp_path / "empty"], tmp_path / "out")
    assert not (tmp_path / "out/index.html").exists()


def test_an_outdated_entry_of_a_run_is_taken_away_and_nothing_else(
    workspace: Workspace, sound: Entry, changed: Callable[..., Entry], tmp_path: Path
) -> None:
    folder = tmp_path / "out/entries"
    (run, *_) = [path for path in workspace.all_runs() if path.name == "dmotion-grid_world-tiny-s0"]
    outdated = write_entry(changed(settings=sound.content["settings"] | {"horizon": 7}), folder)
    of_another_author = write_entry(changed(weights="2" * 64), folder)
    elsewhere = write_entry(changed(dataset=sound.content["dataset"] | {"name": "x", "fingerprint": "3" * 64}), folder)
    of_another_run = write_entry(changed(run="theirs-s0", weights="1" * 64), folder)
    renamed = folder / "kept.json"
    renamed.write_bytes(outdated.read_bytes())
    (folder / "notes.json").write_text("mine")

    built = build([run], [], tmp_path / "out")

    assert not outdated.exists()
    assert of_another_author.exists()
    assert elsewhere.exists()
    assert list(built.doubtful) == built.to_json()["doubtful"] == [of_another_author.name]
    assert of_another_run.exists()
    assert renamed.exists()
    assert (folder / "notes.json").read_text() == "mine"


def test_a_report_that_lies_elsewhere_is_left_out_and_it_is_said(workspace: Workspace, tmp_path: Path) -> None:
    run = workspace.all_runs()[0]
    (run / "report").rename(tmp_path / "elsewhere")
    (run / "report").symlink_to(tmp_path / "elsewhere")

    built = build([run], [], tmp_path / "out")

    assert built.measured == 0
    assert "report' is a link that leads out of the run's folder" in built.left_out[run.name]


@pytest.mark.parametrize("name", ["entries", "entries/references", "entries/theirs.json"])
def test_no_link_leads_out_of_a_leaderboard(tmp_path: Path, name: str) -> None:
    """What is written through one would replace or delete files of another folder."""
    out = tmp_path / "out"
    build([], [], out)
    (out / name).rename(tmp_path / "elsewhere") if (out / name).exists() else (tmp_path / "elsewhere").touch()
    (out / name).symlink_to(tmp_path / "elsewhere")
    before = sorted(tmp_path.rglob("*"))

    with pytest.raises((EntryInvalid, UsageError), match=rf"{name}.* is a link that leads out of the leaderboard's"):
        build([], [], out)
    if name != "entries/references":  # which are read by their hashes
        with pytest.raises(EntryInvalid, match="leads out of the leaderboard's folder"):
            read_entries(out)

    assert sorted(tmp_path.rglob("*")) == before
