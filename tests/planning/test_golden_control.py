"""Control does what it did when its version was named: the same actions, the same distances (``golden/control.py``)."""

from __future__ import annotations

from dataclasses import replace
from types import ModuleType

import numpy as np
import pytest
from golden.control import ADVICE, CASES, Case, configurations, small, stored, trace

from dmotion_bench import positions
from dmotion_bench.planning import approaching, configuration, covering, edges, exploring, following, table, tracking
from dmotion_bench.planning.configuration import constants
from dmotion_bench.planning.control import CONTROL_VERSION
from dmotion_bench.planning.cross_entropy import CrossEntropyPlanner
from recorders.robot_push import RobotPush

TUNED = (approaching, covering, edges, exploring, following, positions, table, tracking)
ROUNDING = 1e-6
SPEC = RobotPush().facts


def test_the_golden_file_is_of_this_version() -> None:
    assert stored()["control_version"] == CONTROL_VERSION, f"golden/control.json is of another version. {ADVICE}"
    assert set(stored()["traces"]) == {case.name for case in CASES}


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
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


def test_planners_and_costs_are_configured_as_in_the_version() -> None:
    assert configurations() == stored()["configurations"], f"a planner or a cost is configured otherwise. {ADVICE}"


def test_a_changed_constant_shows_in_the_trace(monkeypatch: pytest.MonkeyPatch) -> None:
    """The traces would notice: going to where a push can begin decides what the robot does."""
    golden, case = stored(), Case(environment="robot_push", who="model")
    monkeypatch.setattr(exploring, "NEARNESS", 0.0)
    assert trace(case, golden["tasks"]["robot_push"])["actions"] != golden["traces"][case.name]["actions"]


def test_a_changed_field_of_the_planner_shows_in_the_trace() -> None:
    golden, case = stored(), Case(environment="planar_push", who="model")
    planner = small("icem")
    assert isinstance(planner, CrossEntropyPlanner)
    changed = trace(case, golden["tasks"]["planar_push"], replace(planner, stickiness=0.0))
    assert changed["actions"] != golden["traces"][case.name]["actions"]


@pytest.mark.parametrize("module", TUNED, ids=lambda module: module.__name__.rpartition(".")[2])
def test_every_constant_that_was_tuned_is_in_a_report(module: ModuleType, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = {name for name, value in vars(module).items() if name.isupper() and isinstance(value, int | float)}
    imported = {name.partition(".")[2] for other in TUNED if other is not module for name in constants(other)}
    assert numbers - imported <= {name.partition(".")[2] for name in constants(module)}, "a constant is not Final"
    before = configurations()["costs"]["followed"]
    for name in constants(module):
        monkeypatch.setattr(module, name.partition(".")[2], -1)
        after = configuration.planning_configuration(small("cem"), "followed", SPEC, needs_pixels=True)["cost"]
        assert {one for one in after if after[one] != before[one]} == {name}
        monkeypatch.undo()


def test_the_cost_that_suits_is_named_and_the_oracle_has_its_own() -> None:
    def cost(name: str | None, needs_pixels: bool | None) -> str:
        said = configuration.planning_configuration(small("cem"), name, SPEC, needs_pixels=needs_pixels)
        return str(said["cost"]["name"])

    assert [cost(None, True), cost(None, False), cost(None, None)] == ["followed", "feature", "simulator"]
    assert [cost("position", True), cost("tracked", None)] == ["position", "tracked"]
