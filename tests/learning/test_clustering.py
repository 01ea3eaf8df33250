"""Clustering: each agent's table is corrected by the video of its own latent actions, and no label is opened for it."""

from __future__ import annotations

from dataclasses import dataclass

import pytest
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import UsageError
from dmotion_bench.learning.action_to_latent import JointActionToLatent, tables_of
from dmotion_bench.learning.data.curriculum import TrainingData
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs
from dmotion_bench.learning.training.clustering import cluster, require_clusters
from dmotion_bench.specs import Supervision

JOINT = Discrete.joint(("up", "down"), ("near", "far"))
CPU = torch.device("cpu")


@dataclass(frozen=True, kw_only=True)
class Nothing:
    """No settings."""


class Two(ForwardModel[Nothing]):
    """Reads 1 or -1 off frames for the first agent and 3 or -3 for the second, in turn, all with a little noise."""

    supervision, paper, Config = Supervision.NONE, "test", Nothing

    def __init__(self, config, inputs, *, told: bool = True) -> None:
        super().__init__(config, inputs)
        if told:
            self.table = JointActionToLatent(inputs.actions, 2, 1)

    def losses(self, batch):
        return Losses(total=torch.zeros(()))

    def latent_action(self, previous, current, following):
        row = torch.arange(len(current))
        own = torch.stack([1.0 - 2 * (row % 2), 3.0 - 6 * (row // 2 % 2)], dim=1)
        return own + 0.2 * torch.sin(row * 2.4)[:, None]


def _model(**given) -> Two:
    return Two(Nothing(), ModelInputs(height=16, width=16, actions=JOINT), **given)


def test_each_agent_s_rows_move_into_its_own_clusters_and_no_label_is_opened(dataset) -> None:
    sets = {name: TripletSet.of_split(dataset, name) for name in ("train", "validation")}
    data = TrainingData(**sets, budget=LabelBudget(dataset, LabelRequest.parse("none"), seed=0))
    model = _model()
    model.table.fit(torch.tensor([[[1.4], [2.2]], [[-0.7], [-3.9]]]), torch.tensor([0, 3]))  # up/near, down/far
    cluster(model, data, CPU)
    first, second = (table.rows.flatten() for table in tables_of(model))
    torch.testing.assert_close(first, torch.tensor([1.0, -1.0]), atol=0.1, rtol=0)
    torch.testing.assert_close(second, torch.tensor([3.0, -3.0]), atol=0.1, rtol=0)
    assert not dataset.opened


def test_a_model_that_keeps_its_latent_actions_otherwise_is_refused() -> None:
    with pytest.raises(UsageError, match=r"^Two has no latent_action, or keeps latent actions in no ActionToLatent"):
        require_clusters(_model(told=False))
