"""What control by a column is over: the tasks and steps that rows have to share to be compared."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final

from leaderboard.columns import control_steps
from leaderboard.entry import Entry, Frames

SUCCEEDED: Final = "control_success"
LOST: Final = "control_lost"


@dataclass(frozen=True, kw_only=True)
class Extent:
    """What a distance at the end is over.

    Attributes:
        steps: Of a task.
        tasks: How many of which episodes.
    """

    steps: int
    tasks: Frames

    @classmethod
    def of(cls, entry: Entry) -> Extent | None:
        """That of an entry's control; None where the entry does not tell it, or lacks what a cell shows."""
        steps = max(control_steps(entry.figures), default=0)
        figure = f"control_distance[{steps}]"
        tasks = entry.frames.get(figure)
        return None if tasks is None or not is_whole(entry.figures, figure) else cls(steps=steps, tasks=tasks)

    @property
    def figure(self) -> str:
        """The distance at the end, by its fixed name."""
        return f"control_distance[{self.steps}]"

    @property
    def size(self) -> tuple[int, int]:
        """How many tasks, and how many steps."""
        return int(sum(self.tasks.counts)), self.steps

    @property
    def words(self) -> str:
        """In words, with the first and the last episode, since as many tasks may be others."""
        tasks, steps = self.size
        first, last = self.tasks.episodes[0], self.tasks.episodes[-1]
        counted = f"{tasks:,} task{'s' * (tasks != 1)}", f"{steps:,} step{'s' * (steps != 1)}"
        return f"not compared: {counted[0]} of the episodes {first} to {last}, {counted[1]}"


def is_whole(figures: Mapping[str, Any], figure: str) -> bool:
    """Whether some figures hold all that a cell shows: a distance over some tasks, a share, and objects lost."""
    if not all(name in figures and figures[name]["mean"] is not None for name in (figure, SUCCEEDED, LOST)):
        return False
    return bool(figures[figure]["n"]) and 0 <= figures[SUCCEEDED]["mean"] <= 1
