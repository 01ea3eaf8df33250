"""The paper's table beside our figures: ``paper.json``, as tables I and II were printed.

A figure is its mean and the number behind its +-: the standard deviation over frames in table I, probably half a
standard deviation over tasks in table II. The core finds ``RESULTS`` through the entry point ``dmbench.references``.
Table II is the distance "at the final time step", the 100th of L = 100.

How many labels a budget came to follows from section V-A: one demonstration of each of four actions, or the actions
of 18,900 (Grid World) and 214,290 (Robot Pushing) training triplets.
"""

from __future__ import annotations

import json
from importlib import resources
from typing import Any, Final

from dmotion_bench.scoring.references import PublishedFigure, PublishedResult

FINAL_STEP = 100


def _stored() -> dict[str, Any]:
    content: dict[str, Any] = json.loads(resources.files(__package__).joinpath("paper.json").read_text())
    return content


ADDRESS: Final = str(_stored()["address"])
"""Where the paper can be read."""


def label_count(environment: str, labels: str) -> int | None:
    """How many labels the paper's models were given; None for what the paper does not have."""
    count: int | None = _stored()["label_counts"].get(environment, {}).get(labels)
    return count


def address(source: str) -> str | None:
    """Where a published source can be read; None of what is not the paper."""
    return ADDRESS if source == _stored()["source"] else None


def read_results() -> tuple[PublishedResult, ...]:
    """Every row of the paper's tables, one for each model, label budget and environment."""
    stored = _stored()
    return tuple(
        PublishedResult(
            model=row["model"],
            environment=row["environment"],
            labels=row["labels"],
            figures={
                f"{name}[{FINAL_STEP}]" if name == "control_distance" else name: PublishedFigure(mean=mean, std=std)
                for name, (mean, std) in row["figures"].items()
            },
            source=stored["source"],
            note=stored["environments"][row["environment"]],
        )
        for row in stored["results"]
    )


RESULTS = read_results()
