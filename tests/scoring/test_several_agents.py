"""The identification figures of each of several agents; those of one agent keep their names."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from known_model import Known, NoConfig
from torch import Tensor

from dmotion_bench.figure_words import figure_words
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.scoring.identification import identify
from dmotion_bench.scoring.references import PublishedResult, published_for
from dmotion_bench.scoring.samples import read_samples, write_samples
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from recorders.grid_rules import JOINT_ACTIONS
from recorders.grid_things import FACTS, FACTS_OF_TWO
from recorders.grid_world import GridWorld

QUICK = ScoreSettings(resamples=100)
EACH = ("agent_iou", "motion_shift_error", "motion_probe_accuracy", "motion_within_over_between")


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    path = tmp_path_factory.mktemp("data") / "two-tiny"
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"agents": 2, "version": 2}, seed=3, episodes=30, frames=12
    )
    with DatasetWriter.create_or_resume(path, recipe, FACTS_OF_TWO) as writer:
        for shard in writer.missing:
            writer.write_shard(shard, record_episodes(GridWorld, recipe, writer.episodes_of(shard)))
        writer.finish()
    return Dataset.open(path)


class SeesOne(Known):
    """Knows the green agent by its colour, and nothing of the other."""

    blue = -1.0

    def __init__(self) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=JOINT_ACTIONS))

    def _map(self, current: Tensor, blue: float) -> Tensor:
        near = (current[:, 0] < -0.9) & (current[:, 1] > 0.9) & ((current[:, 2] - blue).abs() < 0.1)
        return near.float()

    def _motion(self, current: Tensor, following: Tensor, blue: float) -> Tensor:
        places = []
        for image in (current, following):
            weight, axis = self._map(image, blue), torch.arange(128.0)
            total = weight.sum((1, 2))
            places.append(torch.stack([(weight.sum(1) @ axis) / total, (weight.sum(2) @ axis) / total], 1))
        return places[1] - places[0]

    def agent_map(self, current: Tensor) -> Tensor:
        return self._map(current, -1.0)

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        return self._motion(current, following, -1.0)

    def pixel_shift(self, motion: Tensor) -> Tensor:
        return motion

    def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        return current + 0 * latent.sum()


class SeesBoth(SeesOne):
    """Knows each of them; ``swapped`` takes one for the other."""

    swapped = False

    def _colours(self) -> list[float]:
        return [1.0, -1.0] if self.swapped else [-1.0, 1.0]

    def agent_maps(self, current: Tensor) -> Tensor:
        return torch.stack([self._map(current, blue) for blue in self._colours()], 1)

    def agent_motions(self, latent: Tensor) -> Tensor:
        return latent.unflatten(1, (2, 2))

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        return torch.cat([self._motion(current, following, blue) for blue in self._colours()], 1)


class TakesOneForTheOther(SeesBoth):
    swapped = True


def figures(model: Known, dataset: Dataset) -> dict[str, float]:
    scores = score_model(model, dataset, metrics=("prediction",), settings=QUICK)
    return {name: estimate.mean for name, estimate in scores.figures.items()}


@pytest.mark.slow
def test_a_model_that_sees_both_scores_as_one_on_each(two: Dataset) -> None:
    found = figures(SeesBoth(), two)
    for agent in (0, 1):
        assert found[f"agent_iou[{agent}]"] == 1
        assert found[f"motion_shift_error[{agent}]"] == pytest.approx(0, abs=1e-4)
        assert found[f"motion_probe_accuracy[{agent}]"] == 1
        assert found[f"motion_within_over_between[{agent}]"] < 0.01
    assert found["agent_iou"] == 1
    assert found["motion_shift_error"] == pytest.approx(0, abs=1e-4)


@pytest.mark.slow
def test_an_agent_taken_for_the_other_is_wrong_for_each_and_right_together(two: Dataset) -> None:
    found = figures(TakesOneForTheOther(), two)
    for agent in (0, 1):
        assert found[f"agent_iou[{agent}]"] == 0
        assert found[f"motion_shift_error[{agent}]"] > 15
        assert found[f"motion_probe_accuracy[{agent}]"] < 0.5
        assert found[f"motion_within_over_between[{agent}]"] > 5
    assert found["agent_iou"] == 1


@pytest.mark.slow
def test_a_single_map_stands_against_every_agent(two: Dataset) -> None:
    found = figures(SeesOne(), two)
    assert (found["agent_iou[0]"], found["agent_iou[1]"]) == (1, 0)
    assert found["agent_iou"] == pytest.approx(0.5, abs=0.01)  # one of two squares
    assert found["motion_shift_error[0]"] == pytest.approx(0, abs=1e-4)
    assert found["motion_shift_error"] == pytest.approx(found["motion_shift_error[1]"] / 2, rel=1e-3)
    assert found["motion_probe_accuracy[0]"] == 1
    assert found["motion_probe_accuracy[1]"] < 0.5


@pytest.mark.slow
def test_the_reference_moves_both_agents(two: Dataset) -> None:
    held = HeldOut(two, "test")
    batch = next(held.batches(10_000))
    colors = np.array([look.color for look in FACTS_OF_TWO.agents])
    shown = (batch.frames[:, 1, :, :, None] == colors).all(-1)
    for agent in (0, 1):
        np.testing.assert_array_equal(batch.agents[:, 0] == agent + 1, shown[..., agent])
    scores = score_model(SeesBoth(), two, metrics=("prediction",), settings=QUICK)
    moved = scores.reference["agent_moves"]["mse"].mean
    assert moved < scores.reference["copy_last"]["mse"].mean / 5


@pytest.mark.slow
def test_the_samples_hold_each_agents_values(two: Dataset, tmp_path: Path) -> None:
    scores = score_model(SeesOne(), two, metrics=("prediction",), settings=QUICK)
    write_samples(tmp_path / "samples.parquet", scores.samples)
    read = read_samples(tmp_path / "samples.parquet")
    mine = [row for row in read.to_pylist() if row["predictor"] == "model"]
    assert read.column("each_agent_iou").null_count == len(read) - len(mine)
    for row in mine:
        assert [4 * row["each_action"][0] + row["each_action"][1]] == [row["action"]]
        assert row["each_motion"] == row["motion"] * 2
    for name in ("agent_iou", "motion_shift_error", "motion_probe_accuracy"):
        for agent in (0, 1):
            mean = np.mean([row[f"each_{name}"][agent] for row in mine])
            assert scores.figures[f"{name}[{agent}]"].mean == pytest.approx(mean)


@pytest.mark.slow
def test_one_agent_keeps_its_figures_and_columns(grid: Dataset, tmp_path: Path) -> None:
    found = identify(_of_one(grid), HeldOut(grid, "test"), batch_size=16, device=torch.device("cpu"))
    assert found.each is None
    scores = score_model(_of_one(grid), grid, metrics=("prediction",), settings=QUICK)
    assert not [name for name in scores.figures if name.partition("[")[0] in EACH and "[" in name]
    write_samples(tmp_path / "samples.parquet", scores.samples)
    import pyarrow.parquet as pq

    assert not [name for name in pq.read_schema(tmp_path / "samples.parquet").names if name.startswith("each_")]


def _of_one(grid: Dataset) -> SeesOne:
    model = SeesOne()
    model.inputs = ModelInputs(height=128, width=128, actions=grid.spec.actions)
    return model


def test_the_figures_have_words() -> None:
    assert figure_words("agent_iou[1]") == "agent IoU, agent 1"
    assert figure_words("motion_within_over_between[0]") == "motion within/between, agent 0"


def test_the_papers_figures_are_of_one_agent() -> None:
    published = [PublishedResult(model="m", environment="grid_world", labels="one-shot", figures={}, source="a paper")]
    for actions, beside in ((FACTS.actions, published[0]), (JOINT_ACTIONS, None)):
        assert published_for("m", "grid_world", "one-shot", published, actions=actions) is beside
