"""Fine-tuning: a model that needs only another row of its table finds it, and one that is right is left alone."""

from __future__ import annotations

from dataclasses import dataclass, replace

import pytest
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import RunError
from dmotion_bench.learning.action_to_latent import ActionToLatent
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import HELD_BACK, LabelBudget
from dmotion_bench.learning.data.stored_demonstrations import StoredDemonstrations, in_memory
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.demonstrations import Demonstrations
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TrainingConfig
from dmotion_bench.learning.training.adaptation import AT_ONCE, finetune
from dmotion_bench.specs import Supervision


@dataclass(frozen=True, kw_only=True)
class Nothing:
    """No settings."""


class Brighter(ForwardModel[Nothing]):
    """The next frame is the last one, brighter by what the action's latent says, times a gain."""

    supervision, paper, Config = Supervision.NONE, "test", Nothing

    def __init__(self, config, inputs) -> None:
        super().__init__(config, inputs)
        self.gain = torch.nn.Parameter(torch.ones(()))
        self.table = ActionToLatent(inputs.actions, 1)

    def losses(self, batch):
        return Losses(total=self.gain)

    def predict(self, previous, current, action):
        return current * self.gain + self.table(action)[..., None, None]


def _shown(count: int, steps: tuple[float, float], gain: float = 1.0) -> Demonstrations:
    current = torch.rand(count, 3, 4, 4, generator=torch.Generator().manual_seed(0)) - 0.5
    action = torch.arange(count) % 2
    brighter = torch.tensor(steps)[action][:, None, None, None]
    return Demonstrations(previous=current, current=current, next=current * gain + brighter, action=action)


def _model() -> Brighter:
    return Brighter(Nothing(), ModelInputs(height=4, width=4, actions=Discrete.numbered(2)))


CONFIG = TrainingConfig(epochs=1, adaptation="finetuned", adaptation_steps=400, adaptation_rate=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("count", [2, 16])
def test_rows_and_weights_are_found_by_gradient(count) -> None:
    model, shown = _model(), _shown(count, (0.2, -0.3), gain=0.5)
    kept = finetune(model, shown, CONFIG, seed=0, precision="float32")
    assert kept > 0
    torch.testing.assert_close(model.table.rows, torch.tensor([[0.2], [-0.3]]), atol=0.02, rtol=0)
    torch.testing.assert_close(model.gain.detach(), torch.tensor(0.5), atol=0.05, rtol=0)
    assert not model.table.rows.requires_grad


@pytest.mark.slow
def test_what_predicts_the_transitions_left_out_worse_is_not_kept() -> None:
    model = _model()
    model.table.fit(torch.tensor([[0.2], [-0.3]]), torch.tensor([0, 1]))
    shown = _shown(16, (0.2, -0.3))
    before = model.state_dict()["gain"].clone()
    assert finetune(model, shown, CONFIG, seed=0, precision="float32") == 0
    assert torch.equal(model.gain, before)


class Averaged(Brighter):
    """Learns its table from demonstrations, and remembers of how many."""

    def align(self, demonstrations):
        self.seen = (*getattr(self, "seen", ()), len(demonstrations))
        self.table.fit((demonstrations.next - demonstrations.current).mean((1, 2, 3))[:, None], demonstrations.action)


@pytest.mark.parametrize("noise", [0.0, 0.3])
def test_the_averages_that_compete_with_steps_do_not_know_what_is_left_out(noise) -> None:
    """Else the table would have been fitted to the very transitions that decide."""
    model = Averaged(Nothing(), ModelInputs(height=4, width=4, actions=Discrete.numbered(2)))
    shown, drawn = _shown(16, (0.2, -0.3)), torch.Generator().manual_seed(2)
    shown = replace(shown, next=shown.next + noise * torch.randn(16, 1, 1, 1, generator=drawn))
    kept = finetune(model, shown, replace(CONFIG, adaptation_steps=20), seed=0, precision="float32")
    assert model.seen == ((14, 16) if kept == 0 else (14,))
    if not noise:
        assert kept == 0
        torch.testing.assert_close(model.table.rows, torch.tensor([[0.2], [-0.3]]))


class Watched(StoredDemonstrations):
    """Keeps count of the demonstrations that are images at once."""

    most = 0

    def subset(self, index):
        Watched.most = max(Watched.most, len(index))
        return super().subset(index)


def test_stored_demonstrations_are_read_batch_by_batch_and_teach_the_same(dataset) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    given = LabelBudget(dataset, LabelRequest.parse("all"), seed=1).demonstrations(triplets)
    config = replace(CONFIG, adaptation_steps=3, batch_size=4)
    inputs = ModelInputs(height=dataset.spec.height, width=dataset.spec.width, actions=dataset.spec.actions)
    found = []
    for shown in (in_memory(given, torch.device("cpu")), Watched(given, torch.device("cpu"))):
        model = Brighter(Nothing(), inputs)
        assert finetune(model, shown, config, seed=0, precision="float32") > 0
        found.append(model.state_dict())
    assert all(torch.equal(found[0][name], found[1][name]) for name in found[0])
    held, learned = len(given.rows) // HELD_BACK, len(given.rows) - len(given.rows) // HELD_BACK
    assert Watched.most == max(config.batch_size, min(held, AT_ONCE)) < learned


@pytest.mark.parametrize("count", [2, 16])
def test_what_diverges_is_said_or_not_kept(count) -> None:
    """Without transitions that are left out the last step is kept, whatever became of the weights."""
    model, shown = _model(), _shown(count, (0.2, -0.3))
    config = replace(CONFIG, adaptation_steps=10, adaptation_rate=1e30)
    if count == 2:
        with pytest.raises(RunError, match=r"diverged within its 10 steps: .* is (nan|inf)\. Try a lower rate"):
            finetune(model, shown, config, seed=0, precision="float32")
    else:
        assert finetune(model, shown, config, seed=0, precision="float32") == 0
        assert torch.equal(model.gain, torch.ones(()))


@pytest.mark.slow
def test_the_same_seed_ends_with_the_same_bits_and_another_does_not() -> None:
    found = []
    for seed in (0, 0, 1):
        model = _model()
        finetune(model, _shown(16, (0.2, -0.3), gain=0.5), CONFIG, seed=seed, precision="float32")
        found.append(model.table.rows)
    assert torch.equal(found[0], found[1])
    assert not torch.equal(found[0], found[2])
