"""Settings of a planner that do something with discrete or with continuous actions alone."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import pytest
from planning.sliding import ACTIONS
from planning.test_continuous import TWO, generators, plan_of
from planning.worlds import Walks, context

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.settings import only_for, require_use, with_settings
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.scoring.control import ControlScoring

FOUR = Discrete.numbered(4)
OTHER: dict[str, Any] = {"action_repeat_prob": 0.3, "initial_std": 0.9, "noise_exponent": 1.0, "momentum": 0.4}


def _plan(name: str, actions: Discrete | Continuous, settings: list[str]) -> np.ndarray:
    if isinstance(actions, Discrete):
        return Walks((3, 5)).plan(make_solver(name, settings), context(2)).candidates
    return plan_of(name, replace(TWO, generators=generators(0, 1)), settings=settings).candidates


@pytest.mark.parametrize("name", ["cem", "icem"])
@pytest.mark.parametrize("field", OTHER)
@pytest.mark.parametrize("actions", [FOUR, ACTIONS], ids=["discrete", "continuous"])
def test_what_is_refused_changes_no_plan_and_the_rest_does(
    name: str, field: str, actions: Discrete | Continuous
) -> None:
    setting = [f"{field}={OTHER[field]}"]
    same = bool((_plan(name, actions, setting) == _plan(name, actions, [])).all())
    scoring = ControlScoring(planner=name, planner_set=tuple(setting))
    if not same:
        scoring.require_use(actions)
        return
    kinds = ("continuous", "discrete") if isinstance(actions, Discrete) else ("discrete", "continuous")
    said = f"^--planner-set {field}={OTHER[field]} does something with {kinds[0]} actions alone, and these are "
    with pytest.raises(InvalidSetting, match=f"{said}{kinds[1]}; leave it out.$"):
        scoring.require_use(actions)


def test_every_such_setting_is_looked_at() -> None:
    for name in ("cem", "icem", "icem-recall"):
        solver: Any = make_solver(name)
        assert {field.name for field in fields(solver) if field.metadata} == {*OTHER}


def test_the_usual_value_a_column_and_what_is_not_known_are_not_refused() -> None:
    for setting in ("noise_exponent=2", "samples=20"):
        ControlScoring(planner="icem", planner_set=(setting,)).require_use(FOUR)
    ControlScoring(column="generic-wide").require_use(FOUR)  # which refuses such actions itself
    ControlScoring(planner_set=("momentum=0.5",)).require_use(None)


def test_an_objective_has_such_settings_too() -> None:
    scoring = ControlScoring(objective="tabletop", objective_set=("same_action=0.1",))
    scoring.require_use(ACTIONS)
    with pytest.raises(
        InvalidSetting, match=r"--objective-set same_action=0\.1 does something with continuous actions"
    ):
        scoring.require_use(FOUR)


def test_a_stored_report_with_one_is_read() -> None:
    scoring = ControlScoring(planner="icem", planner_set=("momentum=0.5",))
    assert ControlScoring.from_json(scoring.to_json()) == scoring


@dataclass(frozen=True, kw_only=True)
class Own:
    """A solver of somebody else's."""

    spread: float = only_for(0.5, Continuous)

    def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Any:
        raise AssertionError


def test_a_solver_of_one_s_own_says_so_as_well() -> None:
    (own,) = with_settings(["spread=2"], Own())
    require_use(own, ACTIONS, "--planner-set")
    with pytest.raises(InvalidSetting, match=r"spread=2\.0 does something with continuous actions alone"):
        require_use(own, FOUR, "--planner-set")
