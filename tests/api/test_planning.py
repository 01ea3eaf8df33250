"""A control task as it is watched: what the recording asks of the model."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from noise_world import MOVES

from dmotion_bench.api.planning import Trial
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.viewing.control import SHOWN


def test_a_recording_gives_the_model_actions_in_32_bits_and_their_units(monkeypatch: pytest.MonkeyPatch) -> None:
    """As everybody does: weights that an action is multiplied with are in 32 bits."""
    asked: list[torch.Tensor] = []

    def predicted(model: Any, previous: Any, current: Any, sequences: torch.Tensor) -> torch.Tensor:
        asked.append(sequences)
        return torch.zeros(*sequences.shape[:2], 8, 8, 3, dtype=torch.uint8)

    monkeypatch.setattr("dmotion_bench.api.planning.predicted", predicted)
    monkeypatch.setattr("dmotion_bench.api.planning.log_step", lambda *_: None)
    stub: Any = SimpleNamespace(
        needs_pixels=True, inputs=SimpleNamespace(actions=MOVES), spec=None, frame=None, distance=1.0
    )
    frames = np.zeros((1, 8, 8, 3), np.uint8)
    candidates = np.ones((1, 5, 3, 2))
    scene: Any = SimpleNamespace(
        context=SimpleNamespace(observation=Observation(previous=frames, current=frames, goals=frames)),
        decision=SimpleNamespace(plan=SimpleNamespace(candidates=candidates)),
        worlds=[stub],
    )
    trial = Trial(who="it", model=stub, dataset=stub, problem=stub, chosen=ControlScoring(), agent=stub)

    trial._log(stub, scene)

    assert asked[0].dtype == torch.float32
    torch.testing.assert_close(asked[0], torch.tensor(MOVES.high).expand(SHOWN, 3, 2))
