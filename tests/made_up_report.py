"""A report whose samples are made up, so that a test knows which episode is the worst."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.report import REPORT_FOLDER, Report, write_report
from dmotion_bench.scoring.samples import SampleRows


def figure(mean: float) -> dict[str, float | int | None]:
    return {"mean": mean, "std": 2.0, "low": mean - 1, "high": mean + 1, "n": 6}


def write_made_up(
    run: Run,
    mse: Mapping[int, Sequence[float]],
    column: str = "mse",
    *,
    planned: Mapping[str, Mapping[str, Any]] | None = None,
) -> Path:
    """A report of these errors by episode; rows of rollouts and references must not count.

    Args:
        run, mse, column: Whose errors, and what they are called.
        planned: Figures of planning of the model and of references.
    """
    rows = SampleRows("prediction", "model")
    for episode, values in mse.items():
        count = np.arange(len(values))
        rows.add(
            {
                "episode": np.full(len(values), episode),
                "step": count,
                "ahead": np.ones_like(count),
                column: np.array(values, np.float32),
            }
        )
    for metric, predictor in (("rollout", "model"), ("prediction", "copy_last")):
        other = SampleRows(metric, predictor)
        only = {"episode": np.array([7]), "step": np.array([0]), "ahead": np.array([1])}
        other.add({**only, "mse": np.array([1e6], np.float32)})
        rows._batches.extend(other._batches)
    mean = float(np.mean([value for values in mse.values() for value in values]))
    figures = {column: figure(mean), **{f"rollout_mse[{ahead}]": figure(10.0**ahead) for ahead in (1, 2, 3)}}
    report = Report(
        run=run.name,
        model="dmotion",
        arch="compact",
        preset="tiny",
        seed=run.spec.seed,
        labels={"asked": "one-shot", "total": 4},
        dataset={"name": "squares-tiny", "fingerprint": run.spec.fingerprint},
        weights="",
        settings={"split": "test", "protocol": "episode", "horizon": 3, "metrics": ["prediction", "rollout"]},
        training={"epochs": 1},
        versions={},
        figures=figures | (planned or {}).get("dmotion", {}),
        reference={
            "copy_last": {"mse": figure(99.0)},
            **{name: one for name, one in (planned or {}).items() if name != "dmotion"},
        },
    )
    folder = run.path / REPORT_FOLDER
    write_report(folder, report, rows.table())
    return folder
