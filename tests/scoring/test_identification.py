"""The figures of identification on motions and maps whose answers are known."""

from __future__ import annotations

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
from dmotion_bench.scoring.identification import (
    above_otsu,
    identify,
    motion_within_over_between,
    overlap_of,
    probe_accuracy,
    resized,
    swap_partners,
)
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.statistics import EpisodeBootstrap
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.storage.dataset import Dataset


class SeesGreen(Known):
    """Knows the agent by its colour: its map is where green is, its motion how far green's mean goes [px]."""

    def __init__(self) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))

    def agent_map(self, current: Tensor) -> Tensor:
        return ((current[:, 1] > 0.9) & (current[:, 0] < -0.9)).float() * -3 + 0.1

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        places = []
        for image in (current, following):
            weight = (self.agent_map(image) < 0).float()
            axis = torch.arange(128.0)
            total = weight.sum((1, 2))
            places.append(torch.stack([(weight.sum(1) @ axis) / total, (weight.sum(2) @ axis) / total], 1))
        return places[1] - places[0]

    def pixel_shift(self, motion: Tensor) -> Tensor:
        return motion

    def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        """Grey whose level is the motion: one pixel more to the right is one level brighter."""
        level = (latent[:, 0] + 2 * latent[:, 1] + 127.5) / 127.5 - 1
        return level[:, None, None, None].expand_as(current)


class KnowsNoPlace(Known):
    """Has a latent action, but neither a map of the agent nor a shift in pixels."""

    def __init__(self) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
        self.eye = SeesGreen()

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        return self.eye.latent_action(previous, current, following).flip(1) * -3

    def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        return self.eye.predict_with_latent(previous, current, latent.flip(1) / -3)


@pytest.mark.slow
def test_a_model_is_asked_for_what_it_has(grid: Dataset) -> None:
    scores = score_model(KnowsNoPlace(), grid, metrics=("prediction",), settings=ScoreSettings(resamples=200))
    whole = score_model(SeesGreen(), grid, metrics=("prediction",), settings=ScoreSettings(resamples=200))

    assert set(whole.figures) - set(scores.figures) == {"agent_iou", "motion_shift_error"}
    for name in ("motion_probe_accuracy", "mse_true_motion", "motion_swap_change"):
        assert scores.figures[name].mean == pytest.approx(whole.figures[name].mean, rel=1e-3)


def test_a_model_that_sees_the_agent_scores_as_one(grid: Dataset) -> None:
    found = identify(SeesGreen(), HeldOut(grid, "test"), batch_size=16, device=torch.device("cpu"))

    np.testing.assert_array_equal(found.agent_iou, 1)
    np.testing.assert_allclose(found.motion_shift_error, 0, atol=1e-4)
    np.testing.assert_array_equal(found.motion_probe_accuracy, 1)
    np.testing.assert_allclose(np.abs(found.motion).max(1), 25.6, atol=0.7)


@pytest.mark.slow
def test_the_report_has_what_identification_found(grid: Dataset) -> None:
    scores = score_model(SeesGreen(), grid, metrics=("prediction",), settings=ScoreSettings(resamples=200))

    held = next(HeldOut(grid, "test").batches(10_000))
    partner = swap_partners(held.action)
    level = held.shifts[:, 0] @ (1, 2) + 127.5
    change = (np.rint(level) - np.rint(level[partner])) ** 2
    assert scores.figures["motion_swap_change"].mean == pytest.approx(change.mean(), rel=0.02)
    assert scores.figures["agent_iou"].mean == 1
    assert scores.figures["motion_within_over_between"].mean < 0.01
    assert scores.figures["mse_true_motion"].mean > scores.figures["mse"].mean
    assert not any(name.startswith("agent_iou") for name in scores.reference["copy_last"])


def test_latent_actions_and_maps_that_hold_no_numbers_are_refused(grid: Dataset) -> None:
    class Diverged(KnowsNoPlace):
        def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
            latent = super().latent_action(previous, current, following)
            latent[-1] = torch.nan
            return latent

    class SeesNothing(KnowsNoPlace):
        def agent_map(self, current: Tensor) -> Tensor:
            return torch.full_like(current[:, 0], torch.nan)

    class GoesNowhere(SeesGreen):
        def pixel_shift(self, motion: Tensor) -> Tensor:
            return motion * torch.nan

    class Overflowing(KnowsNoPlace):
        codebook_sizes = (8,)

        def chosen_codes(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
            return torch.full((len(current), 1, 1), 8)

    for model, said in (
        (Overflowing(), r"Overflowing\.chosen_codes gave the codes 8 to 8 of codebook 0, which has 8"),
        (Diverged(), "the latent actions of Diverged hold NaN or infinity"),
        (SeesNothing(), "the maps of agents of SeesNothing hold NaN or infinity"),
        (GoesNowhere(), "the shifts in pixels of GoesNowhere hold NaN or infinity"),
    ):
        with pytest.raises(ModelContractBroken, match=said):
            identify(model, HeldOut(grid, "test"), batch_size=256, device=torch.device("cpu"))


@pytest.mark.slow
def test_figures_do_not_depend_on_the_size_of_batches(grid: Dataset) -> None:
    small, large = (
        score_model(
            SeesGreen(), grid, settings=ScoreSettings(horizon=3, resamples=100), how=Execution(batch_size=size)
        ).samples
        for size in (5, 64)
    )

    order = [("predictor", "ascending"), ("metric", "ascending"), ("episode", "ascending"), ("step", "ascending")]
    order.append(("ahead", "ascending"))
    assert small.sort_by(order).equals(large.sort_by(order))


def test_otsu_parts_two_groups_and_leaves_a_flat_image() -> None:
    generator = torch.Generator().manual_seed(0)
    image = 0.1 * torch.rand(3, 20, 30, generator=generator)
    image[0, 2:5, 2:9] += 1
    image[1, 7:, :] += 40
    image[2] = 0.5

    above = above_otsu(image)

    assert above[0].sum() == 21
    assert above[0, 2:5, 2:9].all()
    assert above[1, 7:].all()
    assert not above[1, :7].any()
    assert not above[2].any()


def test_overlap_by_hand_and_at_another_resolution() -> None:
    masks = torch.zeros(3, 16, 16, dtype=torch.bool)
    masks[0, 4:8, 4:8] = True
    masks[1, 4:8, 4:8] = True
    maps = torch.zeros(3, 16, 16)
    maps[0, 4:8, 6:10] = -2.0  # its sign says nothing; half of it lies on the agent
    maps[1, 4:8, 4:8] = 1.0

    overlap = overlap_of(above_otsu(resized(maps, masks.shape[1:])), masks)

    assert overlap[:2].tolist() == pytest.approx([8 / 24, 1.0])
    assert torch.isnan(overlap[2])
    coarse = overlap_of(above_otsu(resized(maps[1:2, ::2, ::2], masks.shape[1:])), masks[1:2])
    assert 0.6 < coarse.item() <= 1


@settings(deadline=None, derandomize=True)
@given(st.lists(st.integers(0, 3), min_size=1, max_size=30))
def test_a_partner_is_the_next_of_another_action(actions: list[int]) -> None:
    partner = swap_partners(np.asarray(actions))

    for place, found in enumerate(partner.tolist()):
        onward = [(place + ahead) % len(actions) for ahead in range(1, len(actions))]
        assert found == next((other for other in onward if actions[other] != actions[place]), -1)


def test_the_probe_reads_what_is_there_and_nothing_from_noise() -> None:
    generator = np.random.default_rng(0)
    action, episode = generator.integers(0, 4, 800), np.repeat(np.arange(40), 20)
    direction = np.array([[0, -1], [0, 1], [-1, 0], [1, 0]])[action]
    stretched = np.stack([direction[:, 0] * 100, direction[:, 1] * 1e-3], 1)
    spread = np.array([20, 2e-4])

    assert probe_accuracy(stretched + spread * generator.normal(0, 1, (800, 2)), action, episode).mean() > 0.95
    assert 0.2 < probe_accuracy(generator.normal(0, 1, (800, 2)), action, episode).mean() < 0.3
    assert np.isnan(probe_accuracy(stretched, action, np.zeros(800))).all()  # nothing left to fit it on


def test_variance_within_over_between_by_its_definition() -> None:
    generator = np.random.default_rng(1)
    action, episode = generator.integers(0, 3, 300), np.repeat(np.arange(15), 20)
    motion = np.array([[0, 0], [1, 0], [0, 2]])[action] + 0.3 * generator.normal(0, 1, (300, 2)) + 7
    bootstrap = EpisodeBootstrap(episode)

    estimate = motion_within_over_between(motion, action, bootstrap)

    means = np.array([motion[action == one].mean(0) for one in range(3)])
    within = ((motion - means[action]) ** 2).sum(1).mean()
    between = ((means[action] - motion.mean(0)) ** 2).sum(1).mean()
    assert estimate is not None
    assert estimate.mean == pytest.approx(within / between)
    assert estimate.low < within / between < estimate.high
    assert estimate.high - estimate.low < 0.1
    steady = motion_within_over_between(np.eye(3)[action], action, bootstrap)
    assert steady is not None
    assert steady.mean == pytest.approx(0, abs=1e-12)
    assert motion_within_over_between(np.ones((300, 2)), action, bootstrap) is None


def test_where_one_action_alone_is_taken_there_is_no_variance_between_actions() -> None:
    motion, episode = np.random.default_rng(0).normal(size=(200, 4)).astype(np.float32), np.repeat(np.arange(10), 20)
    bootstrap = EpisodeBootstrap(episode)
    assert motion_within_over_between(motion, np.zeros(200, np.int64), bootstrap) is None

    rare = (episode == 0).astype(np.int64)  # a third of the draws have one action alone
    estimate = motion_within_over_between(motion + 3 * rare[:, None], rare, bootstrap)
    assert estimate is not None
    assert 0 < estimate.low < estimate.mean < estimate.high < 10 * estimate.mean
