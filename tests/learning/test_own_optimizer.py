"""A model's own optimiser: trained with, resumed to the same bits, and refused in words where it cannot be."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from sound_models import Sound, breaks
from torch import nn
from walking_square import record_walks

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.model import ModelInputs, TrainingConfig
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.optimizer import learning_rate, optimizer_of, set_learning_rate
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.testing import check_model
from dmotion_bench.workspace import Workspace

SETTINGS = ("batch_size=4", "epochs=0.4", "validations=2", "schedule=linear", "learning_rate=0.01")
INPUTS = ModelInputs(height=16, width=16, actions=Discrete.numbered(4))


class WithMomentum(Sound):
    """Trained by gradient descent with momentum, its biases at twice the rate."""

    def make_optimizer(self, config: TrainingConfig) -> torch.optim.Optimizer:
        biases = {"params": [self.layer.bias], "lr": 2 * config.learning_rate}
        return torch.optim.SGD([{"params": [self.layer.weight]}, biases], lr=config.learning_rate, momentum=0.9)


class Counting(torch.optim.Optimizer):
    """Keeps numbers of each parameter, and tensors of other types and shapes than its own."""

    def __init__(self, parameters: Any, lr: float) -> None:
        super().__init__(parameters, {"lr": lr})

    @torch.no_grad()
    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Descend, by rates that all of the state decides."""
        for group in self.param_groups:
            for parameter in group["params"]:
                state, gradient = self.state[parameter], parameter.grad
                state["count"] = state.get("count", 0) + 1
                state["decayed"] = 0.9 * state.get("decayed", 1.0)
                state["steps"] = state.get("steps", torch.zeros((), dtype=torch.int64)) + 1
                state["sum"] = state.get("sum", 0.0) + gradient.double().square()
                state["rows"] = state["sum"].flatten(1).mean(1, keepdim=True) if gradient.ndim > 1 else state["sum"]
                scale = (1 - 0.9 ** state["count"]) * (1 + state["decayed"]) * float(state["steps"]) ** 0.5
                parameter -= group["lr"] * gradient / scale / (1 + float(state["rows"].sum()))


class WithCounts(Sound):
    """Trained by what keeps counts."""

    def make_optimizer(self, config: TrainingConfig) -> torch.optim.Optimizer:
        return Counting(self.parameters(), config.learning_rate)


class WithFactors(Sound):
    """Trained by torch's own optimiser that keeps a mean of each row and each column."""

    def make_optimizer(self, config: TrainingConfig) -> torch.optim.Optimizer:
        return torch.optim.Adafactor(self.parameters(), lr=config.learning_rate)


class Stopped(Exception):
    """Raised by a progress callback."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


@pytest.fixture
def train_it(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[..., Run]:
    def to_its_end(folder: Path, stop_at: int | None = None, kind: type[Sound] = WithMomentum) -> Run:
        for module in ("manifest", "start"):
            monkeypatch.setattr(f"dmotion_bench.learning.runs.{module}.model_class", lambda name: kind)

        def on_step(report: StepReport) -> None:
            if report.step == stop_at:
                raise Stopped

        asked = TrainingRequest(model="ed-cnn", labels="100%", settings=SETTINGS, threads=1)
        dataset = Dataset.open(recorded)
        run = open_run(asked, dataset, folder, Workspace(folder.parent))
        train(run, training_data(run, dataset), launch("cpu"), on_step)
        return Run.open(folder)

    return to_its_end


def test_steps_are_those_of_the_models_optimizer() -> None:
    torch.manual_seed(0)
    model, config = WithMomentum(WithMomentum.Config(), INPUTS), TrainingConfig(epochs=1, learning_rate=0.1)
    weight, bias = model.layer.weight.detach().clone(), model.layer.bias.detach().clone()
    optimizer = optimizer_of(model, config)
    velocity = 0.0
    for progress in (0.2, 0.5, 0.9):
        set_learning_rate(optimizer, rate := learning_rate(config, progress))
        for parameter in model.parameters():
            parameter.grad = torch.ones_like(parameter)
        optimizer.step()
        velocity = 0.9 * velocity + 1
        weight -= rate * velocity
        bias -= 2 * rate * velocity
    torch.testing.assert_close(model.layer.weight.detach(), weight)
    torch.testing.assert_close(model.layer.bias.detach(), bias)


def test_a_killed_run_ends_with_the_same_bits(
    train_it: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
    whole = train_it(tmp_path / "whole")
    for stop_at in (2, 5):
        with pytest.raises(Stopped):
            train_it(tmp_path / "killed", stop_at)
        kept = checkpoint.load(tmp_path / "killed" / "last.safetensors")[0]
        state = {name: tensor for name, tensor in kept.items() if name.startswith("optimizer/")}
        assert sorted(state) == ["optimizer/0/momentum_buffer", "optimizer/1/momentum_buffer"]
        assert all(tensor.abs().sum() > 0 for tensor in state.values())
    killed = train_it(tmp_path / "killed")
    assert whole.result is not None
    assert killed.result is not None
    assert killed.result["weights"] == whole.result["weights"]


@pytest.mark.parametrize("kind", [WithCounts, WithFactors])
def test_numbers_and_tensors_of_any_form_go_on_as_they_were(
    train_it: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, kind: type[Sound]
) -> None:
    monkeypatch.setattr("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)
    whole = train_it(tmp_path / "whole", kind=kind)
    for stop_at in (2, 4, 6):  # what is restored is written again
        with pytest.raises(Stopped):
            train_it(tmp_path / "killed", stop_at, kind)
    killed = train_it(tmp_path / "killed", kind=kind)
    assert whole.result is not None
    assert killed.result is not None
    assert killed.result["weights"] == whole.result["weights"]


def test_none_is_the_optimizer_of_the_settings() -> None:
    model = breaks(Sound, make_optimizer=lambda self, config: None)(Sound.Config(), INPUTS)
    optimizer = optimizer_of(model, TrainingConfig(epochs=1, optimizer="adamw"))
    assert type(optimizer) is torch.optim.AdamW


def test_an_own_optimizer_is_no_breach() -> None:
    check_model(WithMomentum, size=16)


class NoRate(torch.optim.Optimizer):
    """A group of it has no rate."""

    def __init__(self, parameters: Any) -> None:
        super().__init__(parameters, {})

    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        """Nothing."""


class KeepsAList(torch.optim.SGD):
    """Remembers what no checkpoint holds."""

    def step(self, closure: Any = None) -> None:  # type: ignore[override]
        super().step(closure)
        for group in self.param_groups:
            for parameter in group["params"]:
                self.state[parameter]["history"] = [1.0]


BREACHES: dict[str, tuple[Callable[[Any, TrainingConfig], Any], str]] = {
    "no optimiser": (lambda self, config: "sgd", "gives str; it gives a torch.optim.Optimizer or None"),
    "no rate": (lambda self, config: NoRate(self.parameters()), "NoRate, whose groups have no 'lr'"),
    "another's parameters": (
        lambda self, config: torch.optim.SGD(nn.Linear(2, 2).parameters(), lr=0.1),
        "an optimiser of other parameters than the model's",
    ),
    "needs a closure": (
        lambda self, config: torch.optim.LBFGS(self.parameters(), lr=0.1),
        r"step\(\) of the optimiser of make_optimizer\(config\) raised TypeError",
    ),
    "keeps a list": (
        lambda self, config: KeepsAList(self.parameters(), lr=0.1, momentum=0.9),
        r"keeps \[1.0\] as 'history' of a parameter; a checkpoint holds tensors and numbers",
    ),
    "an error": (lambda self, config: config.momentum, r"make_optimizer\(config\) raised AttributeError"),
}


@pytest.mark.parametrize("name", BREACHES)
def test_what_cannot_be_is_said(name: str) -> None:
    method, sentence = BREACHES[name]
    with pytest.raises(ModelContractBroken, match=sentence):
        check_model(breaks(Sound, make_optimizer=method), size=16)
