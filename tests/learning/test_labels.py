"""The label budget hands out what was asked for, counts it, and opens nothing else."""

from __future__ import annotations

import numpy as np
import pytest

from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UsageError
from dmotion_bench.learning.labels import LabelBudget, LabelRequest
from dmotion_bench.learning.triplets import TripletSet
from dmotion_bench.specs import Supervision


@pytest.mark.parametrize("text", ["none", "one-shot", "5-shot", "10%", "100%", "2.5%"])
def test_a_request_prints_as_it_was_written(text: str) -> None:
    assert str(LabelRequest.parse(text)) == text


@pytest.mark.parametrize("text", ["", "0-shot", "0%", "101%", "many", "5 shot", "-1-shot"])
def test_other_requests_are_refused_with_what_is_allowed(text: str) -> None:
    with pytest.raises(InvalidSetting, match="one-shot"):
        LabelRequest.parse(text)


def test_a_supervised_model_says_which_budgets_it_takes() -> None:
    for asked in (None, "none", "one-shot"):
        with pytest.raises(UsageError, match="--labels 100% or --labels 10%"):
            LabelRequest.for_model("ed-cnn", Supervision.ACTIONS, asked)
    assert str(LabelRequest.for_model("ed-cnn", Supervision.ACTIONS, "10%")) == "10%"


def test_an_unsupervised_model_takes_one_demonstration_by_default_and_no_share() -> None:
    assert str(LabelRequest.for_model("dmotion", Supervision.NONE, None)) == "one-shot"
    with pytest.raises(UsageError, match="one-shot"):
        LabelRequest.for_model("dmotion", Supervision.NONE, "100%")


def test_demonstrations_are_true_unpushed_and_counted(dataset) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    budget = LabelBudget(dataset, LabelRequest.parse("3-shot"), seed=1)
    given = budget.demonstrations(triplets)
    assert given.actions.tolist() == [0, 0, 0, 1, 1, 1]
    assert budget.given == {"demonstrations": 6}
    everything = triplets.gather(np.arange(len(triplets)))
    for frames, action in zip(given.frames, given.actions, strict=True):
        (row,) = np.flatnonzero((everything == frames).all((1, 2, 3, 4)))
        episode, step = triplets.episode[row], triplets.step[row]
        assert dataset.actions[episode][step] == action
        assert not dataset.pushed[episode][step]


def test_another_draw_gives_other_demonstrations_and_the_same_draw_the_same(dataset) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    draws = [
        LabelBudget(dataset, LabelRequest.parse("one-shot"), seed=1).demonstrations(triplets, draw).frames
        for draw in (0, 0, 1, 2, 3)
    ]
    np.testing.assert_array_equal(draws[0], draws[1])
    assert any((draws[0] != other).any() for other in draws[2:])


def test_too_few_demonstrations_are_said(dataset) -> None:
    budget = LabelBudget(dataset, LabelRequest.parse("500-shot"), seed=1)
    with pytest.raises(LabelsNotAvailable, match="fewer than 500 demonstrations of left, right"):
        budget.demonstrations(TripletSet.of_split(dataset, "train"))


def test_shares_are_nested_true_and_counted(dataset) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    shares = {}
    for text in ("20%", "50%", "100%"):
        budget = LabelBudget(dataset, LabelRequest.parse(text), seed=1)
        paid = budget.actions(triplets, "training")
        shares[text] = set(paid.triplets.episode.tolist())
        assert budget.total == len(paid.triplets) == len(paid.actions)
        for episode, step, action in zip(paid.triplets.episode, paid.triplets.step, paid.actions, strict=True):
            assert dataset.actions[episode][step] == action
    assert shares["20%"] < shares["50%"] < shares["100%"] == set(range(7))


def test_only_the_episodes_that_were_paid_for_are_opened(dataset) -> None:
    budget = LabelBudget(dataset, LabelRequest.parse("20%"), seed=1)
    paid = budget.actions(TripletSet.of_split(dataset, "train"), "training")
    assert set(dataset.opened) == set(paid.triplets.episode.tolist())


def test_a_budget_gives_nothing_but_what_it_is_for(dataset) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    with pytest.raises(LabelsNotAvailable):
        LabelBudget(dataset, LabelRequest.parse("one-shot"), seed=0).actions(triplets, "training")
    with pytest.raises(LabelsNotAvailable):
        LabelBudget(dataset, LabelRequest.parse("none"), seed=0).demonstrations(triplets)
    assert dataset.opened == []
