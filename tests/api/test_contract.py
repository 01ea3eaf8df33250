"""What is said of somebody's own model before a training and where one fails, whoever trains it."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
import torch
from known_model import Known, NoConfig, Raising
from walking_square import record_walks

import dmotion_bench as dm
from dmotion_bench.actions import Discrete
from dmotion_bench.api import contract, side_by_side
from dmotion_bench.api.contract import explaining
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.execution.local_executor import SerialExecutor
from dmotion_bench.learning.model import Losses, ModelInputs, TripletBatch
from dmotion_bench.learning.runs.run import RunSpec
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.learning.training.table import Row
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.testing.trial import ModelTrial
from dmotion_bench.workspace import Workspace


def _fail() -> None:
    inputs = ModelInputs(height=16, width=16, actions=Discrete.numbered(4))
    Raising(NoConfig(), inputs).losses(ModelTrial(Raising, "compact", inputs).batch(2, actions=False))


class Learning(Known):
    """Has something to learn, and fails while it does."""

    def __init__(self, config: NoConfig, inputs: ModelInputs) -> None:
        super().__init__(config, inputs)
        self.weight = torch.nn.Parameter(torch.zeros(1))

    def losses(self, batch: TripletBatch) -> Losses:
        raise KeyError("boom")


LINE = r"Raising\.losses raised KeyError in line \d+ of known_model\.py: 'boom'\. The contract is in"


def test_the_line_of_somebodys_own_model_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    dm.register_model("raising", Raising)
    with pytest.raises(ModelContractBroken, match=f"^{LINE}"), explaining("raising", None):
        _fail()
    known = ModelContractBroken("Raising: losses raised KeyError.")
    said = f"^the training failed: {LINE} .* Before it began: Raising: losses raised KeyError\\.$"
    with pytest.raises(ModelContractBroken, match=said), explaining("raising", known):
        _fail()


def test_what_the_models_file_did_not_raise_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    dm.register_model("raising", Raising)
    with pytest.raises(ZeroDivisionError), explaining("raising", None):
        raise ZeroDivisionError
    with pytest.raises(KeyError), explaining("dmotion", None):  # a model of ours: the whole traceback is wanted
        _fail()


class Cautious(Learning):
    """Fails where matrices are multiplied in bfloat16, and nowhere else."""

    def losses(self, batch: TripletBatch) -> Losses:
        if torch.is_autocast_enabled("cpu"):
            raise KeyError("halved")
        return Losses(total=(self.weight * batch.current).square().mean() + self.weight.sum())


@pytest.mark.parametrize("has_bf16", [False, True])
@pytest.mark.parametrize("asked", ["auto", "bf16", "float32"])
def test_bfloat16_is_tried_before_a_training_that_may_compute_in_it(
    asked: str, has_bf16: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.learning.hardware.precision.has_bf16", lambda _: has_bf16)
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    dm.register_model("cautious", Cautious)
    dataset = Dataset.open(record_walks(tmp_path / "data" / "walk-tiny"))
    request = TrainingRequest(model="cautious", preset=Preset.TINY, settings=(f"precision={asked}",))
    breach = contract.breach_before(open_run(request, dataset, None, Workspace(tmp_path)))
    assert ("KeyError in bfloat16" in str(breach)) == (has_bf16 and asked != "float32")


@pytest.mark.slow
def test_a_model_that_others_train_is_tried_once_before_they_begin(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Whatever the seeds and label budgets are; what fails is said with what was known."""
    tried: list[str] = []

    def submitted(*_: object, **__: object) -> SerialExecutor:
        tried.append("submitted")
        return SerialExecutor()

    def count(spec: RunSpec) -> ModelContractBroken | None:
        tried.append(spec.model)
        return breach(spec)

    breach = contract._breach
    monkeypatch.setattr(contract, "_breach", count)
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    monkeypatch.setattr(side_by_side, "make_executor", submitted)
    dm.register_model("learning", Learning)
    rows = [
        *(Row(model="learning", labels=labels, seed=seed) for seed in (0, 1) for labels in ("none", "one-shot")),
        Row(model="no-such-model", labels="", seed=0),
    ]
    request = TrainingRequest(model="", preset=Preset.TINY, settings=("epochs=0.2",))
    warned: list[str] = []
    outcomes = side_by_side.train_every(
        request,
        rows,
        Dataset.open(record_walks(tmp_path / "data" / "walk-tiny")),
        Workspace(tmp_path),
        side_by_side.Hands(workers=2),
        lambda _: None,
        warn=warned.append,
    )
    *failed, unknown = (outcome.error for outcome in outcomes)
    assert tried == ["learning", "submitted"]
    [told] = warned
    known, begins, _ = told.partition(" The training begins all the same.")
    assert known.startswith("Learning: ")
    assert begins
    line = r"Learning\.losses raised KeyError in line \d+ of test_contract\.py: 'boom'\. The contract is in .*"
    said = rf"the training failed: {line}\. Before it began: {re.escape(known)}"
    assert [bool(re.fullmatch(said, str(one))) for one in failed] == [True] * 4
    assert unknown is not None
    assert unknown.startswith("no model named 'no-such-model'")
