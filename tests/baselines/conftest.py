"""Noise for pictures, and models built the same each time."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import pytest
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.model import Demonstrations, ForwardModel, ModelInputs, TripletBatch

SIZE, ACTIONS = 32, 4


def images(count: int, seed: int) -> torch.Tensor:
    return torch.rand(count, 3, SIZE, SIZE, generator=torch.Generator().manual_seed(seed)) * 2 - 1


@pytest.fixture
def batch() -> TripletBatch:
    return TripletBatch(
        previous=images(6, 1), current=images(6, 2), next=images(6, 3), action=torch.tensor([0, 1, 2, 3, 0, 1])
    )


@pytest.fixture
def video(batch: TripletBatch) -> TripletBatch:
    """The same without its actions."""
    return TripletBatch(previous=batch.previous, current=batch.current, next=batch.next)


@pytest.fixture
def demonstrations(batch: TripletBatch) -> Demonstrations:
    return Demonstrations(previous=batch.previous, current=batch.current, next=batch.next, action=batch.action)


@pytest.fixture
def build() -> Callable[..., Any]:
    def built(kind: type[ForwardModel[Any]], **settings: Any) -> ForwardModel[Any]:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return kind(
                kind.Config(**settings), ModelInputs(height=SIZE, width=SIZE, actions=Discrete.numbered(ACTIONS))
            )

    return built


@pytest.fixture
def predicted_by_rows() -> Callable[..., torch.Tensor]:
    """What a model predicts for each triplet where the rows of its table are one latent action for each."""

    def predicted(model: ForwardModel[Any], video: TripletBatch, latent: torch.Tensor) -> torch.Tensor:
        model.table.rows = latent
        model.inputs = dataclasses.replace(model.inputs, actions=Discrete.numbered(len(latent)))
        return model.predict(video.previous, video.current, torch.arange(len(latent)))

    return predicted


@pytest.fixture
def step() -> Callable[..., float]:
    """So many steps of Adam on one batch; gives the last loss."""

    def stepped(model: ForwardModel[Any], batch: TripletBatch, steps: int = 1, rate: float = 3e-3) -> float:
        optimizer = torch.optim.Adam(model.parameters(), rate)
        for _ in range(steps):
            optimizer.zero_grad()
            loss = model.losses(batch).total
            loss.backward()
            optimizer.step()
        return loss.item()

    return stepped
