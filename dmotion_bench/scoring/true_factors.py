"""What is true of the held-out triplets: what a latent action should hold, and what it should not.

==================  ===========  ====================================================================================
factor              should hold  what it is
==================  ===========  ====================================================================================
``action``          yes          the action at x_t: its name, or the numbers of a continuous one, normalised
``agent_motion``    yes          how far each agent moves from x_t to x_{t+1}, in the world [m]
``agent_place``     no           where each agent is at x_t, in the world [m]
``camera``          no           how far the whole picture moves [px], and so on: what the environment tells
``background``                   (``Distracting`` in ``environment.py``)
``movers``
==================  ===========  ====================================================================================

Actions may depend on the place, and followers on actions. So of what a latent should not hold, the part counts that
the action does not tell (``beyond_actions``): a latent that is the action, and nothing else, scores zero there.

A data set whose environment does not tell a factor has no figure of it.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Final

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from dmotion_bench.actions import Continuous
from dmotion_bench.environment import Distracting
from dmotion_bench.errors import DmbenchError
from dmotion_bench.recording.rollout import make_environment
from dmotion_bench.registry import environment_class, is_environment
from dmotion_bench.scoring.probes import Factor, beyond_actions
from dmotion_bench.specs import delay_of
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.messages import StateLabels

WANTED: Final = ("action", "agent_motion")
UNWANTED: Final = ("agent_place", "camera", "background", "movers")
FACTORS: Final = WANTED + UNWANTED


def true_factors(
    dataset: Dataset, episode: Int[np.ndarray, " n"], step: Int[np.ndarray, " n"], action: Shaped[np.ndarray, "n *a"]
) -> dict[str, Factor]:
    """The factors of some triplets, by their names.

    Args:
        dataset: With labels.
        episode, step: Of the triplets' middle frames.
        action: Taken there.
    """
    spec = dataset.spec.actions
    taken = Factor(numbers=spec.normalise(action)) if isinstance(spec, Continuous) else Factor(names=action)
    numbers = _of_agents(dataset, episode, step)
    beyond = numbers.pop("agent_place")
    moving = {"agent_place": beyond} | _of_distractors(dataset, episode, step)
    return (
        {"action": taken}
        | {name: Factor(numbers=one) for name, one in numbers.items()}
        | {name: Factor(numbers=beyond_actions(one, action)) for name, one in moving.items() if name in UNWANTED}
    )


def true_places(
    dataset: Dataset, episode: Int[np.ndarray, " n"], step: Int[np.ndarray, " n"]
) -> dict[str, Float[np.ndarray, "n _k 3"]]:
    """Where the frames show each agent and each object, in the world [m]; NaN where nothing says so.

    Args:
        dataset: With labels.
        episode, step: Of the frames.
    """
    spec = dataset.spec
    found = {
        "agent_place": np.full((len(step), len(spec.agents), 3), np.nan),
        "object_place": np.full((len(step), len(spec.objects), 3), np.nan),
    }
    for rows, states, shown in _shown(dataset, episode, step[:, None]):
        found["agent_place"][rows] = states.agent.position[shown[:, 0]].reshape(len(shown), -1, 3)
        found["object_place"][rows] = states.objects.position[shown[:, 0]].reshape(len(shown), -1, 3)
    return found


def _shown(
    dataset: Dataset, episode: Int[np.ndarray, " n"], frames: Int[np.ndarray, "n k"]
) -> Iterator[tuple[Bool[np.ndarray, " n"], StateLabels, Int[np.ndarray, "r k"]]]:
    """The rows of each episode, its states, and the numbers of those that the rows' frames show: they may come late."""
    for one in np.unique(episode).tolist():
        rows, states = episode == one, dataset.states(one)
        yield rows, states, np.maximum(frames[rows] - delay_of(states.factors), 0)


def _of_agents(
    dataset: Dataset, episode: Int[np.ndarray, " n"], step: Int[np.ndarray, " n"]
) -> dict[str, Float[np.ndarray, "n d"]]:
    """What the frames show of the agents; NaN where nothing says where they are."""
    width = 3 * len(dataset.spec.agents)
    motion, place = np.full((len(step), width), np.nan), np.full((len(step), width), np.nan)
    for rows, states, shown in _shown(dataset, episode, step[:, None] + np.arange(2)):
        positions = states.agent.position[shown].reshape(len(shown), 2, width)
        place[rows], motion[rows] = positions[:, 0], positions[:, 1] - positions[:, 0]
    return {"agent_motion": motion, "agent_place": place}


def _of_distractors(
    dataset: Dataset, episode: Int[np.ndarray, " n"], step: Int[np.ndarray, " n"]
) -> dict[str, Float[np.ndarray, "n d"]]:
    """What the environment tells of what distracts; nothing where it tells nothing, or is not here."""
    recipe = dataset.recipe
    if not is_environment(recipe.environment):
        return {}
    try:
        kind = environment_class(recipe.environment)
        if not issubclass(kind, Distracting):
            return {}
        env = make_environment(kind, recipe)
    except DmbenchError:
        return {}
    found: dict[str, Float[np.ndarray, "n d"]] = {}
    try:
        assert isinstance(env, Distracting)
        for one in np.unique(episode).tolist():
            row = dataset.rows[one]
            motions: Mapping[str, Float[np.ndarray, "s d"]] = env.distracting_motions(
                row.seed, recipe.vary, row.frames - 1
            )
            rows = episode == one
            for name, motion in motions.items():
                column = found.setdefault(name, np.full((len(step), motion.shape[1]), np.nan))
                column[rows] = motion[step[rows]]
    finally:
        env.close()
    return found
