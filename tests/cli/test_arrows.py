"""The arrow keys of continuous actions move the agent the way they point, whatever the axes of its world."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from dmotion_bench.actions import Continuous
from dmotion_bench.cli.arrows import arrows_of, by_number, measured
from dmotion_bench.cli.play import moves
from dmotion_bench.errors import LabelsNotAvailable

GRIP = Continuous(names=("grip", "north", "east"), low=(0.0, -0.1, -0.2), high=(1.0, 0.1, 0.2), units=("", "m", "m"))
EFFECTS = {
    "east is right": [[0, 0], [0, -8], [9, 0]],
    "turned by a right angle": [[0, 0], [8, 0], [0, 9]],
    "turned and mirrored": [[0, 0], [-8, 0], [0, -9]],
    "seen askew": [[0.3, -0.2], [3, -8], [9, 4]],
}


def _episode(effect: Any, count: int = 40, noise: float = 0.5) -> tuple[np.ndarray, np.ndarray]:
    generator = np.random.default_rng(0)
    normal = generator.uniform(-1, 1, (count, GRIP.width))
    return GRIP.denormalise(normal), normal @ np.array(effect) + generator.normal(0, noise, (count, 2))


@pytest.mark.parametrize("effect", EFFECTS.values(), ids=EFFECTS)
def test_each_arrow_moves_the_agent_its_way(effect: Any) -> None:
    taken, moved = _episode(effect)
    moved[3] = np.nan  # where the agent was not seen
    arrows = measured(GRIP, taken, moved)
    assert arrows is not None
    assert sorted(arrows.values()) == ["down", "left", "right", "up"]
    ways = {"left": [-1, 0], "right": [1, 0], "up": [0, -1], "down": [0, 1]}  # a picture's rows go down
    for move in moves(GRIP, arrows):
        if move.arrow:
            shift = (GRIP.normalise(np.array(move.action)) - GRIP.normalise(np.zeros(3))) @ np.array(effect)
            assert shift @ ways[move.arrow] == np.abs(shift).max()


@pytest.mark.parametrize("steps", [0, 3])
def test_too_few_steps_tell_nothing(steps: int) -> None:
    taken, moved = _episode(EFFECTS["east is right"])
    assert measured(GRIP, taken[:steps], moved[:steps]) is None


def test_an_agent_that_hardly_moves_or_is_not_seen_tells_nothing() -> None:
    taken, moved = _episode(np.zeros((3, 2)), noise=0.01)
    assert measured(GRIP, taken, moved) is None
    assert measured(GRIP, taken, np.full_like(moved, np.nan)) is None


def test_labels_that_are_not_there_leave_the_order_of_the_numbers() -> None:
    def states(_episode: int) -> Any:
        raise LabelsNotAvailable("they are not there.")

    class Unlabelled(SimpleNamespace):
        def __len__(self) -> int:
            return 2

    assert arrows_of(Unlabelled(states=states), GRIP) == by_number(GRIP)
    assert by_number(GRIP) == {(0, False): "left", (0, True): "right", (1, False): "down", (1, True): "up"}
