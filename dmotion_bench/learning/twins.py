"""Trainings that differ in their labels alone: a model of video is trained once for all of its budgets.

What an unsupervised model learns does not depend on the budget (the tests compare the bits), only the alignment after
the training does. So the 5-shot run takes over the one-shot run's checkpoint and is aligned for itself.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path

from dmotion_bench.errors import RunError
from dmotion_bench.learning.run import Run
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.atomic import write_atomically


def take_over(run: Run) -> Run | None:
    """Give a run that has not begun the finished training of one beside it that differs in its labels alone.

    Returns:
        Whose training it was; None where there is none, or the run has one of its own.
    """
    if run.result is not None or run.last.exists() or model_class(run.spec.model).supervision is not Supervision.NONE:
        return None
    twin = next(filter(None, (_twin(run, beside) for beside in sorted(run.path.parent.glob("*/")))), None)
    if twin is None:
        return None
    run.path.mkdir(parents=True, exist_ok=True)
    for source, target in ((twin.metrics, run.metrics), (twin.best, run.best), (twin.last, run.last)):
        write_atomically(target, source.read_bytes())  # the checkpoint last: with it the run has begun
    run.manifest["trained_as"] = twin.name
    run.write()
    return twin


def _twin(run: Run, folder: Path) -> Run | None:
    try:
        other = Run.open(folder)
    except RunError:
        return None
    same = dataclasses.replace(other.spec, labels=run.spec.labels) == run.spec
    whole = other.result is not None and all(path.is_file() for path in (other.metrics, other.best, other.last))
    return other if same and whole else None
