"""H@1 and MRR against brute force, and of models that know everything or nothing."""

from __future__ import annotations

from unittest.mock import patch

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from known_model import Known, NoConfig
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.scoring import latent_ranking
from dmotion_bench.scoring.latent_ranking import rank_rollouts, ranks
from dmotion_bench.scoring.samples import column
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.storage.dataset import Dataset

from .conftest import Oracle

CPU = torch.device("cpu")


class KnowingOracle(Oracle):
    """Embeds a frame as its pixels."""

    def embedding(self, state: tuple[Tensor, Tensor]) -> Tensor:
        return state[1]


class Collapsed(Known):
    """Has one state for all pictures."""

    state = 0.5

    def embedding(self, state: tuple[Tensor, Tensor]) -> Tensor:
        return torch.full((len(state[1]), 3), self.state)


class KnowingNothing(Known):
    """Stays where it was; the first rollout's place is as good as another."""

    def embedding(self, state: tuple[Tensor, Tensor]) -> Tensor:
        return state[1]


@given(seed=st.integers(0, 10_000), count=st.integers(1, 12))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_ranks_are_those_of_brute_force(seed: int, count: int) -> None:
    generator = np.random.default_rng(seed)
    predicted, true = generator.integers(-2, 3, (2, count, 4)).astype(np.float64)  # whole numbers: many ties
    pictures = generator.integers(0, 3, count)
    expected = []
    for row in range(count):
        distances = [((predicted[row] - true[other]) ** 2).sum() for other in range(count)]
        nearer = sum(distance < distances[row] for distance in distances)
        others = [distance for distance, one in zip(distances, pictures, strict=True) if one != pictures[row]]
        alone = not others and set(distances) == {distances[row]}
        expected.append(np.nan if alone else 1 + nearer + others.count(distances[row]) / 2)
    for at_once in (1, 5, 1024):  # the blocks of rows do not matter
        with patch.object(latent_ranking, "ROWS_AT_ONCE", at_once):
            found = ranks(*(torch.from_numpy(one) for one in (predicted, true, pictures)))
            np.testing.assert_array_equal(found, expected)


@pytest.mark.slow
def test_who_knows_what_comes_ranks_first_and_who_does_not_does_not(grid: Dataset) -> None:
    held_out = HeldOut(grid, "test")
    oracle = rank_rollouts(KnowingOracle(grid), held_out, horizon=4, batch_size=5, device=CPU)
    assert oracle is not None
    assert oracle.hit_at_1.shape == (held_out.count_rollouts(4), 4)
    np.testing.assert_array_equal(oracle.hit_at_1, 1)
    np.testing.assert_array_equal(oracle.reciprocal_rank, 1)

    nothing = KnowingNothing(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
    still = rank_rollouts(nothing, held_out, horizon=4, batch_size=5, device=CPU)
    assert still is not None
    assert still.hit_at_1[:, 3].mean() < 1
    assert ((still.reciprocal_rank == 1) == (still.hit_at_1 == 1)).all()
    other = rank_rollouts(nothing, held_out, horizon=4, batch_size=64, device=CPU)
    assert other is not None
    np.testing.assert_array_equal(other.reciprocal_rank, still.reciprocal_rank)


def test_a_state_that_is_the_same_for_all_pictures_has_no_hit(grid: Dataset) -> None:
    held_out = HeldOut(grid, "test")
    model = Collapsed(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
    found = rank_rollouts(model, held_out, horizon=4, batch_size=5, device=CPU)
    assert found is not None
    assert found.hit_at_1.max() == 0
    assert found.reciprocal_rank.max() < 0.5

    for broken in (float("nan"), float("inf")):
        model.state = broken
        with pytest.raises(ModelContractBroken, match="the states of Collapsed hold NaN or infinity"):
            rank_rollouts(model, held_out, horizon=4, batch_size=5, device=CPU)


def test_a_model_that_draws_no_frames_has_the_ranks_of_one_that_does(grid: Dataset) -> None:
    class Blind(KnowingNothing):
        needs_pixels = False

        def frame(self, state: tuple[Tensor, Tensor]) -> Tensor:
            raise AssertionError("asked for a frame")

    chosen = ScoreSettings(horizon=3, resamples=100)
    inputs = ModelInputs(height=128, width=128, actions=Discrete.numbered(4))
    sees, blind = (
        score_model(kind(NoConfig(), inputs), grid, metrics=("prediction", "rollout"), settings=chosen)
        for kind in (KnowingNothing, Blind)
    )

    ranked = {name: one for name, one in sees.figures.items() if name.startswith(("rollout_hit", "rollout_reciprocal"))}
    assert len(ranked) == 6
    assert blind.figures == ranked
    assert blind.reference == {}


def test_a_rollout_alone_has_no_rank(grid: Dataset) -> None:
    chosen = ScoreSettings(horizon=3, resamples=100)
    with patch("dmotion_bench.scoring.transitions.HeldOut._starts", lambda *_: [(int(grid.split("test")[0]), 1)]):
        scores = score_model(KnowingOracle(grid), grid, metrics=("rollout",), settings=chosen)
    assert "rollout_mse[1]" in scores.figures
    assert not [name for name in scores.figures if "hit_at_1" in name or "reciprocal_rank" in name]


def test_a_model_without_a_space_of_its_own_has_no_rank(grid: Dataset) -> None:
    assert rank_rollouts(Oracle(grid), HeldOut(grid, "test"), horizon=4, batch_size=5, device=CPU) is None


def test_the_report_has_them_for_each_step(grid: Dataset) -> None:
    chosen = ScoreSettings(horizon=3, resamples=100)
    scores = score_model(KnowingOracle(grid), grid, metrics=("rollout",), settings=chosen)
    for step in (1, 2, 3):
        assert scores.figures[f"rollout_hit_at_1[{step}]"].mean == 1
        assert scores.figures[f"rollout_reciprocal_rank[{step}]"].mean == pytest.approx(1)
    assert "rollout_hit_at_1[1]" not in scores.reference["copy_last"]
    of_model = scores.samples.filter([name == "model" for name in scores.samples["predictor"].to_pylist()])
    assert (column(of_model, "hit_at_1") == 1).all()
