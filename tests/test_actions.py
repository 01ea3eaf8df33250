"""What an action can be: its description as JSON, its bounds, and the way to [-1, 1] and back."""

from __future__ import annotations

import json
import math
import re
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch
from hypothesis import example, given, settings
from hypothesis import strategies as st

from dmotion_bench.actions import (
    ActionSpec,
    Continuous,
    Discrete,
    actions_from_json,
    actions_to_json,
    require_discrete,
)
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.planning.dynamics.model import in_units

STEPS = Continuous(names=("dx", "turn"), low=(-0.04, 0.0), high=(0.04, math.pi), units=("m", "rad"))


@pytest.mark.parametrize("spec", [None, Discrete(("up", "down")), STEPS])
def test_json_leads_there_and_back(spec: ActionSpec | None) -> None:
    assert actions_from_json(json.loads(json.dumps(actions_to_json(spec)))) == spec


def test_discrete_actions_stand_in_json_as_their_names() -> None:
    assert actions_to_json(Discrete(("up", "down"))) == ["up", "down"]
    assert actions_to_json(None) == []


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        ("up", "neither names nor"),
        (["up", 3], "must be a text"),
        (["up", "up"], "same name"),
        ({"names": ["x"]}, "not the lists names, low, high, units"),
        ({"names": ["x"], "low": [0.0], "high": [1.0], "units": ["m"], "kind": []}, "not the lists"),
        ({"names": ["x"], "low": [0.0, 1.0], "high": [1.0], "units": ["m"]}, "give as many of each"),
        ({"names": ["x"], "low": [1.0], "high": [1.0], "units": ["m"]}, "must be below the upper"),
        ({"names": ["x"], "low": [float("nan")], "high": [1.0], "units": ["m"]}, "both finite"),
        ({"names": ["x"], "low": [0.0], "high": [float("inf")], "units": ["m"]}, "both finite"),
        ({"names": ["x"], "low": [-1.7e308], "high": [1.7e308], "units": ["m"]}, "both finite"),
        ({"names": ["x"], "low": [False], "high": [True], "units": ["m"]}, "bounds are numbers"),
        ({"names": ["x"], "low": [0], "high": [10**400], "units": ["m"]}, "bounds are numbers"),
        ({"names": ["x"], "low": [0], "high": [1], "units": [None]}, "a unit of the actions"),
        ({"names": [], "low": [], "high": [], "units": []}, "there can be 1 to 256"),
    ],
)
def test_what_is_no_specification_is_refused(wrong: Any, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        actions_from_json(wrong)


def test_a_forgotten_comma_does_not_make_names_of_letters() -> None:
    one: Any = "up"
    with pytest.raises(InvalidSetting, match=r"names of actions is 'up'; give a tuple, such as \('up',\)"):
        Discrete(one)
    whole: dict[str, Any] = {"names": ("dx",), "low": (0.0,), "high": (1.0,), "units": ("m",)}
    for field, value in (("names", "dx"), ("low", 0.0), ("high", 1.0), ("units", "m")):
        with pytest.raises(InvalidSetting, match=f"{field} of actions is {value!r}; give a tuple"):
            Continuous(**whole | {field: value})
    listed: Any = {name: list(one) for name, one in whole.items()}
    assert Continuous(**listed) == Continuous(**whole)
    named: Any = ["up", "down"]
    assert hash(Discrete(named)) == hash(Discrete(("up", "down")))


@given(st.lists(st.tuples(st.floats(-0.04, 0.04), st.floats(0, math.pi)), min_size=1))
@settings(deadline=None, derandomize=True)
def test_normalised_actions_are_within_one_and_come_back(rows: list[tuple[float, float]]) -> None:
    actions = np.asarray(rows)
    normal = STEPS.normalise(actions)
    assert STEPS.fault(actions) is None
    assert (np.abs(normal) <= 1 + 1e-12).all()
    np.testing.assert_allclose(STEPS.denormalise(normal), actions, atol=1e-15)


def test_the_bounds_become_minus_one_and_one() -> None:
    np.testing.assert_allclose(STEPS.normalise(np.array([STEPS.low, STEPS.high])), [[-1, -1], [1, 1]], atol=1e-15)


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        ([[0.0, 1.0], [0.041, 1.0]], r"'dx' = 0.041 at step 1; it can be -0.04 to 0.04 m"),
        ([[0.0, math.nan]], r"'turn' = nan at step 0"),
        ([[0.0, -math.inf]], r"'turn' = -inf at step 0"),
        ([[0.0, 1.0, 2.0]], r"not 2 floating-point numbers"),
        ([0.0, 1.0], r"not 2 floating-point numbers"),
    ],
)
def test_a_continuous_action_that_cannot_be_is_described(actions: Any, said: str) -> None:
    fault = STEPS.fault(np.asarray(actions))
    assert fault is not None
    assert re.search(said, fault)


def test_rounding_to_32_bits_stays_within_the_bounds() -> None:
    assert STEPS.fault(np.array([STEPS.low, STEPS.high], np.float32)) is None


@given(st.floats(-1e6, 1e6), st.floats(1e-6, 1e6))
@example(99.9, 0.8)
@settings(deadline=None, derandomize=True)
def test_bounds_computed_in_32_bits_stay_within_the_bounds(low: float, wide: float) -> None:
    spec = Continuous(names=("a",), low=(low,), high=(low + wide,), units=("",))
    planned = in_units(spec, torch.tensor([[-1.0], [1.0]]))
    assert planned.dtype == torch.float32
    for computed in (planned, planned.double()):
        assert spec.fault(computed.numpy()) is None
    assert spec.fault(spec.denormalise(np.array([[1.001 + 1e-6 * (abs(low) + wide) / wide]]))) is not None


@pytest.mark.parametrize("actions", [[0, 2], [-1], [0.0, 1.0], [[0, 1]]])
def test_a_discrete_action_that_cannot_be_is_described(actions: Any) -> None:
    assert Discrete(("up", "down")).fault(np.asarray(actions))
    assert Discrete(("up", "down")).fault(np.array([1, 0, 1])) is None


def test_gymnasium_has_a_space_for_each() -> None:
    assert Discrete(("up", "down")).space() == gymnasium.spaces.Discrete(2)
    box = STEPS.space()
    assert isinstance(box, gymnasium.spaces.Box)
    assert box.contains(np.array(STEPS.high))
    assert not box.contains(np.array(STEPS.high) + 1e-9)


def test_what_works_for_discrete_actions_alone_says_so() -> None:
    assert require_discrete(Discrete(("a",)), "planning") == Discrete(("a",))
    with pytest.raises(InvalidSetting, match=r"planning needs discrete actions, .* dx \(-0.04 to 0.04 m\), turn"):
        require_discrete(STEPS, "planning")
    with pytest.raises(InvalidSetting, match="are not known"):
        require_discrete(None, "planning")


def test_actions_fit_a_model_by_their_number_or_their_bounds() -> None:
    assert Discrete(("a", "b")).fits(Discrete.numbered(2))
    assert not Discrete(("a", "b")).fits(Discrete.numbered(3))
    assert not Discrete(("a", "b")).fits(STEPS)
    assert not STEPS.fits(Discrete(("a", "b")))
    assert not STEPS.fits(None)
    renamed = Continuous(names=("x", "y"), low=STEPS.low, high=STEPS.high, units=("", ""))
    assert STEPS.fits(renamed)
    assert not STEPS.fits(Continuous(names=("x", "y"), low=(-0.05, 0.0), high=STEPS.high, units=("", "")))


def test_a_joint_action_is_every_combination_of_its_parts() -> None:
    joint = Discrete.joint(("up", "down"), ("left", "right", "stay"))
    assert joint.names == ("up/left", "up/right", "up/stay", "down/left", "down/right", "down/stay")
    assert joint.parts == (("up", "down"), ("left", "right", "stay"))
    assert actions_from_json(json.loads(json.dumps(actions_to_json(joint)))).parts == joint.parts  # type: ignore[union-attr]
    divided = joint.divided(np.arange(6))
    for number, (first, second) in enumerate(divided.tolist()):
        assert joint.names[number] == f"{joint.parts[0][first]}/{joint.parts[1][second]}"


@pytest.mark.parametrize(
    "names",
    [
        ("up", "down"),
        ("a/0", "a/1"),  # one of the parts has no choice: a name that happens to hold a slash
        ("up/left", "up/right", "down/left"),  # not every combination
        ("up/left", "down/left", "up/right", "down/right"),  # in another order
        ("up/left", "up/right", "down", "down/right"),
    ],
)
def test_other_names_are_of_one_agent(names: tuple[str, ...]) -> None:
    assert Discrete(names).parts == (names,)
    assert Discrete(names).divided(np.arange(len(names))).tolist() == [[number] for number in range(len(names))]


def test_parts_that_could_not_be_told_apart_are_refused() -> None:
    with pytest.raises(InvalidSetting, match="its name must hold no '/'"):
        Discrete.joint(("a/b", "c"), ("d", "e"))
    with pytest.raises(InvalidSetting, match="at least 2 of each agent"):
        Discrete.joint(("a", "b"), ("c",))
