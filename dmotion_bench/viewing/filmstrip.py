"""A control task as one picture: what was seen at a few moments, and what the model imagined of them.

A column is a moment, the last one is the goal. Below what was seen at a moment stands what the model makes of the
images some steps before and of the actions that were taken since.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from jaxtyping import Float
from PIL import Image

from dmotion_bench.learning.action_encoding import as_tensor
from dmotion_bench.learning.driving import predicted
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import was_taken
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.planning.objectives.base import Taken
from dmotion_bench.viewing.captions import Frame, captioned, picture_file
from dmotion_bench.wording import counted

SHARES: Final = (0.25, 0.5, 1.0)
"""Of the task's steps: when pictures are taken, besides the start."""


@dataclass(frozen=True, kw_only=True)
class Film:
    """What an agent saw of a task, with the image before each, from the start on.

    Attributes:
        previous, current: Before each action, and ``current`` after the last one, too.
    """

    previous: list[Frame] = field(default_factory=list)
    current: list[Frame] = field(default_factory=list)

    def take(self, seen: Observation) -> None:
        """Keep what is seen of the first task."""
        self.previous.append(seen.previous[0])
        self.current.append(seen.current[0])

    def imagined(self, model: ForwardModel[Any], actions: Taken, moment: int, ahead: int) -> Frame | None:
        """What a model imagines of a moment; None at the start.

        Args:
            model: Aligned, and one that draws frames.
            actions: All that were taken, in the units of the environment.
            moment: The number of actions before it.
            ahead: Steps between the images that the model is given and the moment, at most.
        """
        first = max(0, moment - ahead)
        since = actions[first:moment]
        since = since[was_taken(since)]
        if not len(since):
            return None
        previous, current = (torch.from_numpy(one[first]) for one in (self.previous, self.current))
        last: Frame = predicted(model, previous, current, as_tensor(since[None]))[0, -1].numpy()
        return last


def filmstrip(
    film: Film,
    goal: Frame,
    distance: Float[np.ndarray, " t"] | Sequence[float],
    actions: Taken,
    model: ForwardModel[Any] | None,
    *,
    ahead: int,
    title: str = "",
    lost: int = 0,
) -> Image.Image:
    """The picture.

    Args:
        film: Of the whole task.
        goal: The goal image.
        distance: Left at the start and after each action.
        actions: That were taken, in the units of the environment.
        model: That imagined; None leaves its row out.
        ahead: See ``Film.imagined``.
        title: Above everything, such as who worked on which task.
        lost: Number of objects that were lost by the end.
    """
    steps = len(distance) - 1
    moments = sorted({0, *(round(share * steps) for share in SHARES)})
    titles = ["start", *(f"after {moment}: {distance[moment]:.2f}" for moment in moments[1:]), "goal"]
    rows: list[tuple[str, list[Frame | None]]] = [("seen", [*(film.current[moment] for moment in moments), goal])]
    if model is not None:
        drawn = [film.imagined(model, actions, moment, ahead) for moment in moments]
        before = ("" if moments[1] >= ahead else "up to ") + counted(ahead, "step")
        rows.append((f"imagined from the images {before} before", [*drawn, None]))
    below = "the numbers are the distance left: 1 at the start, 0 at the goal"
    if lost:
        below += f"; each lost object adds 1, {lost} lost"
    return captioned(titles, rows, below, heading=title)


def write_filmstrip(picture: Image.Image, path: Path) -> None:
    """Write the picture as PNG.

    Raises:
        ViewerError: It cannot be written.
        StorageFull: There is no space left for it.
    """
    with picture_file(path) as file:
        picture.save(file, format="png")
