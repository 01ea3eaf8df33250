"""Curves in TensorBoard and Weights & Biases are those of ``metrics.jsonl``, read with their own readers."""

from __future__ import annotations

import importlib.util
import json
import struct
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from walking_square import record_walks

from dmotion_bench.errors import PackageNotInstalled, RunError
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.metrics_log import read_rows
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.learning.training.tracking import require_trackers
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.4", "validations=3")


class Stopped(Exception):
    """Raised by a progress callback."""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


def _train(data: Path, folder: Path, trackers: tuple[str, ...], stop_at: int | None = None) -> Run:
    dataset = Dataset.open(data)
    run = open_run(TrainingRequest(model="dmotion", settings=SETTINGS), dataset, folder, Workspace(folder))

    def on_step(report: StepReport) -> None:
        if report.step == stop_at:
            raise Stopped

    train(run, training_data(run, dataset), launch("cpu"), on_step, trackers)
    return Run.open(folder)


def _curves(run: Run) -> dict[str, list[tuple[int, float]]]:
    """The rows of ``metrics.jsonl`` by the names that trackers give them."""
    curves: dict[str, list[tuple[int, float]]] = {}
    for step, values in read_rows(run.metrics):
        for name, value in values.items():
            if name not in ("seconds", "triplets_per_s"):
                part = f"validation/{name[11:]}" if name.startswith("validation_") else f"training/{name}"
                curves.setdefault(part, []).append((step, value))
    return curves


@pytest.mark.slow
def test_tensorboard_reads_the_curves_of_a_run_that_was_killed_and_went_on(data, tmp_path, monkeypatch) -> None:
    from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 1000.0)
    with pytest.raises(Stopped):
        _train(data, tmp_path / "run", ("tensorboard",), stop_at=5)
    run = _train(data, tmp_path / "run", ("tensorboard",))
    events = EventAccumulator(str(run.path / "tensorboard"))
    events.Reload()
    for name, curve in _curves(run).items():
        read = [(event.step, event.value) for event in events.Scalars(name)]
        assert read == [(step, pytest.approx(value, rel=1e-6)) for step, value in curve], name
    assert [event.step for event in events.Images("validation/predictions")] == [
        step for step, _ in _curves(run)["validation/loss"]
    ]
    assert "dmotion" in str(events.Tensors("settings/text_summary")[0].tensor_proto)


@pytest.mark.slow
def test_the_files_of_wandb_hold_the_curves_without_a_network(data, tmp_path, monkeypatch) -> None:
    monkeypatch.delenv("WANDB_MODE", raising=False)
    monkeypatch.setenv("WANDB_BASE_URL", "http://127.0.0.1:9")  # nobody is there
    for attempt in range(4):  # with the processors overloaded, wandb's service has kept no rows; the cause is unknown
        run = _train(data, tmp_path / f"run-{attempt}", ("wandb",))
        (folder,) = (run.path / "wandb").glob("offline-run-*")
        rows, settings = _kept_by_wandb(next(folder.glob("*.wandb")))
        if rows:
            break
    found: dict[str, list[tuple[int, float]]] = {}
    for row in rows:
        step = row.pop("training_step")
        for name, value in row.items():
            if not name.startswith("_") and isinstance(value, int | float):
                found.setdefault(name, []).append((step, value))
    for name, curve in _curves(run).items():
        assert found[name] == [(step, pytest.approx(value)) for step, value in curve], name
    assert settings["model"] == "dmotion"
    assert settings["fingerprint"] == run.spec.fingerprint


def _records(content: bytes) -> Iterator[bytes]:
    """The records of a LevelDB log, in which wandb keeps them behind seven bytes of its own.

    A record is a checksum (four bytes), a length (two) and a kind: whole, or the first, a middle or the last part.
    """
    assert content[:4] == b":W&B"
    place, parts = 7, b""
    while place + 7 <= len(content):
        left = 2**15 - place % 2**15
        if left < 7:
            place += left
            continue
        _, length, kind = struct.unpack_from("<IHB", content, place)
        parts += content[place + 7 : place + 7 + length]
        place += 7 + length
        if kind in (1, 4):
            yield parts
            parts = b""


def _kept_by_wandb(path: Path) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """The rows and the settings in a file that ``wandb sync`` would send."""
    from wandb.proto import wandb_internal_pb2

    rows, settings = [], {}
    for content in _records(path.read_bytes()):
        record = wandb_internal_pb2.Record()
        record.ParseFromString(content)
        if record.WhichOneof("record_type") == "history":
            items = record.history.item
            rows.append({item.key or "/".join(item.nested_key): json.loads(item.value_json) for item in items})
        for item in record.run.config.update:
            settings[item.key] = json.loads(item.value_json)
    return rows, settings


def test_wandb_that_cannot_begin_costs_a_sentence(data, tmp_path, monkeypatch) -> None:
    import wandb

    def refuse(**_: Any) -> None:
        raise wandb.errors.UsageError("no such entity")

    monkeypatch.setattr(wandb, "init", refuse)
    with pytest.raises(RunError, match="cannot begin: no such entity"):
        _train(data, tmp_path / "run", ("wandb",))


@pytest.mark.parametrize("name", ["tensorboard", "wandb"])
def test_a_package_that_is_not_there_is_named_with_its_extra(monkeypatch, name) -> None:
    find = importlib.util.find_spec
    monkeypatch.setattr(importlib.util, "find_spec", lambda wanted: None if wanted == name else find(wanted))
    with pytest.raises(PackageNotInstalled, match=rf"'--log {name}|--log {name} needs .* pip install 'dmbench\[{name}"):
        require_trackers(["tensorboard", "wandb"])


@pytest.mark.slow
def test_neither_is_loaded_without_being_asked_for(data, tmp_path) -> None:
    before = {name for name in sys.modules if name.partition(".")[0] in ("tensorboard", "wandb")}
    _train(data, tmp_path / "run", ())
    assert {name for name in sys.modules if name.partition(".")[0] in ("tensorboard", "wandb")} == before
