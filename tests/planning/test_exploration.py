"""Of plans that come to the same, those that lead to something new are better, as long as there is something to do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from planning.boxes import AT, FIRST, SETTINGS, SPEC, picture

from dmotion_bench.actions import Continuous
from dmotion_bench.planning.objectives.tabletop.exploration import Exploration, History, misplaced
from dmotion_bench.planning.objectives.tabletop.followed import FollowedObjects
from dmotion_bench.planning.objectives.tabletop.occlusion import OcclusionModel
from dmotion_bench.planning.objectives.tracking import Tracker

GOAL = (44, 30)
LEFT, RIGHT = torch.tensor([0]), torch.tensor([1])
HERE, THERE, FARTHER = (picture(curtain=slice(at, at + 4)) for at in (0, 30, 36))
LEAST = (SETTINGS.least_gain * SPEC.width) ** 2


def walked(*steps: tuple[torch.Tensor, torch.Tensor]) -> History:
    history = History.first(HERE, SETTINGS.history_side_px, SPEC.actions)
    for action, frame in steps:
        history = history.after(action, frame)
    return history


def exploration(history: History, goal: tuple[int, int] = GOAL) -> Exploration:
    known, wanted = Tracker(SPEC, SETTINGS).meet(picture(), picture(red=goal))
    return Exploration(
        SETTINGS, history, known, misplaced=misplaced(SETTINGS, known, wanted, known.seen, SPEC.width), spec=SPEC
    )


def test_what_was_seen_is_not_new_and_what_is_near_a_misplaced_object_is_newer() -> None:
    explored = exploration(walked((RIGHT, THERE)))
    far = picture(curtain=slice(60, 64))
    news = [explored.bonus(frame, FIRST).item() for frame in (HERE, THERE, far, FARTHER)]
    assert news[:2] == [0, 0]
    assert 0 < news[2] < news[3] <= SETTINGS.novelty_bonus


def test_where_everything_is_in_its_place_the_agent_goes_back() -> None:
    settled = exploration(walked((RIGHT, THERE)), goal=(AT[0] + 1, AT[1]))
    assert settled.bonus(FARTHER, FIRST).item() == 0
    assert settled.penalty(HERE, FIRST, LEFT).item() == settled.penalty(THERE, FIRST, RIGHT).item() == 0
    assert 0 < settled.penalty(FARTHER, FIRST, RIGHT).item() < 1
    long_ago = exploration(walked((RIGHT, THERE), (RIGHT, FARTHER)), goal=(AT[0] + 1, AT[1]))
    assert long_ago.penalty(HERE, FIRST, LEFT).item() > long_ago.penalty(THERE, FIRST, LEFT).item()


def test_what_is_hidden_is_sought_and_what_has_fallen_is_not() -> None:
    tracker, fresh = Tracker(SPEC, SETTINGS), picture(curtain=slice(28, 48))
    start, wanted = tracker.meet(picture(), picture(red=GOAL))
    news = []
    for gone in (picture(red=None, curtain=slice(14, 27)), picture(red=None)):
        known = tracker.update(start, gone)
        off = misplaced(SETTINGS, known, wanted, OcclusionModel(SETTINGS, tracker, gone, known).standing, SPEC.width)
        history = History.first(picture(), SETTINGS.history_side_px, SPEC.actions).after(RIGHT, gone)
        news.append(Exploration(SETTINGS, history, known, misplaced=off, spec=SPEC).bonus(fresh, FIRST).item())
    hidden, fallen = news
    assert hidden > fallen == 0


def tried(history: History) -> list[float]:
    """How often left and right were tried where everything looks as it does now."""
    counts: list[float] = exploration(history).tried(FIRST.repeat(2), torch.tensor([0, 1])).tolist()
    return counts


def test_continuous_actions_that_are_nearly_the_same_have_been_tried() -> None:
    spec = replace(SPEC, actions=Continuous(names=("dx", "dy"), low=(-2, -2), high=(2, 2), units=("m", "m")))
    history = History.first(HERE, SETTINGS.history_side_px, spec.actions)
    for action in ((0.5, 0.0), (0.5, 0.1), (-0.5, 0.0), (torch.nan, torch.nan)):
        history = history.after(torch.tensor([action]), HERE)
    known, wanted = Tracker(SPEC, SETTINGS).meet(picture(), picture(red=GOAL))
    off = misplaced(SETTINGS, known, wanted, known.seen, SPEC.width)
    explored = Exploration(SETTINGS, history, known, misplaced=off, spec=spec)
    asked = torch.tensor([(0.5, 0.05), (-0.4, 0.0), (0.0, 1.0)])
    assert explored.tried(FIRST.repeat(3), asked).tolist() == [2, 1, 0]


def test_an_action_is_penalised_where_it_was_tried() -> None:
    back = walked((RIGHT, THERE), (LEFT, HERE))
    assert tried(back) == [0, 1]
    more = back.after(RIGHT, THERE).after(LEFT, HERE).after(LEFT, HERE)
    assert tried(more) == [1, 2]
    assert tried(more.after(RIGHT, FARTHER)) == [0, 0]
    weary = [exploration(more).penalty(FARTHER, FIRST, action).item() for action in (LEFT, RIGHT)]
    assert weary == pytest.approx([SETTINGS.revisit_penalty, SETTINGS.revisit_penalty * 2])


def test_what_is_new_weighs_less_than_a_gain_and_what_was_tried_in_vain_more() -> None:
    assert 0 < SETTINGS.revisit_penalty < 1 > SETTINGS.novelty_bonus > 0
    known, wanted = Tracker(SPEC, SETTINGS).meet(picture(), picture(red=GOAL))
    weary = exploration(walked(*((RIGHT, HERE),) * 90))
    cost = FollowedObjects(SETTINGS, SPEC, known, wanted, exploration=weary)
    plain = FollowedObjects(SETTINGS, SPEC, known, wanted)

    def prices(action: torch.Tensor, *frames: torch.Tensor) -> list[float]:
        then, found = cost.begin(), []
        for frame in frames:
            price, then = cost.of_frames(frame, FIRST, action, then)
            action = LEFT  # the first one counts
            found.append(price.total.item())
        return found

    same = plain.of_frames(HERE, FIRST, LEFT, plain.begin())[0].total.item()
    fresh, tired = prices(LEFT, HERE, THERE), prices(RIGHT, HERE, THERE)
    assert same == fresh[0] == pytest.approx(24**2)
    assert fresh[1] < fresh[0] < tired[0]
    assert tired[0] - fresh[0] == pytest.approx(tired[1] - fresh[1], rel=1e-4)
    gain = prices(RIGHT, picture(red=(22, 30), curtain=slice(0, 4)))[0]
    assert gain == pytest.approx(22**2 + LEAST * SETTINGS.revisit_penalty * 90, abs=LEAST * SETTINGS.novelty_bonus)
    assert gain > fresh[0]
    assert prices(LEFT, picture(red=(22, 30), curtain=slice(0, 4)))[0] < min(fresh)


def test_tasks_do_not_know_of_each_other_and_other_sizes_are_fine() -> None:
    both = History.first(torch.cat([HERE, THERE]), SETTINGS.history_side_px, SPEC.actions).after(
        torch.tensor([0, 1]), torch.cat([THERE, THERE])
    )
    known, wanted = Tracker(SPEC, SETTINGS).meet(picture().repeat(2, 1, 1, 1), picture(red=GOAL).repeat(2, 1, 1, 1))
    explored = Exploration(
        SETTINGS, both, known, misplaced=misplaced(SETTINGS, known, wanted, known.seen, SPEC.width), spec=SPEC
    )
    each = torch.tensor([0, 0, 1, 1])
    assert explored.tried(each, torch.tensor([0, 1, 0, 1])).tolist() == [0, 0, 0, 1]
    task = torch.tensor([0, 1, 1])
    found = explored.bonus(torch.cat([HERE, HERE, THERE]), task)
    assert found[0] == found[2] == 0 < found[1]
    assert explored.penalty(torch.cat([HERE] * 3), task, torch.tensor([1, 1, 0])).tolist() == pytest.approx(
        [0, SETTINGS.revisit_penalty, 0]
    )
    assert History.first(
        torch.from_numpy(np.zeros((3, 40, 56, 3), np.uint8)), SETTINGS.history_side_px, SPEC.actions
    ).images.shape == (3, 1, 768)
