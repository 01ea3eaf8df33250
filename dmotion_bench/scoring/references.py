"""References beside a model's figures: simple predictors that learn nothing, and published results.

``copy_last`` says that nothing changes. ``agent_moves`` says that the agent moves and nothing else does: it is the
current frame with every pixel that shows the agent before or after the step taken from the true next frame. Where
nothing but background lies under the agent's old place (Grid World, Planar Push) that is "the agent's patch drawn at
its new place, the pushes ignored", but for the border pixels that cells share in Grid World's version 2. Where the
agent hides things (Robot Push) what it uncovers is the truth.
What must be predicted in any environment lies between these two and zero.

Published figures come through entry points of the group ``dmbench.references``, each the ``"module:attribute"`` of an
iterable of ``PublishedResult``: the core knows no paper by name.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import UInt8

from dmotion_bench.actions import ActionSpec, kind_of
from dmotion_bench.entry_points import registered
from dmotion_bench.errors import DmbenchError
from dmotion_bench.scoring.transitions import TransitionBatch

PUBLISHED = "dmbench.references"


def copy_last(batch: TransitionBatch) -> UInt8[np.ndarray, "b h w 3"]:
    """Nothing changes."""
    return batch.frames[:, 1]


def agent_moves(batch: TransitionBatch) -> UInt8[np.ndarray, "b h w 3"]:
    """The agent moves, everything else stays."""
    agent = batch.agent[:, 0] | batch.agent[:, 1]
    return np.where(agent[..., None], batch.frames[:, 2], batch.frames[:, 1])


REFERENCES: Mapping[str, Callable[[TransitionBatch], UInt8[np.ndarray, "b h w 3"]]] = {
    "copy_last": copy_last,
    "agent_moves": agent_moves,
}


@dataclass(frozen=True, kw_only=True)
class PublishedFigure:
    """A number as it was printed; ``std`` is what stands behind its +-."""

    mean: float
    std: float | None = None

    def to_json(self) -> dict[str, Any]:
        """In the shape of a report's figures; what was not published is null."""
        return {"mean": self.mean, "std": self.std, "low": None, "high": None, "n": None}


@dataclass(frozen=True, kw_only=True)
class PublishedResult:
    """One model's figures in one environment, as published.

    Attributes:
        model, environment: Registry names.
        labels: The label budget in dmbench's words: ``"100%"``, ``"one-shot"``.
        figures: By the report's names.
        source: Who published them, where.
        note: What to bear in mind when comparing.
    """

    model: str
    environment: str
    labels: str
    figures: Mapping[str, PublishedFigure]
    source: str
    note: str = ""


def published_results() -> list[PublishedResult]:
    """The published results that installed packages provide."""
    results: list[PublishedResult] = []
    for point in sorted(registered(PUBLISHED), key=lambda point: point.name):
        try:
            results.extend(point.load())
        except (ImportError, AttributeError) as error:
            raise DmbenchError(
                f"the references {point.name!r} are registered as {point.value!r}, which cannot be imported: {error}."
            ) from error
    return results


def published_for(
    model: str,
    environment: str,
    labels: str,
    results: Iterable[PublishedResult] | None = None,
    *,
    actions: ActionSpec | None = None,
) -> PublishedResult | None:
    """The published result of a model in an environment; the papers' actions are discrete ones of one agent.

    The one with the same label budget, else the only one there is: the paper's one-shot row also stands beside our
    5-shot run (its own ``labels`` says so), but of rows for 10% and 100% none stands beside 50%.
    """
    if kind_of(actions) != "discrete":
        return None
    found = [
        result
        for result in (published_results() if results is None else results)
        if (result.model, result.environment) == (model, environment)
    ]
    same = [result for result in found if result.labels == labels]
    if same:
        return same[0]
    return found[0] if len(found) == 1 else None
