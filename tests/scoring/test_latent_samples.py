"""What labels do not decide is computed once for all label budgets of a training, and is what it would be alone."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from known_model import Known, NoConfig
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.action_to_latent import ActionToLatent, JointActionToLatent
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.registry import model_class
from dmotion_bench.scoring.latent_samples import learned_from_video
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.storage.dataset import Dataset

QUICK = ScoreSettings(horizon=3, resamples=100)


class Brightens(Known):
    """Its latent action is how bright the next frame is; a table says what an action does to that."""

    def __init__(self, offset: float, levels: tuple[float, ...]) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
        self.table = ActionToLatent(Discrete.numbered(4), 1)
        self.table.rows.copy_(torch.tensor(levels)[:, None])
        self.offset.fill_(offset)

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        return (following - current).mean((1, 2, 3))[:, None] + self.offset

    def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        return current + latent[:, :, None, None]

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        return self.predict_with_latent(previous, current, self.table(action))


FEW, MANY = (0.0, 0.1, 0.0, 0.0), (0.2, 0.1, -0.1, 0.0)


def scored(model: Known, grid: Dataset, shared: SharedSamples) -> tuple[list[dict[str, object]], list[str]]:
    """The model's samples, and what was done for them."""
    done: list[str] = []

    def note(what: str, now: int, total: int) -> None:
        if now == total:
            done.append(what)

    how = Execution(progress=note)
    samples = score_model(model, grid, metrics=("prediction",), settings=QUICK, how=how, shared=shared).samples
    return [row for row in samples.to_pylist() if row["predictor"] == "model"], done


@pytest.mark.slow
def test_another_label_budget_takes_them_over(grid: Dataset) -> None:
    alone, done = scored(Brightens(0.0, MANY), grid, SharedSamples())
    assert done[-2:] == ["single steps", "latent actions"]

    shared = SharedSamples()
    first, _ = scored(Brightens(0.0, FEW), grid, shared)
    second, done = scored(Brightens(0.0, MANY), grid, shared)

    assert done == ["single steps"]
    assert str(second) == str(alone)  # NaN equals itself as text
    assert [row["mse"] for row in first] != [row["mse"] for row in second]
    assert [row["motion"] for row in first] == [row["motion"] for row in second]


@pytest.mark.slow
def test_another_training_has_its_own(grid: Dataset) -> None:
    shared = SharedSamples()
    first, _ = scored(Brightens(0.0, FEW), grid, shared)
    second, done = scored(Brightens(0.5, FEW), grid, shared)
    assert "latent actions" in done
    assert [row["motion"] for row in first] != [row["motion"] for row in second]


@pytest.mark.slow
@pytest.mark.parametrize(("others", "again"), [(3, False), (4, True)])
def test_those_of_four_trainings_are_remembered(grid: Dataset, others: int, *, again: bool) -> None:
    shared = SharedSamples()
    for number in range(others + 1):
        scored(Brightens(float(number), FEW), grid, shared)
    _, done = scored(Brightens(0.0, MANY), grid, shared)
    assert ("latent actions" in done) is again


def test_models_without_latent_actions_are_not_asked(grid: Dataset, copy_last: Known) -> None:
    _, done = scored(copy_last, grid, SharedSamples())
    assert "latent actions" not in done


@pytest.mark.parametrize("name", ["dmotion", "lapo", "clasp"])
def test_what_labels_teach_a_model_is_left_out(name: str) -> None:
    kind = model_class(name)
    inputs = ModelInputs(height=128, width=128, actions=Discrete.numbered(4))
    model = kind(kind.configure(kind.architectures[0]), inputs)
    before = learned_from_video(model)
    for part in model.modules():
        if isinstance(part, ActionToLatent):
            part.rows.fill_(0.5)
    assert learned_from_video(model) == before
    next(model.parameters()).data.add_(1)
    assert learned_from_video(model) != before


def test_which_agent_is_whose_is_not_left_out() -> None:
    kind = model_class("dmotion")
    config = dataclasses.replace(kind.configure("compact"), agents=2)
    actions = Discrete.joint(("up", "down"), ("left", "right"))
    model = kind(config, ModelInputs(height=128, width=128, actions=actions))
    before = learned_from_video(model)
    (joint,) = (part for part in model.modules() if isinstance(part, JointActionToLatent))
    for table in joint.tables:
        table.rows.fill_(0.5)
    assert learned_from_video(model) == before
    joint.order.copy_(joint.order.flip(0))
    assert learned_from_video(model) != before
