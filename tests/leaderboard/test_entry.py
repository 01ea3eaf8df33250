"""Entries: what conforms to the schema, and what anybody may send instead."""

from __future__ import annotations

import dataclasses
import hashlib
import json
import os
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.scoring.references import published_results
from dmotion_bench.scoring.report import Report
from leaderboard.entry import Entry, published_entry, schema_text
from leaderboard.entry_file import read_entries, read_entry, remove_unused_references, write_entry
from leaderboard.paper import label_count

Changed = Callable[..., Entry]
SETTINGS = {"split": "test", "protocol": "episode", "horizon": 3, "precision": "float32", "metrics": []}
PUBLISHED = Path(__file__).parents[2] / "docs/leaderboard/entries"


def test_the_schema_has_every_field_of_a_report() -> None:
    measured = json.loads(schema_text())["$defs"]["measured"]

    assert {field.name for field in dataclasses.fields(Report)} <= set(measured["properties"])
    required = {*measured["required"], *measured["else"]["required"], *measured["if"]["required"]}
    assert required == set(measured["properties"])


def test_patterns_are_of_the_whole_text() -> None:
    def patterns(rule: object) -> Iterator[str]:
        if isinstance(rule, dict):
            if isinstance(rule.get("pattern"), str):
                yield rule["pattern"]
            for inner in rule.values():
                yield from patterns(inner)

    assert all(pattern.startswith("^") and pattern.endswith("$") for pattern in patterns(json.loads(schema_text())))


def test_an_entry_is_its_report_and_reads_back(sound: Entry, scored_workspace: Any, tmp_path: Path) -> None:
    stored = json.loads((scored_workspace.runs / sound.name / "report/report.json").read_text())
    for figure in (*stored["figures"].values(), *(one for own in stored["reference"].values() for one in own.values())):
        figure.pop("episodes", None)  # entries have five parts of a figure

    assert dict(sound.report) == stored
    assert read_entry(write_entry(sound, tmp_path)) == sound
    assert read_entries(tmp_path) == [sound]
    assert (sound.environment, sound.labels, sound.label_count) == ("grid_world", "one-shot", 4)


@pytest.mark.slow
def test_published_entries_are_of_the_versions_that_their_code_stands_for() -> None:
    """What was published before versions were named holds: the schema, the entries' names, and who is compared."""
    entries = {path.stem: read_entry(path) for path in PUBLISHED.glob("*.json")}
    measured = [entry for entry in entries.values() if entry.is_measured]

    assert measured
    assert all(entry.slug == name for name, entry in entries.items())
    assert {entry.scored_by for entry in measured if "code" in entry.content} <= {1}
    earlier = [entry for entry in measured if "control_code" in entry.content["settings"]]
    for entry in earlier:
        code = entry.content["settings"]["control_code"]
        assert entry.planned_by == (1 if code == "0.1.0+4fa30b762c67" else code)


@pytest.mark.parametrize("names", [("scoring_version",), ("planning",), ("code", "planning", "scoring_version")])
def test_an_entry_names_a_version_or_the_code(sound: Entry, names: tuple[str, ...]) -> None:
    content = {name: value for name, value in sound.content.items() if name not in names}
    with pytest.raises(EntryInvalid, match=f"lacks '{'scoring_version' if 'scoring_version' in names else names[0]}'"):
        Entry(content)
    Entry(content | {"code": "0.1.0+f4b222bec15f"})


def test_what_entries_share_stands_once_beside_them(sound: Entry, changed: Changed, tmp_path: Path) -> None:
    other = changed(run="other", weights="1" * 64)
    figures = {name: dict(one) for name, one in sound.content["reference"]["copy_last"].items()}
    figures["mse"]["mean"] += 1
    elsewhere = changed(run="elsewhere", reference=sound.content["reference"] | {"copy_last": figures})

    paths = {entry.name: write_entry(entry, tmp_path) for entry in (sound, other, elsewhere)}

    true = [picture["truth"] for path in paths.values() for picture in json.loads(path.read_text())["pictures"]]
    assert len(set(true)) == len(sound.content["pictures"]) == len(true) / len(paths)
    assert all(re.fullmatch("[0-9a-f]{64}", one) for one in true)
    stored = {name: json.loads(path.read_text())["reference"]["copy_last"] for name, path in paths.items()}
    assert stored[sound.name] == stored["other"] != stored["elsewhere"]
    jsonschema.validate(json.loads(paths["other"].read_text()), json.loads(schema_text()))
    assert {entry.name: entry for entry in read_entries(tmp_path)} == {
        entry.name: entry for entry in (sound, other, elsewhere)
    }
    paths["elsewhere"].unlink()
    (tmp_path / "folder.json").mkdir()
    os.mkfifo(tmp_path / "pipe.json")
    remove_unused_references(tmp_path)
    assert {stored["other"]} <= {path.stem for path in (tmp_path / "references").iterdir()}
    assert stored["elsewhere"] not in {path.stem for path in (tmp_path / "references").iterdir()}


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda path: path.unlink(), "No such file"),
        (lambda path: path.write_text(path.read_text().replace("1", "2", 1)), "something else than its name says"),
        (lambda path: path.write_bytes(b"x" * 9_000_000), "larger than"),
    ],
)
def test_a_shared_reference_that_is_not_as_it_was_is_refused(
    sound: Entry, tmp_path: Path, spoil: Callable[[Path], object], said: str
) -> None:
    path = write_entry(sound, tmp_path)
    shared = json.loads(path.read_text())["reference"]["copy_last"]

    spoil(tmp_path / "references" / f"{shared}.json")

    with pytest.raises(EntryInvalid, match=said):
        read_entry(path)


def test_a_reference_that_is_named_often_is_read_once(sound: Entry, tmp_path: Path) -> None:
    path = write_entry(sound, tmp_path)
    content = json.loads(path.read_text())
    shared = content["reference"]["copy_last"]
    path.write_text(json.dumps(content | {"reference": {f"r{number}": shared for number in range(20)}}))

    references = read_entry(path).content["reference"]

    assert len(references) == 20
    assert len({id(figures) for figures in references.values()}) == 1


def test_references_take_bounded_memory(sound: Entry, tmp_path: Path) -> None:
    path = write_entry(sound, tmp_path)
    content = json.loads(path.read_text())

    def refer_to(*texts: str) -> None:
        hashes = [hashlib.sha256(text.encode()).hexdigest() for text in texts]
        for text, digest in zip(texts, hashes, strict=True):
            (tmp_path / "references" / f"{digest}.json").write_text(text)
        path.write_text(json.dumps(content | {"reference": {f"r{n}": digest for n, digest in enumerate(hashes)}}))

    refer_to("[" + "{}," * 20_000 + "0]")
    with pytest.raises(EntryInvalid, match="more than 20,000 values"):
        read_entry(path)
    refer_to(*(f"[{number}]" for number in range(45)))
    with pytest.raises(EntryInvalid, match="more than 44 references"):
        read_entry(path)
    refer_to(*(f'"{letter * 3_000_000}"' for letter in "abc"))
    with pytest.raises(EntryInvalid, match="larger than"):
        read_entry(path)


def test_a_pipe_is_not_waited_for(sound: Entry, tmp_path: Path) -> None:
    path = write_entry(sound, tmp_path)
    shared = tmp_path / "references" / f"{json.loads(path.read_text())['reference']['copy_last']}.json"
    os.mkfifo(tmp_path / "pipe.json")
    shared.unlink()
    os.mkfifo(shared)

    for one in (tmp_path / "pipe.json", path):
        with pytest.raises(EntryInvalid, match="no ordinary file"):
            read_entry(one)


def test_a_hash_is_no_path_and_no_figures(sound: Entry, changed: Changed, tmp_path: Path) -> None:
    path = write_entry(sound, tmp_path)
    (tmp_path / "secret.json").write_text("{}")
    content = json.loads(path.read_text())
    content["reference"]["copy_last"] = "../secret"
    path.write_text(json.dumps(content))

    with pytest.raises(EntryInvalid, match=r"reference\.copy_last is '../secret'"):
        read_entry(path)
    with pytest.raises(EntryInvalid, match="a hash without its figures"):
        changed(reference={"copy_last": "0" * 64})
    with pytest.raises(EntryInvalid, match=r"pictures\[0\]\.truth is a hash without its picture"):
        changed(pictures=[sound.content["pictures"][0] | {"truth": "0" * 64}])


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
        ({"model": "\ud800"}, "which is no text"),
        ({"figures": {"mse": {"mean": 1e308, "std": 0, "low": 0, "high": 0, "n": 1}}}, "figures.mse.mean is 1e.308"),
        ({"run": "x" * 500}, "run has 500 characters"),
        ({"protocol": "dmbench-9"}, "protocol"),
        ({"extra": 1}, "'extra', which is not known"),
        ({"figures": {"MSE<script>": {}}}, "a name in figures"),
        ({"figures": {"mse": {"mean": 1}}}, "figures.mse lacks 'std'"),
        ({"figures": {"rollout_mse[03]": {}}}, "a name in figures"),
        ({"model": "cs\u202ewm"}, "model is 'cs.*wm', which does not match"),
        ({"settings": SETTINGS | {"split": "validation"}}, "settings.split is 'validation', not 'test'"),
        ({"settings": SETTINGS | {"split": "train"}}, "settings.split is 'train', not 'test'"),
        ({"settings": SETTINGS | {"protocol": "other"}}, "settings.protocol is 'other'"),
        ({"settings": SETTINGS | {"control_code": ["0.1.0"]}}, "settings.control_code is .*, not of the type string"),
        ({"by_episode": {"mse": {"episode": [1], "n": [1], "sum": [1e308]}}}, r"by_episode.mse.sum\[0\] is 1e.308"),
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
        ('{"seed": NaN}', "not finite"),
        ('{"seed": 1e999}', "not finite"),
        ('{"seed": 123456789012345678901234567890}', "does not fit in 64 bits"),
        ('{"seed": 9007199254740992}', "cannot hold exactly"),
        ('{"a": ' * 40 + "0" + "}" * 40, "nested deeper"),
        ("[" + "{}," * 2_000_000 + "0]", "more than 2,000,000 values"),
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

    path = write_entry(entry, tmp_path)

    assert path.parent == tmp_path
    assert set(path.stem) <= set("abcdefghijklmnopqrstuvwxyz0123456789-_")
    assert changed(run="a").slug != changed(run="a", weights="0" * 64).slug
