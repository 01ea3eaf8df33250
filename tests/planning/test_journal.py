"""The progress of control on disk: what is taken up again, and what is not."""

from __future__ import annotations

import json
import zlib
from pathlib import Path
from typing import Any

import pytest

from dmotion_bench.actions import Discrete
from dmotion_bench.planning.journal import FORMAT, Extent, Journal, TaskRecord
from dmotion_bench.planning.tasks import Problem
from dmotion_bench.storage.json_file import LARGEST

EXTENT = Extent(actions=Discrete.numbered(4), tasks=6, steps=6)


def test_a_damaged_journal_is_begun_anew_and_that_is_said(
    tmp_path: Path, problems: list[Problem], caplog: pytest.LogCaptureFixture
) -> None:
    file, key = tmp_path / "journal.json", {"who": "me"}
    record = TaskRecord(actions=[1], distance=[0.5, 0.25], lost=[0, 0], frames=4)
    Journal(file, key, EXTENT).write({problems[0].number: record}, None, last=True)
    sound = file.read_text()
    file.with_name("journal.json.00001234.part").touch()  # of a killed process
    assert Journal(file, key, EXTENT).all_records(problems[:1]) == {problems[0].number: record}
    Journal(tmp_path / "missing.json", key, EXTENT)
    Journal(file, {"who": "somebody else"}, EXTENT)
    assert not caplog.records
    for damaged in (sound.replace("0.25", "0.75"), sound[:-3], "[" * 100_000, "9" * 5000, "[]", "{}"):
        file.write_text(damaged)
        assert Journal(file, key, EXTENT).all_records(problems[:1]) == {problems[0].number: TaskRecord()}
    assert list(tmp_path.iterdir()) == [file]
    assert ["begun anew" in record.message for record in caplog.records] == [True] * 6


@pytest.mark.parametrize(
    ("record", "memory"),
    [
        ({"actions": [4]}, {}),
        ({"actions": [-2]}, {}),
        ({"actions": [[0.5]]}, {}),
        ({"actions": [None]}, {}),
        ({"actions": [1] * 7, "distance": [0.5] * 8, "lost": [0] * 8}, {}),
        ({"actions": [1, 1]}, {}),
        ({"lost": [0, 2**64 - 1]}, {}),
        ({"distance": [0.5, None]}, {}),
        ({"frames": -1}, {}),
        ({}, {"0": [[0, 4]]}),
        ({}, {"0": [[0, 1]], "1": [[0]]}),
        ({}, {"0": 3}),
        ({}, {"0": [[0.5, 0.5]]}),
    ],
    ids=str,
)
def test_a_journal_of_what_cannot_have_been_done_is_begun_anew(
    tmp_path: Path, record: dict[str, Any], memory: dict[str, Any]
) -> None:
    file, key = tmp_path / "journal.json", {"who": "me"}
    sound = {"actions": [1], "distance": [0.5, 0.25], "lost": [0, 0], "frames": 4}

    def taken_up(task: dict[str, Any], remembered: dict[str, Any], number: int = 0) -> bool:
        content = {"format": FORMAT, "key": key, "tasks": {str(number): task}, "memory": remembered}
        file.write_text(json.dumps(content | {"crc32": zlib.crc32(json.dumps(content).encode())}))
        return bool(Journal(file, key, EXTENT)._records)

    assert taken_up(sound, {"0": [[0, 3]], "1": [[1, 2]]})
    assert taken_up(sound | {"actions": [-1]}, {})
    assert not taken_up(sound | record, memory)
    assert not taken_up(sound, {}, number=EXTENT.tasks)


@pytest.mark.slow
def test_a_journal_is_read_however_much_there_was_to_do(tmp_path: Path) -> None:
    record = TaskRecord(actions=[1] * 40, distance=[1 / 3] * 41, lost=[0] * 41)
    file, extent = tmp_path / "journal.json", Extent(actions=Discrete.numbered(4), tasks=17_000, steps=40)
    Journal(file, {}, extent).write(dict.fromkeys(range(17_000), record), None, last=True)

    assert file.stat().st_size > LARGEST
    assert len(Journal(file, {}, extent)._records) == 17_000
