"""Options that several commands share, and the names that options allow.

The names stand here because ``--help`` lists them, and asking for help loads neither torch nor a simulator.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Annotated, Final

import typer

from dmotion_bench.errors import UnknownName

if TYPE_CHECKING:
    from dmotion_bench.scoring.score import Metric

PLANNERS: Final = ("cem", "icem", "exhaustive")
COSTS: Final = ("followed", "tracked", "position", "pixel", "feature")
REFERENCES: Final = ("idle", "random", "oracle", "scripted")
METRICS: Final[tuple[Metric, ...]] = ("prediction", "rollout", "control")
EXECUTORS: Final = ("local", "ray", "slurm")
DEVICES: Final = ("auto", "cpu", "cuda")


def listed(names: Iterable[str]) -> str:
    """The names of a choice as ``--help`` shows them, ``[a|b|c]``."""
    return f"[{'|'.join(names)}]"


def require_one_of(kind: str, given: str, allowed: Iterable[str]) -> None:
    """Check a name.

    Raises:
        UnknownName: It is not allowed; the error lists the names that are.
    """
    known = tuple(allowed)
    if given not in known:
        raise UnknownName(kind, given, known)


AsJson = Annotated[bool, typer.Option("--json", help="Print the result as one JSON object.")]
Device = Annotated[
    str,
    typer.Option(metavar=listed(DEVICES), help="Where to compute. auto takes a GPU if there is one."),
]
PlannerName = Annotated[
    str | None,
    typer.Option(
        metavar=listed(PLANNERS),
        help="How control searches for actions. cem is the paper's cross-entropy method, icem a newer variant of it, "
        "and exhaustive tries every sequence. Default: cem.",
    ),
]
CostName = Annotated[
    str | None,
    typer.Option(
        metavar=listed(COSTS),
        help="How control measures the distance of a predicted frame from the goal. position is the paper's; followed "
        "and tracked also handle hidden objects. Default: a cost that suits the model and the environment.",
    ),
]
