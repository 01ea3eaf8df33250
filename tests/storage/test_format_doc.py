"""``docs/format.md`` says what is so."""

from __future__ import annotations

import hashlib
import json
import re
from pathlib import Path

import pyarrow.parquet as pq
import pytest
from noise_world import write_noise

from dmotion_bench.storage.schema import ACTION, CONTINUOUS_ACTION, FACTORS, STATES

DOC = (Path(__file__).parents[2] / "docs/format.md").read_text()


def _proto() -> dict[str, list[tuple[str, int]]]:
    """Each message's fields with their numbers, as the text has them."""
    return {
        name: [(field, int(number)) for field, number in re.findall(r"(\w+) = (\d+);", fields)]
        for name, fields in re.findall(r"^message (\w+) +\{(.*)\}$", DOC, re.MULTILINE)
    }


def test_the_messages_are_those_of_the_files() -> None:
    told = _proto()

    for kind in (ACTION, CONTINUOUS_ACTION, STATES, FACTORS):
        fields = kind.new().DESCRIPTOR.fields
        assert told[kind.name.removeprefix("dmbench.")] == [(field.name, field.number) for field in fields]
    assert told["State"] == [(one.name, one.number) for one in STATES.new().states.add().DESCRIPTOR.fields]


def test_the_fingerprint_is_made_as_described(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "noise")
    stored = json.loads((dataset.path / "dataset.json").read_text())
    parts = {name: stored[name] for name in ("format", "recipe", "environment", "shards")}

    assert hashlib.sha256(json.dumps(parts, sort_keys=True).encode()).hexdigest() == dataset.fingerprint


def test_every_column_is_told_of(tmp_path: Path) -> None:
    dataset = write_noise(tmp_path / "noise")

    told = set(re.findall(r"`(\w+)`", DOC)) | {
        f"{name}_{part}" for name in ("states", "masks") for part in ("offset", "bytes")
    }
    for table in ("episodes.parquet", "tasks.parquet"):
        assert set(pq.read_schema(dataset.path / table).names) <= told
    assert set(json.loads((dataset.path / "dataset.json").read_text())) <= told


def test_the_example_reads_a_frame(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    dataset = write_noise(tmp_path / "noise")
    (example,) = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)

    exec(example.replace("data/grid_world-small", str(dataset.path)), {})

    spec = dataset.spec
    assert capsys.readouterr().out.split()[1:] == [
        *(str(spec.width), str(spec.height), "rgb8", str(spec.height * spec.width * 3))
    ]
