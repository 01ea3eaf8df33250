"""Control does what it did when its version was named: the same actions, the same distances (``golden/control.py``)."""

from __future__ import annotations

from dataclasses import fields, replace

import numpy as np
import pytest
from golden.control import ADVICE, CASES, Case, configurations, small, stored, trace

from dmotion_bench.planning.choices import make_objective, planning_configuration
from dmotion_bench.planning.mpc import CONTROL_VERSION
from dmotion_bench.planning.objectives.tabletop.objective import Tabletop
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.scoring.earlier_planning import present_planning

ROUNDING = 1e-6


def test_the_golden_file_is_of_this_version() -> None:
    assert stored()["control_version"] == CONTROL_VERSION, f"golden/control.json is of another version. {ADVICE}"
    assert set(stored()["traces"]) == {case.name for case in CASES}


def _is_slow(case: Case) -> bool:
    return case.environment != "grid_world" and case.who in ("model", "oracle")


@pytest.mark.parametrize(
    "case", [pytest.param(case, id=case.name, marks=[pytest.mark.slow] * _is_slow(case)) for case in CASES]
)
def test_actions_and_distances_are_those_of_the_version(case: Case) -> None:
    golden = stored()
    wanted, found = golden["traces"][case.name], trace(case, golden["tasks"][case.environment])

    assert found["actions"] == wanted["actions"], f"{case.name}: other actions than those of the version. {ADVICE}"
    assert found["lost"] == wanted["lost"], f"{case.name}: other objects are lost than in the version. {ADVICE}"
    np.testing.assert_allclose(
        found["distance"],
        wanted["distance"],
        rtol=ROUNDING,
        atol=ROUNDING,
        err_msg=f"{case.name}: other distances than those of the version. {ADVICE}",
    )


def test_solvers_and_objectives_are_configured_as_in_the_version() -> None:
    assert configurations() == stored()["configurations"], f"a solver or an objective is configured otherwise. {ADVICE}"


def test_the_configurations_are_those_that_earlier_reports_hold() -> None:
    """The constants of the modules that planned before there were settings: same names in the report, same values."""
    earlier, now = stored()["earlier configurations"], configurations()
    for name, solver in earlier["planners"].items():
        for cost, objective in earlier["costs"].items():
            present = present_planning({"planner": solver, "cost": objective, "arithmetic": "float32"})
            assert present["solver"] == now["solvers"][name]
            assert (
                present["objective"]
                == now["objectives"][{"position": "centres", "followed": "tabletop"}.get(cost, cost)]
            )
            assert present["arithmetic"] == "float32"
    names = {"position": "centres", "followed": "tabletop"}
    assert {key: names.get(cost, cost) for key, cost in earlier["default costs"].items()} == now["default objectives"]


@pytest.mark.slow
def test_a_changed_setting_shows_in_the_trace() -> None:
    """The traces would notice: going to where a push can begin decides what the robot does."""
    golden, case = stored(), Case(environment="robot_push", who="model")
    changed = trace(case, golden["tasks"]["robot_push"], objective=Tabletop(push_pose_bonus=0.0))
    assert changed["actions"] != golden["traces"][case.name]["actions"]


@pytest.mark.slow
def test_a_changed_field_of_the_solver_shows_in_the_trace() -> None:
    golden, case = stored(), Case(environment="planar_push", who="model")
    solver = small("icem")
    assert isinstance(solver, CrossEntropy)
    changed = trace(case, golden["tasks"]["planar_push"], replace(solver, action_repeat_prob=0.0))
    assert changed["actions"] != golden["traces"][case.name]["actions"]


def test_every_setting_is_in_a_report() -> None:
    objective = make_objective("tabletop")
    said = planning_configuration("cem", small("cem"), "tabletop", objective)["objective"]
    assert {one.name for one in fields(TabletopSettings)} < set(said)
    for one in fields(TabletopSettings):
        changed = make_objective("tabletop", [f"{one.name}={'1,2' if one.name == 'passing_below' else '7'}"])
        after = planning_configuration("cem", small("cem"), "tabletop", changed)["objective"]
        assert {name for name in after if after[name] != said[name]} == {one.name}
