"""Training shared between label budgets: the part that needs no labels is trained once for all of them.

What an unsupervised model learns does not depend on the budget (the tests compare the bits), only the alignment after
the training does. So the 5-shot run takes over the one-shot run's last checkpoint and is aligned for itself, or
fine-tuned (``adaptation.py``). Of a world model the autoencoder comes first and sees video alone: another budget goes
on from where it ended.
"""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Final

from dmotion_bench.errors import InvalidSetting, RunError
from dmotion_bench.learning import checkpoint
from dmotion_bench.learning.run import Run
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.atomic import write_atomically

AFTERWARDS: Final = ("adaptation", "adaptation_steps", "adaptation_rate")
"""Of the training's settings those that concern only what comes after the part without labels."""


def training_of(run: Run) -> str | None:
    """The same text for all runs that can share a training; None where there is nothing to share.

    Raises:
        RunError, UnknownName: The run's model is not here.
    """
    if model_class(run.spec.model).supervision is not Supervision.NONE:
        return None
    shared = {name: value for name, value in dataclasses.asdict(run.spec).items() if name != "labels"}
    return json.dumps(shared | {"threads": run.threads}, sort_keys=True)


def take_over(run: Run) -> Run | None:
    """Start a new run from the part of another run that needed no labels; the two differ only in their labels.

    Returns:
        Whose training it was; None where there is none, or the run has one of its own.
    """
    if run.result is not None or run.last.exists():
        return None
    for folder in sorted(run.path.parent.glob("*/")):
        if (twin := _twin(run, folder)) is None:
            continue
        if files := _shared(twin):
            run.path.mkdir(parents=True, exist_ok=True)
            for name, source in files.items():
                write_atomically(run.path / name, source.read_bytes())
            run.manifest |= {"trained_as": twin.name, "code": twin.manifest.get("code", {})}
            if twin.conditions is not None:
                run.begin(twin.conditions)
            run.write()
            return twin
    return None


def _twin(run: Run, folder: Path) -> Run | None:
    try:
        other = Run.open(folder)
        if other.spec.model != run.spec.model or other.path == run.path:
            return None
        adapted = {name: getattr(other.spec.training_config, name) for name in AFTERWARDS}
        wanted = dataclasses.replace(run.spec, labels=other.spec.labels, training={**run.spec.training, **adapted})
        return None if other.differences(wanted, run.threads) else other
    except (RunError, InvalidSetting):
        return None


def _shared(run: Run) -> dict[str, Path]:
    """The files of a training that do not depend on its labels, by name; empty if there are none.

    The checkpoint comes last: with it the other run has begun. What is damaged is not taken over.
    """
    if model_class(run.spec.model).supervision is Supervision.NONE:
        best = run.unadapted if run.spec.training_config.adaptation == "finetuned" else run.best
        files = {run.metrics.name: run.metrics, run.best.name: best, run.last.name: run.last}
        files = files if run.result is not None else {}
    else:
        files = {run.metrics.name: run.metrics, run.watched.name: run.watched, run.last.name: run.watched}
    try:
        for path in {*files.values()} - {run.metrics}:
            checkpoint.load(path, required=None)
    except RunError:
        return {}
    return files if all(path.is_file() for path in files.values()) else {}
