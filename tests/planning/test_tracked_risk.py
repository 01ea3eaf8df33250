"""What fades in the first imagined frame may be lost; later fading is blur."""

from __future__ import annotations

import pytest
import torch
from planning.boxes import AT, FIRST, RED, SPEC, picture
from planning.worlds import PerfectGridModel

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.choices import make_objective
from dmotion_bench.planning.dynamics.base import State
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.objectives.base import CostState, StepCost
from dmotion_bench.planning.objectives.tracked_risk import TrackedRisk, TrackedRiskEvaluator

GOAL = (44, 30)
LOST = (0.5 * 64) ** 2
LEFT = 24**2
"""Of the red box: the square of its way to the goal."""


class Shown(ModelDynamics):
    """Dynamics whose states are the frames that they look like."""

    def __init__(self) -> None:
        super().__init__(PerfectGridModel())

    def pixels(self, state: State) -> torch.Tensor:
        return state[0]


def faded(rows: int) -> torch.Tensor:
    """The red box with so many of its 11 rows left."""
    frame = picture(red=None)
    frame[:, AT[1] - 5 : AT[1] - 5 + rows, AT[0] - 5 : AT[0] + 6] = torch.tensor(RED, dtype=torch.uint8)
    return frame


def evaluator(seen: torch.Tensor | None = None, settings: TrackedRisk | None = None) -> TrackedRiskEvaluator:
    """At work on a task whose goal is the red box elsewhere, after an image was seen."""
    found = (settings or TrackedRisk()).reset(SPEC, picture().numpy(), picture(red=GOAL).numpy())
    if seen is not None:
        found.observe(FIRST.numpy(), seen.numpy())
    return found


def imagined(
    of: TrackedRiskEvaluator, frame: torch.Tensor, carried: CostState | None = None
) -> tuple[StepCost, CostState]:
    """The cost of a frame, the first one if nothing is carried."""
    dynamics = Shown()
    return of.step(dynamics, (frame,), FIRST, FIRST, of.begin(dynamics) if carried is None else carried)


@pytest.mark.parametrize(
    ("rows", "likely"),
    [(11, 0.0), (8, 0.0), (7, 0.0), (5, (0.6 - 5 / 11) / 0.45), (3, (0.6 - 3 / 11) / 0.45), (0, 1.0)],
)
def test_the_less_is_left_in_the_first_imagined_frame_the_likelier_it_is_lost(rows: int, likely: float) -> None:
    cost, _ = imagined(evaluator(), faded(rows))
    # at its place, half of a box is believed to be all of it, hidden somewhere; of one that is gone nothing is believed
    assert cost.distance.item() == pytest.approx(LEFT if rows else LOST)
    assert cost.risk.item() == pytest.approx((LOST - cost.distance.item()) * likely, abs=1e-3)
    assert cost.total.item() == pytest.approx(cost.distance.item() + cost.risk.item())


def test_the_first_imagined_frame_decides_for_all_that_follow_it() -> None:
    judge = evaluator()
    _, safe = imagined(judge, picture())
    cost, _ = imagined(judge, faded(2), safe)
    assert not cost.risk.any()
    _, feared = imagined(judge, faded(2))
    cost, carried = imagined(judge, picture(), feared)
    assert cost.risk.item() == pytest.approx((LOST - LEFT) * (0.6 - 2 / 11) / 0.45)
    assert torch.equal(carried[0], feared[0])


def test_each_row_has_its_own_risk() -> None:
    judge, both = evaluator(), torch.zeros(2, dtype=torch.long)
    frames = torch.cat([picture(), faded(2)])
    start = tuple(part[both] for part in judge.begin(Shown()))
    cost, _ = judge.step(Shown(), (frames,), both, both, start)
    assert cost.risk[0] == 0 < cost.risk[1]


def test_where_something_hides_objects_what_fades_is_taken_for_hidden() -> None:
    risky = (LOST - LEFT) * (0.6 - 2 / 11) / 0.45
    half = picture(curtain=slice(14, 22))  # leaves three of the red box's eleven columns
    assert imagined(evaluator(picture()), faded(2))[0].risk.item() == pytest.approx(risky)
    judge = evaluator(half)
    judge.observe(FIRST.numpy(), picture().numpy())  # it is in sight again
    assert not imagined(judge, faded(2))[0].risk.any()
    for start, goal in ((half, picture(red=GOAL)), (picture(), picture(red=GOAL, curtain=slice(38, 46)))):
        judge = TrackedRisk().reset(SPEC, start.numpy(), goal.numpy())
        judge.observe(FIRST.numpy(), picture().numpy())
        assert not imagined(judge, faded(2))[0].risk.any()


def test_an_object_that_was_lost_has_hidden_nothing() -> None:
    judge = evaluator(picture(blue=None))
    assert imagined(judge, faded(2))[0].risk.item() == pytest.approx((LOST - LEFT) * (0.6 - 2 / 11) / 0.45)
    cost, _ = imagined(judge, picture(blue=None))
    assert not cost.risk.any()  # it cannot be lost again


def test_each_task_is_one_of_its_own() -> None:
    both = torch.arange(2)
    judge = TrackedRisk().reset(
        SPEC, picture().repeat(2, 1, 1, 1).numpy(), picture(red=GOAL).repeat(2, 1, 1, 1).numpy()
    )
    judge.observe(both.numpy(), torch.cat([picture(), picture(curtain=slice(14, 22))]).numpy())
    judge.observe(both.numpy(), picture().repeat(2, 1, 1, 1).numpy())
    cost, _ = judge.step(Shown(), (faded(2).repeat(2, 1, 1, 1),), both, both, judge.begin(Shown()))
    assert cost.risk[0] > 0 == cost.risk[1]


def test_an_object_that_is_farther_from_its_goal_than_a_lost_one_is_not_better_lost() -> None:
    judge = TrackedRisk(lost_distance=0.1).reset(SPEC, picture().numpy(), picture(red=GOAL).numpy())
    cost, _ = imagined(judge, faded(3))
    assert cost.distance.item() == pytest.approx(LEFT)
    assert cost.risk.item() == 0


def test_an_object_without_a_goal_costs_nothing() -> None:
    judge = TrackedRisk().reset(SPEC, picture(blue=None).numpy(), picture(red=GOAL, blue=None).numpy())
    judge.observe(FIRST.numpy(), picture().numpy())
    cost, _ = imagined(judge, picture(blue=None))
    assert cost.total.item() == pytest.approx(LEFT)


def test_its_settings() -> None:
    assert make_objective("tracked-risk", ["lost_below=0.2"]) == TrackedRisk(lost_below=0.2)
    with pytest.raises(InvalidSetting, match=r"lost_below is 0\.6 and safe_from 0\.6; the first must be less"):
        make_objective("tracked-risk", ["lost_below=0.6"])
    with pytest.raises(InvalidSetting, match="safe_from is inf"):  # its costs would be no numbers
        TrackedRisk(safe_from=float("inf"))
