"""Options that several commands share, and the names that options allow.

The names stand here because ``--help`` lists them, and asking for help loads neither torch nor a simulator.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dmotion_bench.api.settings import DEVICES
from dmotion_bench.cli.stdout import reserve_stdout

if TYPE_CHECKING:
    from dmotion_bench.scoring.settings import Metric

PLANNERS: Final = ("cem", "exhaustive", "gradient", "icem", "icem-graph", "icem-recall", "mppi", "random-shooting")
OBJECTIVES: Final = (
    "centres",
    "feature",
    "pixel",
    "steps-to-go",
    "tabletop",
    "tracked",
    "tracked-belief",
    "tracked-risk",
)
COLUMNS: Final = ("generic-risk", "generic-belief", "generic-wide", "generic", "paper", "task-knowledge")
REFERENCES: Final = ("idle", "random", "oracle", "scripted")
METRICS: Final[tuple[Metric, ...]] = ("prediction", "rollout", "gain", "control")
TABLES: Final = ("continuous", "control", "labels", "laom", "paper")


def listed(names: Iterable[str]) -> str:
    """The names of a choice as ``--help`` shows them, ``[a|b|c]``."""
    return f"[{'|'.join(names)}]"


AsJson = Annotated[bool, typer.Option("--json", callback=reserve_stdout, help="Print the result as one JSON object.")]
Device = Annotated[
    str,
    typer.Option(
        metavar=listed(DEVICES),
        help="Where to compute. auto takes a GPU if there is one; for a job of a cluster it asks for none.",
    ),
]
PlannerName = Annotated[
    str | None,
    typer.Option(
        metavar=listed(PLANNERS),
        help="How control searches for actions. cem is the paper's cross-entropy method, icem a newer variant of it, "
        "icem-graph searches for a way where no plan gains anything, icem-recall puts what was seen earlier in the "
        "task in the place of predictions, random-shooting draws sequences once. exhaustive tries every sequence of "
        "discrete actions; mppi and gradient are for continuous ones. A package of your own can add others. Default: "
        "cem.",
    ),
]
PlannerSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--planner-set",
        metavar="KEY=VALUE",
        help="Change a setting of the planner, such as horizon=10. Can be repeated.",
    ),
]
ObjectiveName = Annotated[
    str | None,
    typer.Option(
        "--objective",
        "--cost",
        metavar=listed(OBJECTIVES),
        help="What control minimises. centres is the paper's: the distance of the objects that a predicted frame shows "
        "from their places in the goal; tracked remembers hidden objects as well, tracked-risk also counts what may "
        "disappear, tracked-belief remembers and counts in predicted frames, too, where video shows that things stay "
        "away, tabletop follows objects through predicted frames and avoids falls. A package of your own can add "
        "others. Default: the one that the environment names, and feature for models that draw no frames.",
    ),
]
ObjectiveSettings = Annotated[
    list[str] | None,
    typer.Option(
        "--objective-set",
        metavar="KEY=VALUE",
        help="Change a setting of the objective that is named, such as lost_distance=1. Can be repeated.",
    ),
]
_BY_COLUMN: Final = (
    "Plan by a column of the table of control, whose planner and objective are frozen, in place of '--planner' and "
    "'--objective'; 'dmbench list columns' tells what each is."
)
PlanColumnName = Annotated[str | None, typer.Option(metavar=listed(COLUMNS), help=_BY_COLUMN)]
ColumnName = Annotated[
    str | None,
    typer.Option(
        metavar=listed(COLUMNS),
        help=f"{_BY_COLUMN} The tasks must be new to the run: name their data set with '--data'.",
    ),
]


def names(text: str | None) -> list[str] | None:
    """The names of a list with commas."""
    return None if text is None else [part.strip() for part in text.split(",") if part.strip()]


def numbers(option: str, text: str | None) -> list[int] | None:
    """The whole numbers of a list with commas.

    Raises:
        UsageError: One is none or is there twice, or none is there.
    """
    from dmotion_bench.errors import UsageError
    from dmotion_bench.wording import shown

    if (parts := names(text)) is None:
        return None
    wrong = next((part for part in parts if not (part.isascii() and part.isdecimal() and len(part) < 16)), None)
    if wrong is not None or not parts:
        raise UsageError(f"{option} holds {shown(wrong) if parts else 'nothing'}; give whole numbers, such as 0,1,2.")
    found = list(map(int, parts))
    if (twice := next((number for place, number in enumerate(found) if number in found[:place]), None)) is not None:
        raise UsageError(f"{option} names {twice} twice; name each number once.")
    return found
