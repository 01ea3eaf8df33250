"""``dmbench train --all`` and ``--seeds``: many trainings, in turn or several at a time, and what became of each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from dmotion_bench.cli.stdout import print_json, say

if TYPE_CHECKING:
    from dmotion_bench.api.side_by_side import Hands
    from dmotion_bench.learning.runs.run import Run
    from dmotion_bench.learning.runs.start import TrainingRequest
    from dmotion_bench.learning.training.table import Outcome
    from dmotion_bench.storage.dataset import Dataset


def train_many(
    request: TrainingRequest,
    seeds: list[int] | None,
    data: Path | None,
    hands: Hands,
    train: Callable[[Run, Dataset], object],
    trackers: tuple[str, ...],
    loaders: int | None,
    as_json: bool,
) -> None:
    """Train the model of a request with each seed or, if it names none, every model with each of its label budgets.

    Args:
        request: What holds for all trainings.
        seeds: Of the trainings; that of the request if None.
        data: The data set, as it was named.
        hands: Who trains.
        train: Trains one run to its end with a progress bar.
        trackers, loaders: See ``train_every``.
        as_json: Whether to print one JSON object.

    Raises:
        RunError: One of them failed; at the end.
        UnknownName, InvalidSetting, UsageError: The request asks for what cannot be trained.
    """
    from dmotion_bench.api.side_by_side import seed_rows, table_rows, train_every
    from dmotion_bench.cli.jobs import jobs_bar
    from dmotion_bench.errors import RunError
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.workspace import Workspace

    workspace = Workspace.current()
    dataset = Dataset.open(workspace.dataset(data))
    wanted = seed_rows(request, dataset, seeds or []) if request.model else table_rows(dataset, seeds)
    with jobs_bar(f"training {dataset.name}") as (count, watch):
        outcomes = train_every(
            request,
            wanted,
            dataset,
            workspace,
            replace(hands, count=count, watch=watch),
            lambda run: train(run, dataset),
            trackers,
            warn=lambda told: say(told, err=True),
            loaders=loaders,
        )
        told = {outcome.row: _told(outcome, as_json) for outcome in outcomes}
    rows = [told[row] for row in wanted]
    if as_json:
        print_json({"rows": rows})
    failed = [_name(row) for row in rows if row["error"] and not row["busy"]]
    busy = [_name(row) for row in rows if row["busy"]]
    said = [f"{len(failed)} of {len(rows)} trainings failed: {', '.join(failed)}"] if failed else []
    said += [f"another process is at {len(busy)} of {len(rows)} trainings: {', '.join(busy)}"] if busy else []
    if said:
        when = "" if failed else " later"
        raise RunError(f"{'; '.join(said)}; run the same command{when} to try them again.")
    if not as_json:
        say("Score them with 'dmbench score --all'.")


def _told(outcome: Outcome, as_json: bool) -> dict[str, Any]:
    """What became of a row of the table; it is printed, unless all are at the end."""
    from dmotion_bench.cli.progress import duration, note

    row: dict[str, Any] = {"model": outcome.row.model, "budget": outcome.row.labels or _budget(outcome)}
    row |= {} if outcome.row.seed is None else {"seed": outcome.row.seed}
    row |= {"error": outcome.error, "busy": outcome.busy}
    if outcome.run is not None:
        row["run"] = str(outcome.run.path)
        result = outcome.run.result or {}
        row |= {name: result[name] for name in ("steps", "triplets_per_s", "seconds") if name in result}
        row["labels"] = result.get("labels_total")
    if as_json:
        if outcome.error is not None:
            note(f"{_name(row)} {row['budget']}: {outcome.error}")
    else:
        done = outcome.error or f"{duration(row['seconds'])}, {row['labels']} labels, {row['run']}"
        say(f"{_name(row):16s} {row['budget']:9s} {done}")
    return row


def _name(row: Mapping[str, Any]) -> str:
    """The model and, where several were asked for, the seed."""
    return f"{row['model']} s{row['seed']}" if "seed" in row else str(row["model"])


def _budget(outcome: Outcome) -> str:
    """The model's usual label budget, as its run says it."""
    return "" if outcome.run is None else outcome.run.spec.labels
