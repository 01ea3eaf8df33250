"""The label budget hands out what was asked for, counts it, and opens nothing else."""

from __future__ import annotations

import dataclasses
import itertools

import numpy as np
import pytest

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UsageError
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.labels import LabelBudget
from dmotion_bench.learning.data.streamed import StreamedTriplets
from dmotion_bench.learning.data.triplets import TripletSet
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.messages import StateLabels

MOVES = Continuous(names=("dx", "dy"), low=(-1.0, -1.0), high=(1.0, 1.0), units=("m", "m"))


@pytest.mark.parametrize("text", ["none", "one-shot", "5-shot", "10%", "7%", "100%", "2.5%", "12.3456789%", "0.00005%"])
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


@pytest.mark.parametrize("supervision", [Supervision.NONE, Supervision.FEW])
def test_what_takes_demonstrations_has_one_by_default_and_any_number_or_share(supervision) -> None:
    assert str(LabelRequest.for_model("any", supervision, None)) == "one-shot"
    for asked, kept in (("1", "1"), ("2", "2"), ("5000", "5000"), ("2.5%", "2.5%"), ("all", "100%")):
        assert str(LabelRequest.for_model("any", supervision, asked)) == kept


def test_what_learns_from_few_labels_cannot_do_without() -> None:
    assert str(LabelRequest.for_model("dmotion", Supervision.NONE, "none")) == "none"
    with pytest.raises(UsageError, match="--labels one-shot"):
        LabelRequest.for_model("laom-labels", Supervision.FEW, "none")


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


@pytest.mark.parametrize("text", ["1", "64", "4096"])
def test_a_number_of_transitions_prints_as_it_was_written(text: str) -> None:
    assert str(LabelRequest.parse(text)) == text


def test_all_labels_are_a_share() -> None:
    assert LabelRequest.parse("all") == LabelRequest.parse("100%")


def test_more_transitions_than_there_are_is_all_of_them() -> None:
    asked = ("64", "65", "50%", "none", "99-shot")
    assert [str(LabelRequest.parse(text).of(64)) for text in asked] == ["64", "100%", "50%", "none", "99-shot"]


def test_continuous_actions_are_counted_by_transitions() -> None:
    for supervision in Supervision:
        with pytest.raises(UsageError, match=r"dx \(-1 to 1 m\).*--labels 64"):
            LabelRequest.for_model("any", supervision, "5-shot", MOVES)
    assert str(LabelRequest.for_model("dmotion", Supervision.NONE, None, MOVES)) == "64"
    with pytest.raises(UsageError, match=r"--labels 64 \(the default\)"):
        LabelRequest.for_model("laom-labels", Supervision.FEW, "none", MOVES)
    assert str(LabelRequest.for_model("ed-cnn", Supervision.ACTIONS, "all", MOVES)) == "100%"


class Moving:
    """The noise, with continuous actions that say which episode and step they are of."""

    def __init__(self, dataset) -> None:
        self._noise = dataset
        self.spec = dataclasses.replace(dataset.spec, actions=MOVES)

    def __getattr__(self, name: str) -> object:
        return getattr(self._noise, name)

    def __len__(self) -> int:
        return len(self._noise)

    def states(self, episode: int) -> StateLabels:
        labels = self._noise.states(episode)
        steps = np.arange(len(labels.actions))
        return dataclasses.replace(labels, actions=np.stack([steps / 100, 0 * steps + episode / 100], axis=1))


@pytest.mark.parametrize("continuous", [False, True])
def test_numbers_of_transitions_are_nested_true_and_counted(dataset, continuous) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    told = Moving(dataset) if continuous else dataset
    before: set[tuple[int, int]] = set()
    shown = np.zeros((0, 3, 1, 1, 3), np.uint8)
    for amount in (1, 2, 4, 8, 16):
        budget = LabelBudget(told, LabelRequest.parse(str(amount)), seed=1)
        paid = budget.actions(triplets, "training")
        held = budget.actions(TripletSet.of_split(dataset, "validation"), "validation")
        held_back = max(1, amount // 8) if amount > 1 else 0
        assert (len(paid.triplets), len(held.triplets)) == (amount - held_back, held_back)
        assert budget.total == amount
        places = set(zip(paid.triplets.episode.tolist(), paid.triplets.step.tolist(), strict=True))
        assert before < places or (amount == 2 and before == places)  # the second is held back
        before = places
        for episode, step, action in zip(paid.triplets.episode, paid.triplets.step, paid.actions, strict=True):
            assert np.array_equal(action, told.states(int(episode)).actions[step])
        given = budget.demonstrations(triplets)
        assert len(given.frames) == len(given.actions) == budget.given["demonstrations"] == amount
        if continuous:  # what is shown says where it comes from
            for step, episode in (given.actions * 100).round().astype(int).tolist():
                assert not dataset.pushed[episode][step]
        assert np.array_equal(given.frames[: len(shown), :, :1, :1], shown)
        shown = given.frames[:, :, :1, :1]


@pytest.mark.parametrize("amount", ["2", "6", "20"])
def test_numbers_and_shares_take_the_episodes_in_the_same_order(dataset, amount) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    counted, shared = (
        LabelBudget(dataset, LabelRequest.parse(text), seed=1).actions(triplets, "training").triplets
        for text in (amount, "50%")
    )
    places = [set(zip(one.episode.tolist(), one.step.tolist(), strict=True)) for one in (counted, shared)]
    assert places[0] <= places[1] or places[1] <= places[0]


def test_the_whole_curve_is_nested_and_all_is_all(dataset) -> None:
    triplets = TripletSet.of_split(dataset, "train")
    pushed = [dataset.pushed[e][s] for e, s in zip(triplets.episode, triplets.step, strict=True)]
    drawn: dict[str, list[int]] = {}
    for text in ("1", "2", "10%", "50%", "4096", "all"):
        budget = LabelBudget(dataset, LabelRequest.parse(text), seed=1)
        given = budget.demonstrations(triplets)
        drawn[text] = given.rows.tolist()
        assert budget.given == {"demonstrations": len(given.rows)}
        for row, action in zip(given.rows, given.actions, strict=True):
            assert dataset.actions[triplets.episode[row]][triplets.step[row]] == action
        unpushed = len(pushed) - sum(pushed)
        assert sum(pushed[row] for row in given.rows) == max(0, len(given.rows) - unpushed)  # these come last
    counts = {text: len(rows) for text, rows in drawn.items()}
    there = len(triplets)
    assert counts == {"1": 1, "2": 2, "10%": round(there / 10), "50%": round(there / 2), "4096": there, "all": there}
    ordered = sorted(drawn.values(), key=len)
    assert all(more[: len(fewer)] == fewer for fewer, more in itertools.pairwise(ordered))
    assert sorted(drawn["all"]) == list(range(there))


JOINT = Discrete.joint(("up", "down"), ("left", "right", "stay"))


@pytest.fixture
def joint(dataset):
    """The noise, with actions of two agents."""
    generator = np.random.default_rng(3)
    dataset.spec = dataclasses.replace(dataset.spec, actions=JOINT)
    dataset.actions = [generator.integers(0, 6, len(one)) for one in dataset.actions]
    return dataset


@pytest.mark.parametrize("text", ["one-shot-per-agent", "5-shot-per-agent"])
def test_shots_of_agents_print_as_they_were_written(text: str) -> None:
    assert str(LabelRequest.parse(text)) == text
    assert str(LabelRequest.for_model("dmotion", Supervision.NONE, text, JOINT)) == text


@pytest.mark.parametrize("shots", [1, 2, 3])
def test_each_agents_every_action_is_shown_and_no_transition_for_nothing(joint, shots: int) -> None:
    triplets = TripletSet.of_split(joint, "train")
    budget = LabelBudget(joint, LabelRequest.parse(f"{shots}-shot-per-agent"), seed=1)
    given = budget.demonstrations(triplets)
    parts = JOINT.divided(given.actions)
    for agent, names in enumerate(JOINT.parts):
        counts = np.bincount(parts[:, agent], minlength=len(names))
        assert (counts >= shots).all()
    assert 3 * shots <= len(given.actions) <= 5 * shots  # six joint actions once each would be six a shot
    assert budget.given == {"demonstrations": len(given.actions)}
    everything = triplets.gather(np.arange(len(triplets)))
    for frames, action in zip(given.frames, given.actions, strict=True):
        (row,) = np.flatnonzero((everything == frames).all((1, 2, 3, 4)))
        assert joint.actions[triplets.episode[row]][triplets.step[row]] == action


def test_what_an_agent_never_does_is_named(joint) -> None:
    joint.actions = [np.where(JOINT.divided(one)[:, 1] == 1, one - 1, one) for one in joint.actions]
    with pytest.raises(LabelsNotAvailable, match="no demonstration of right of agent 1; ask for a number of labels"):
        LabelBudget(joint, LabelRequest.parse("one-shot-per-agent"), seed=1).demonstrations(
            TripletSet.of_split(joint, "train")
        )


def test_shots_of_agents_are_for_joint_actions_and_models_of_video() -> None:
    with pytest.raises(UsageError, match="not a joint one; give it --labels 2-shot"):
        LabelRequest.for_model("dmotion", Supervision.NONE, "2-shot-per-agent", Discrete.numbered(4))
    with pytest.raises(UsageError, match="--labels 64"):
        LabelRequest.for_model("dmotion", Supervision.NONE, "2-shot-per-agent", MOVES)
    with pytest.raises(UsageError, match="learns from the actions"):
        LabelRequest.for_model("ed-cnn", Supervision.ACTIONS, "2-shot-per-agent", JOINT)


def test_agents_that_act_alike_are_shown_once_acting_otherwise(dataset) -> None:
    alike = Discrete.joint(("up", "down"), ("up", "down"))
    dataset.spec = dataclasses.replace(dataset.spec, actions=alike)
    dataset.actions = [np.full(len(one), 3 * (number % 2)) for number, one in enumerate(dataset.actions)]
    triplets, ask = TripletSet.of_split(dataset, "train"), LabelRequest.parse("one-shot-per-agent")
    for seed in range(5):
        given = LabelBudget(dataset, ask, seed=seed).demonstrations(triplets)
        assert given.actions.tolist() == [0, 3]  # there is nothing else

    dataset.actions[0][:] = 1  # up/down
    for seed in range(20):
        given = LabelBudget(dataset, ask, seed=seed).demonstrations(triplets)
        assert 1 in given.actions
        assert len(given.actions) <= 3


def test_a_share_is_read_back_as_itself() -> None:
    for percent in (*np.random.default_rng(0).random(200), 1e-7, 100 / 3, 29.0):
        asked = LabelRequest.parse(f"{percent:.25f}%")
        assert LabelRequest.parse(str(asked)) == asked


@pytest.mark.parametrize("text", ["all", "5000", "50%", "4097-shot", "5000-shot-per-agent"])
def test_too_many_demonstrations_of_streamed_data_are_refused_before_any_label_is_read(dataset, text) -> None:
    dataset.spec = dataclasses.replace(dataset.spec, actions=JOINT)
    triplets = StreamedTriplets(dataset, np.arange(2), np.array([6000, 4000]), window=8)
    with pytest.raises(LabelsNotAvailable, match="demonstrations of data that are streamed are too many for the mem"):
        LabelBudget(dataset, LabelRequest.parse(text), seed=0).demonstrations(triplets)
    assert dataset.opened == []
