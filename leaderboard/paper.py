"""The paper's table beside our figures: ``paper.json``, as tables I and II were printed.

A figure is its mean and the number behind its +-: the standard deviation over frames in table I, probably half a
standard deviation over tasks in table II. The core finds ``RESULTS`` through the entry point ``dmbench.references``.
Table II is the distance "at the final time step", the 100th of L = 100.
"""

from __future__ import annotations

import json
from importlib import resources

from dmotion_bench.scoring.references import PublishedFigure, PublishedResult

FINAL_STEP = 100


def read_results() -> tuple[PublishedResult, ...]:
    """Every row of the paper's tables, one for each model, label budget and environment."""
    stored = json.loads(resources.files("leaderboard").joinpath("paper.json").read_text())
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
