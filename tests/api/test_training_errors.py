"""What a training says when a model fails in it: of somebody's own model the line, and what was known before."""

from __future__ import annotations

import pytest
from known_model import NoConfig, Raising

import dmotion_bench as dm
from dmotion_bench.actions import Discrete
from dmotion_bench.api.training import _explaining
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.testing.trial import ModelTrial


def _fail() -> None:
    inputs = ModelInputs(height=16, width=16, actions=Discrete.numbered(4))
    Raising(NoConfig(), inputs).losses(ModelTrial(Raising, "compact", inputs).batch(2, actions=False))


LINE = r"Raising\.losses raised KeyError in line \d+ of known_model\.py: 'boom'\. The contract is in"


def test_the_line_of_somebodys_own_model_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    dm.register_model("raising", Raising)
    with pytest.raises(ModelContractBroken, match=f"^{LINE}"), _explaining("raising", None):
        _fail()
    known = ModelContractBroken("Raising: losses raised KeyError.")
    said = f"^the training failed: {LINE} .* Before it began: Raising: losses raised KeyError\\.$"
    with pytest.raises(ModelContractBroken, match=said), _explaining("raising", known):
        _fail()


def test_what_the_models_file_did_not_raise_stays_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    dm.register_model("raising", Raising)
    with pytest.raises(ZeroDivisionError), _explaining("raising", None):
        raise ZeroDivisionError
    with pytest.raises(KeyError), _explaining("dmotion", None):  # a model of ours: the whole traceback is wanted
        _fail()
