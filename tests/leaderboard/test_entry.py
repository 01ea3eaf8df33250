"""Entries: what conforms to the schema, and what anybody may send instead."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.scoring.references import published_results
from dmotion_bench.scoring.report import Report
from leaderboard.entry import Entry, published_entry, read_entries, read_entry, schema
from leaderboard.paper import label_count

Changed = Callable[..., Entry]


def test_the_schema_has_every_field_of_a_report() -> None:
    measured = schema()["$defs"]["measured"]

    assert {field.name for field in dataclasses.fields(Report)} <= set(measured["properties"])
    assert set(measured["required"]) == set(measured["properties"])


def test_patterns_are_of_the_whole_text() -> None:
    def patterns(rule: object) -> Iterator[str]:
        if isinstance(rule, dict):
            if isinstance(rule.get("pattern"), str):
                yield rule["pattern"]
            for inner in rule.values():
                yield from patterns(inner)

    assert all(pattern.startswith("^") and pattern.endswith("$") for pattern in patterns(schema()))


def test_an_entry_is_its_report_and_reads_back(sound: Entry, scored_workspace: Any, tmp_path: Path) -> None:
    stored = json.loads((scored_workspace.runs / sound.name / "report/report.json").read_text())

    assert dict(sound.report) == stored
    assert read_entry(sound.write(tmp_path)) == sound
    assert read_entries(tmp_path) == [sound]
    assert (sound.environment, sound.labels, sound.label_count) == ("grid_world", "one-shot", 4)


def test_the_paper_s_rows_are_entries() -> None:
    entries = [published_entry(row, label_count(row.environment, row.labels)) for row in published_results()]

    counts = {(entry.environment, entry.labels): entry.label_count for entry in entries}
    assert len({entry.slug for entry in entries}) == len(entries) == 22
    assert counts["grid_world", "100%"] == 18_900
    assert counts["robot_push", "10%"] == 21_429
    assert counts["grid_world", "one-shot"] == 4


@pytest.mark.parametrize(
    ("content", "said"),
    [
        ({"seed": "0"}, "seed is '0'"),
        ({"seed": -1}, "seed is -1"),
        ({"weights": "../../etc/passwd"}, "weights"),
        ({"model": "a\x1b[31m"}, "model"),
        ({"model": ""}, "model has 0 characters"),
        ({"run": "x" * 500}, "run has 500 characters"),
        ({"protocol": "dmbench-2"}, "protocol"),
        ({"extra": 1}, "'extra', which is not known"),
        ({"figures": {"MSE<script>": {}}}, "a name in figures"),
        ({"figures": {"mse": {"mean": 1}}}, "figures.mse lacks 'std'"),
        ({"pictures": [{}]}, r"pictures\[0\] lacks"),
        ({"by_episode": {"mse": {"episode": [1, 2], "n": [1], "sum": [1.0]}}}, "different lengths"),
        ({"by_episode": {"mse": {"episode": [2, 1], "n": [1, 1], "sum": [1.0, 1.0]}}}, "not in order"),
    ],
)
def test_what_breaks_the_schema_is_said(changed: Changed, content: dict[str, Any], said: str) -> None:
    with pytest.raises(EntryInvalid, match=said):
        changed(**content)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "no entry"),
        ("[]", "not of the type object"),
        ("[" * 100_000, "no entry"),
        ('{"format": "dmbench-entry/2", "kind": "measured"}', "dmbench-entry/2"),
        ('{"seed": 1, "seed": 2}', "names something twice"),
        ('{"seed": NaN}', "no number"),
        ('{"seed": 1e999}', "no number"),
        ('{"seed": 123456789012345678901234567890}', "no number"),
        ('"' + "x" * 9_000_000 + '"', "larger than"),
    ],
)
def test_what_is_no_entry_is_refused(tmp_path: Path, text: str, said: str) -> None:
    path = tmp_path / "entry.json"
    path.write_text(text)

    with pytest.raises(EntryInvalid, match=said):
        read_entry(path)


def test_bytes_that_are_no_text_and_files_that_are_not_there(tmp_path: Path) -> None:
    (tmp_path / "entry.json").write_bytes(b"\xff\xfe\x00")

    for name in ("entry.json", "missing.json"):
        with pytest.raises(EntryInvalid, match="no entry of the leaderboard"):
            read_entry(tmp_path / name)


def test_a_name_is_no_path(changed: Changed, tmp_path: Path) -> None:
    entry = changed(run="../../<b>x</b>/..")

    path = entry.write(tmp_path)

    assert path.parent == tmp_path
    assert set(path.stem) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_")
    assert changed(run="a").slug != changed(run="a", weights="0" * 64).slug
