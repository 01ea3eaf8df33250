"""What the actions of an environment of Gymnasium are called: as it names them, else by their numbers."""

from __future__ import annotations

import enum
from typing import Any

import gymnasium
import pytest
import strange_worlds

from dmotion_bench.actions import Discrete
from dmotion_bench.registry import environment_class
from recorders.gymnasium_env.spaces import action_spec

strange_worlds.register()


def test_a_wrapper_names_the_actions_that_it_exchanges(monkeypatch: pytest.MonkeyPatch) -> None:
    def names(wrappers: str) -> object:
        return environment_class("gym:Strange/Named-v0")(wrappers=wrappers).facts.actions

    monkeypatch.setattr("recorders.gymnasium_env.environment.import_named", lambda *_: strange_worlds)
    assert names("") == Discrete(("left", "right"))
    assert names("strange_worlds:Mirrored") == Discrete(("right", "left"))


def test_actions_are_named_by_the_numbers_that_the_environment_gives_them() -> None:
    env: Any = strange_worlds.Slider(render_mode="rgb_array")
    env.action_space = gymnasium.spaces.Discrete(3, start=-1)
    assert action_spec("signed", gymnasium.wrappers.OrderEnforcing(env)) == Discrete(("-1", "0", "1"))
    env.actions = _of_numbers(LEFT=-1, STAY=0, RIGHT=1)
    assert action_spec("signed", gymnasium.wrappers.OrderEnforcing(env)) == Discrete(("LEFT", "STAY", "RIGHT"))


def test_names_are_not_those_of_the_actions_below_a_wrapper_with_others() -> None:
    env: Any = strange_worlds.Slider(render_mode="rgb_array")
    env.action_space = gymnasium.spaces.Discrete(3)
    env.actions = _of_numbers(LEFT=0, RIGHT=1, STAY=2)
    backwards = gymnasium.wrappers.TransformAction(env, lambda action: 2 - action, gymnasium.spaces.Discrete(2))
    assert action_spec("fewer", gymnasium.wrappers.OrderEnforcing(env)) == Discrete(("LEFT", "RIGHT", "STAY"))
    assert action_spec("fewer", gymnasium.wrappers.OrderEnforcing(backwards)) == Discrete(("0", "1"))


def _of_numbers(**members: int) -> Any:
    return enum.IntEnum("Actions", members)


def _of_text() -> Any:
    return enum.Enum("Actions", {"LEFT": "left", "RIGHT": "right"})


@pytest.mark.parametrize(
    "named",
    [
        {"get_action_meanings": lambda world: 1 / 0},
        {"get_action_meanings": ["LEFT", "RIGHT"]},
        {"get_action_meanings": lambda world: None},
        {"actions": _of_text()},
    ],
    ids=["raises", "is a list", "is nothing", "is of text"],
)
def test_names_of_actions_that_cannot_be_read_are_numbers(named: dict[str, Any]) -> None:
    env = type("Odd", (strange_worlds.Slider,), named)(render_mode="rgb_array")
    assert action_spec("odd", gymnasium.wrappers.OrderEnforcing(env)) == Discrete(("5", "6"))
