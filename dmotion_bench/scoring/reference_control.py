"""Control by the references, which say what a model's figures mean, and the samples of both beside each other.

They are ``idle`` (1 by definition), ``random``, ``scripted`` (rules that read the simulator) and ``oracle`` (the same
solver with the true simulator as its model). They depend on the data set alone, so what they did is kept in its
``cache/``. The oracle takes much longer than any model: it stands beside a model once it has been scored for itself
(``dmbench score oracle``).
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa

from dmotion_bench.environment import HasScript
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.agents import REFERENCES
from dmotion_bench.planning.mpc import ControlResult
from dmotion_bench.planning.tasks import Problem, load_problems, task_environment
from dmotion_bench.scoring.control import Advance, ControlScoring, control_samples, require_tasks, score_control
from dmotion_bench.scoring.kept_control import journal_of, kept_by_reference, share_of, shares_of
from dmotion_bench.scoring.prediction import MODEL, Execution
from dmotion_bench.scoring.samples import require_readable
from dmotion_bench.storage.lock import in_turn
from dmotion_bench.storage.readable import ReadableDataset

QUICK: Final = ("idle", "random", "scripted")
"""References that take seconds."""

THREADS: Final = 1
"""That a reference computes with, so that a group of tasks in a process of its own has the same results."""


def score_reference(
    name: str,
    dataset: ReadableDataset,
    scoring: ControlScoring | None = None,
    *,
    progress: Advance = lambda _: None,
    problems: Sequence[Problem] | None = None,
) -> ControlResult:
    """The results of a reference; they are kept in the data set's cache, also when the work is interrupted.

    It computes with one thread, so that a group of tasks in a process of its own has the same results. What such
    processes did is taken over, and gathered in one file.

    Args:
        name: Of the reference.
        dataset, scoring, progress, problems: As ``score_control`` takes them.

    Raises:
        UnknownName: There is no such reference.
        InvalidSetting: A setting does nothing with the environment's actions; else as ``score_control``.
    """
    scoring = scoring or ControlScoring()
    scoring.require_use(dataset.spec.actions)
    kept = kept_by_reference(name, dataset, scoring)
    with using_threads(THREADS):
        result = score_control(name, dataset, scoring, progress=progress, checkpoint=kept, problems=problems)
    if shares := shares_of(kept):
        journal_of(kept, name, dataset, scoring, None).write({}, None, last=True)
        for share in shares:
            share.unlink(missing_ok=True)
    return result


def score_share_of_reference(
    name: str,
    dataset: ReadableDataset,
    scoring: ControlScoring,
    tasks: Sequence[int],
    *,
    progress: Advance = lambda _: None,
) -> None:
    """Work on some tasks of a reference, and leave what was done where ``score_reference`` finds it.

    Args:
        name, dataset, scoring, progress: As ``score_reference`` takes them; errors are the same, too.
        tasks: Their numbers, a whole group. Another process that works on them is waited for.
    """
    scoring.require_use(dataset.spec.actions)
    require_tasks(dataset)
    if is_kept(name, dataset, scoring, tasks):
        return
    kept = kept_by_reference(name, dataset, scoring)
    share = share_of(kept, tasks[0])
    share.parent.mkdir(parents=True, exist_ok=True)
    with in_turn(share), using_threads(THREADS):
        score_control(name, dataset, scoring, progress=progress, checkpoint=share, begun=kept, numbers=tasks)


def is_kept(name: str, dataset: ReadableDataset, scoring: ControlScoring, tasks: Sequence[int]) -> bool:
    """Whether a reference has done these tasks already.

    Args:
        name, dataset, scoring: As ``score_reference`` takes them.
        tasks: Their numbers.
    """
    journal = journal_of(kept_by_reference(name, dataset, scoring), name, dataset, scoring, None)
    return all(journal.reached(number) >= scoring.steps for number in tasks)


def control_tables(
    model: ForwardModel[Any],
    dataset: ReadableDataset,
    scoring: ControlScoring,
    how: Execution,
    journal: Path | None,
    others: int = 0,
) -> list[pa.Table]:
    """The samples of a model's control and of the references beside it.

    Args:
        model, dataset, scoring: As ``score_control`` takes them.
        how: Device and progress.
        journal: The model's file to go on from.
        others: How many samples the report has besides.

    Raises:
        InvalidSetting: With these there would be more than can be read again; else as ``score_control``.
    """

    def advance(what: str) -> Advance:
        return lambda progress: how.progress(
            f"control by {what}" + ("" if np.isnan(progress.distance) else f", distance {progress.distance:.3f}"),
            progress.steps,
            progress.total,
        )

    require_tasks(dataset)
    problems = load_problems(dataset, scoring.tasks)
    references = known_references(dataset, scoring, problems)
    require_readable(others + (1 + len(references)) * len(problems) * (scoring.steps + 1), of_tasks=True)
    tables = [
        control_samples(name, score_reference(name, dataset, scoring, progress=advance(name), problems=problems))
        for name in references
    ]
    told = advance("the model")
    result = score_control(
        model, dataset, scoring, device=how.device, progress=told, checkpoint=journal, problems=problems
    )
    return [*tables, control_samples(MODEL, result)]


def known_references(dataset: ReadableDataset, scoring: ControlScoring, problems: Sequence[Problem]) -> tuple[str, ...]:
    """The references that can be shown beside a model without delay: quick ones, and ones scored before.

    Args:
        dataset, scoring: As ``score_control`` takes them.
        problems: The tasks that the model works on.
    """

    numbers = [problem.number for problem in problems]
    (env := task_environment(dataset.recipe)).close()
    possible = [name for name in REFERENCES if name != "scripted" or isinstance(env, HasScript)]
    return tuple(name for name in possible if name in QUICK or is_kept(name, dataset, scoring, numbers))
