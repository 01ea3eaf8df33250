"""What was seen in a task is known: a planner that recalls it is not led astray twice by the same wrong prediction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import ClassVar

import numpy as np
import pytest
import torch
from jaxtyping import Float, Int, UInt8
from planning.worlds import context, observed
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel, Losses, ModelInputs, TripletBatch
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.dynamics.base import pixels_of
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.dynamics.recalled import RecalledDynamics
from dmotion_bench.planning.experience import UNKNOWN, Experience
from dmotion_bench.planning.objectives.pixel import Pixel
from dmotion_bench.specs import EnvSpec, Supervision
from recorders.grid_things import FACTS

LEFT, RIGHT, STAY = range(3)
CELLS = 16
TRAP = 5
"""Where the model expects the goal one step to the left."""


def pictures(places: Sequence[int]) -> UInt8[np.ndarray, "b h w 3"]:
    """The cells up to a place are bright, so that nearer places look more alike."""
    bright = np.arange(CELLS) <= np.asarray(places)[:, None]
    return np.broadcast_to(np.where(bright, 255, 0)[:, None, :, None], (len(places), CELLS, CELLS, 3)).astype(np.uint8)


def after(place: int, action: int) -> int:
    return min(max(place + (-1, 1, 0)[action], 0), CELLS - 1)


class Wishful(ForwardModel[None]):
    """Knows the rules of the line but for one place and action, after which it expects the goal."""

    supervision: ClassVar[Supervision] = Supervision.ACTIONS
    paper: ClassVar[str] = "none"
    Config: ClassVar[type] = type(None)

    def __init__(self) -> None:
        super().__init__(None, ModelInputs(height=CELLS, width=CELLS, actions=Discrete.numbered(3)))

    def losses(self, batch: TripletBatch) -> Losses:
        raise NotImplementedError

    def predict(
        self, previous: Float[Tensor, "b c h w"], current: Float[Tensor, "b c h w"], action: Int[Tensor, " b"]
    ) -> Float[Tensor, "b c h w"]:
        places = (to_pixels(current)[:, 0, :, 0] > 0).sum(1).sub(1).tolist()
        reached = [
            CELLS - 1 if (place, move) == (TRAP, LEFT) else after(place, move)
            for place, move in zip(places, action.tolist(), strict=True)
        ]
        return to_model(torch.from_numpy(pictures(reached)))


def walked(name: str, starts: Sequence[int], steps: int) -> list[list[int]]:
    """The places of some tasks side by side, planned by a solver that is given all experience."""
    spec: EnvSpec = FACTS
    goals, here = pictures([CELLS - 1] * len(starts)), list(starts)
    solver, dynamics = make_solver(name, ["horizon=3", "samples=27", "elites=5"]), ModelDynamics(Wishful(), bf16=False)
    experience, evaluator = Experience(pictures(starts), 3), Pixel().reset(spec, pictures(starts), goals)
    ways, memory = [[place] for place in starts], None
    for step in range(steps):
        given = context(len(starts), seed=step, observation=observed(pictures(here), goals=goals), memory=memory)
        blocked = np.zeros((len(starts), 3), np.bool_)
        plan = solver.plan(
            dynamics, evaluator, type(given)(**{**vars(given), "blocked": blocked, "experience": experience})
        )
        here = [after(place, action) for place, action in zip(here, plan.action.tolist(), strict=True)]
        experience.took(plan.action, pictures(here))
        memory = plan.memory
        for way, place in zip(ways, here, strict=True):
            way.append(place)
    return ways


@pytest.mark.slow
def test_a_wrong_hope_is_followed_once_and_not_for_ever() -> None:
    (led_astray,), (way,) = (walked(name, [3], 20) for name in ("icem", "icem-recall"))
    assert led_astray.count(TRAP - 1) > 5
    assert led_astray[-1] != CELLS - 1
    assert way.count(TRAP - 1) == 2  # on the way to it, and once after it
    assert way[-1] == CELLS - 1


@pytest.mark.slow
def test_tasks_side_by_side_know_nothing_of_each_other() -> None:
    together = walked("icem-recall", [3, 8, 5], 8)
    assert together[0] == walked("icem-recall", [3], 8)[0]
    assert together[1] == [8, 9, 10, 11, 12, 13, 14, 15, 15]
    assert together[2][:3] == [5, 4, 5]  # the first task has been at 5, and this one has not


def test_experience_holds_what_followed_in_each_task() -> None:
    experience = Experience(pictures([3, 3]), 3)
    assert experience.here.tolist() == [0, 1]
    experience.took(np.array([RIGHT, UNKNOWN]), pictures([4, 3]))
    experience.took(np.array([LEFT, STAY]), pictures([3, 3]))
    assert experience.here.tolist() == [0, 1]
    assert len(experience.images) == 3
    assert experience.after.tolist() == [
        [UNKNOWN, 2, UNKNOWN],
        [UNKNOWN, UNKNOWN, 1],  # nothing changed, and that is known
        [0, UNKNOWN, UNKNOWN],
    ]


def test_of_continuous_actions_nothing_is_kept() -> None:
    experience = Experience(pictures([3]), 0)
    experience.took(np.array([[0.5, 0.5]]), pictures([4]))
    assert (len(experience.images), experience.after.shape) == (0, (0, 0))


def test_known_steps_are_what_was_seen_and_predictions_go_on_from_there() -> None:
    experience, model = Experience(pictures([TRAP, 3]), 3), ModelDynamics(Wishful(), bf16=False)
    experience.took(np.array([LEFT, STAY]), pictures([TRAP - 1, 3]))
    experience.took(np.array([RIGHT, STAY]), pictures([TRAP, 3]))
    dynamics = RecalledDynamics(model, experience)
    start = dynamics.start(observed(pictures([TRAP, 3]), previous=pictures([TRAP - 1, 3])))
    once = dynamics.branch(start, torch.tensor([0, 0, 1, 1]), torch.tensor([LEFT, RIGHT, STAY, RIGHT]))
    assert pixels_of(dynamics, once).numpy().tolist() == pictures([TRAP - 1, TRAP + 1, 3, 4]).tolist()
    before, _ = once[:2]
    assert to_pixels(before).numpy().tolist() == pictures([TRAP, TRAP, 3, 3]).tolist()  # x_{t-1} of each
    twice = dynamics.step(once, torch.tensor([LEFT, LEFT, RIGHT, RIGHT]))
    assert pixels_of(dynamics, twice).numpy().tolist() == pictures([TRAP - 2, TRAP, 4, 5]).tolist()
    assert torch.equal(dynamics.features(twice), model.features(twice[:-1]))
    assert torch.equal(dynamics.frames(twice), model.frames(twice[:-1]))
