"""Which arrow key takes which number of a continuous action to which bound: the one that moves the agent that way."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Final

import numpy as np
from jaxtyping import Float

from dmotion_bench.actions import Continuous

if TYPE_CHECKING:
    from dmotion_bench.storage.readable import ReadableDataset

Arrows = dict[tuple[int, bool], str]
"""The key by the place of the number in the action, and whether it goes to the upper bound."""
EPISODES: Final = 5
"""So many episodes say how the agent moves."""
LEAST: Final = 0.5
"""[px] that a number at its bound must move the agent by."""


def arrows_of(dataset: ReadableDataset, actions: Continuous) -> Arrows:
    """The arrow keys of a data set, measured where its labels say where the agent is; else see ``by_number``."""
    from dmotion_bench.errors import LabelsNotAvailable

    try:
        states = [dataset.states(episode) for episode in range(min(EPISODES, len(dataset)))]
    except LabelsNotAvailable:
        return by_number(actions)
    taken = np.concatenate([one.actions for one in states])
    moved = np.concatenate([np.diff(one.agent.pixel[:, 0], axis=0) for one in states])
    return measured(actions, taken, moved) or by_number(actions)


def by_number(actions: Continuous) -> Arrows:
    """The first number for left and right, the second for down and up."""
    known: Arrows = {(0, False): "left", (0, True): "right", (1, False): "down", (1, True): "up"}
    return {key: arrow for key, arrow in known.items() if key[0] < actions.width}


def measured(actions: Continuous, taken: Float[np.ndarray, "n a"], moved: Float[np.ndarray, "n 2"]) -> Arrows | None:
    """The numbers that move the agent most along the picture's axes, by least squares.

    Args:
        actions: What they can be.
        taken: Actions, in their units.
        moved: By how much the agent moved in the picture after each, right and down [px]; NaN where that is not known.

    Returns:
        None if the actions do not tell.
    """
    known = np.isfinite(moved).all(axis=1)
    normal: Any = actions.normalise(taken[known])
    if known.sum() <= actions.width or np.linalg.matrix_rank(normal) < actions.width:
        return None
    effect = np.linalg.lstsq(normal, moved[known], rcond=None)[0]  # [px] of each number at its upper bound
    strength = np.abs(effect)
    arrows: Arrows = {}
    for axis in np.argsort(-strength.max(axis=0)).tolist():  # the clearer axis chooses first
        place = int(strength[:, axis].argmax())
        if strength[place, axis] < LEAST:
            return None
        backward, forward = (("left", "right"), ("up", "down"))[axis]
        rises = bool(effect[place, axis] > 0)
        arrows |= {(place, rises): forward, (place, not rises): backward}
        strength[place] = 0.0
    return arrows
