"""Video without actions is scored by what a model reads off it: the figure that labelled video has, too."""

from __future__ import annotations

import dataclasses

import pytest
import torch
from known_model import Known
from torch import Tensor

from dmotion_bench.errors import DatasetError, LabelsNotAvailable, ModelContractBroken
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.storage.dataset import Dataset

from .test_identification import SeesGreen

QUICK = ScoreSettings(resamples=200)


@pytest.fixture
def nameless(grid: Dataset) -> Dataset:
    """The same video; nobody knows the actions, and whoever asks for labels fails."""
    dataset = Dataset.open(grid.path)
    dataset.spec = dataclasses.replace(grid.spec, actions=None)

    def refuse(episode: int) -> None:
        raise AssertionError("labels were opened")

    dataset.labels = dataset.states = refuse  # type: ignore[method-assign,assignment]
    return dataset


@pytest.mark.slow
def test_the_figure_is_the_one_that_labelled_video_has(grid: Dataset, nameless: Dataset) -> None:
    known = score_model(SeesGreen(), grid, metrics=("prediction",), settings=QUICK)
    scores = score_model(SeesGreen(), nameless, settings=QUICK, how=Execution(batch_size=7))

    assert scores.figures == {"mse_true_motion": known.figures["mse_true_motion"]}
    assert scores.reference == {"copy_last": {"mse_true_motion": known.reference["copy_last"]["mse"]}}


def test_a_model_of_actions_alone_is_refused_with_the_way_out(nameless: Dataset, copy_last: Known) -> None:
    with pytest.raises(LabelsNotAvailable, match=r"predicts by actions alone; .*--actions TOPIC"):
        score_model(copy_last, nameless, settings=QUICK)


def test_too_little_video_is_said(nameless: Dataset) -> None:
    nameless.split = lambda name: torch.zeros(0, dtype=torch.long).numpy()  # type: ignore[method-assign]
    with pytest.raises(DatasetError, match=r"has no triplet; .*--frames-per-episode"):
        score_model(SeesGreen(), nameless, settings=QUICK)


def test_frames_that_hold_no_numbers_are_refused_with_actions_and_without(grid: Dataset, nameless: Dataset) -> None:
    """As pixels they would be black."""

    class Diverged(SeesGreen):
        def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
            return torch.full_like(current, torch.nan)

    for dataset in (grid, nameless):
        with pytest.raises(ModelContractBroken, match="Diverged predicted frames that hold NaN or infinity"):
            score_model(Diverged(), dataset, metrics=("prediction",), settings=QUICK)
