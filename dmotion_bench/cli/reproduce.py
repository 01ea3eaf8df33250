"""``dmbench reproduce``: a whole table of figures, from the recordings to its pages."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.api.settings import DEVICES, EXECUTORS, as_preset, require_one_of
from dmotion_bench.cli.cache import CacheFolder, use_cache
from dmotion_bench.cli.options import TABLES, AsJson, Device, listed, names, numbers
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.specs import Preset

if TYPE_CHECKING:
    from rich.progress import TaskID

    from dmotion_bench.api.reproducing import Reproduced
    from dmotion_bench.api.table_work import Watch
    from dmotion_bench.execution.job_progress import JobProgress
    from dmotion_bench.reproduction.cost import Cost, Line
    from dmotion_bench.reproduction.plan import Plan


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(reproduce)


def reproduce(
    table: Annotated[
        str,
        typer.Argument(
            metavar=listed(TABLES),
            help="The table. paper: tables I and II of the DMotion paper. control: control by frozen planners on test "
            "tasks (protocols dmbench-2 to dmbench-4), and prediction. continuous: the same with continuous actions, "
            "by a planner for them (dmbench-5) and the first of these. labels: figures by the number of labelled "
            "transitions. laom: what labels during the training do for latent actions beside distractors. A package of "
            "your own can add others.",
        ),
    ],
    preset: Annotated[
        Preset | None,
        typer.Option(
            parser=as_preset,
            metavar="[tiny|small|paper]",
            help="Size of recordings and trainings. tiny tries the table out, its figures mean nothing. Default: the "
            "table's.",
        ),
    ] = None,
    seeds: Annotated[
        str | None,
        typer.Option(metavar="SEED,SEED...", help="Seeds of the trainings. Default: the table's.", show_default=False),
    ] = None,
    models: Annotated[
        str | None, typer.Option(metavar="MODEL,MODEL...", help="Only these models.", show_default=False)
    ] = None,
    worlds: Annotated[
        str | None, typer.Option(metavar="WORLD,WORLD...", help="Only these worlds.", show_default=False)
    ] = None,
    columns: Annotated[
        str | None,
        typer.Option(
            metavar="COLUMN,COLUMN...",
            help="Only these figures, and the models and worlds that have them: prediction, a frozen planner, or as "
            "the table calls them.",
            show_default=False,
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Only say which jobs are left, and what they cost on this machine.")
    ] = False,
    speeds: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Compute the cost from this output of 'dmbench bench --json'. Default: measure the speeds, a few "
            "seconds for each model.",
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1,
            help="How many jobs run at a time. Default: as many as there are processors and memory for, also on a GPU, "
            "which they share.",
            show_default=False,
        ),
    ] = None,
    executor: Annotated[
        str,
        typer.Option(metavar=listed(EXECUTORS), help="Where the jobs run: on this machine, in Ray, or as Slurm jobs."),
    ] = "local",
    device: Device = "auto",
    cache: CacheFolder = None,
    as_json: AsJson = False,
) -> None:
    """Make a whole table: record, train, score, and build its pages. Run the same command again to go on."""
    from dmotion_bench.api.reproducing import make, plan_table, what_it_costs
    from dmotion_bench.api.side_by_side import Hands
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.errors import Interrupted

    require_one_of("device", device, DEVICES)
    require_one_of("executor", executor, EXECUTORS)
    use_cache(cache)
    plan = plan_table(
        table,
        preset=preset,
        seeds=numbers("--seeds", seeds),
        models=names(models),
        worlds=names(worlds),
        columns=names(columns),
        workspace=None,
    )
    hands = Hands(executor=executor, workers=workers, device=device)
    with progress_bar() as bar:
        task = bar.add_task("measuring speeds", total=None, status="")
        cost = what_it_costs(plan, hands, speeds, lambda what: bar.update(task, status=what))
    if not as_json:
        _show_cost(cost, plan)
    if dry_run:
        if as_json:
            print_json({"table": plan.name, "left": cost.to_json()})
        return
    try:
        with _watching() as watch:
            made = make(plan, cost, hands, watch)
    except KeyboardInterrupt:
        raise Interrupted(
            "interrupted; run the same command again to go on where it stopped, with '--dry-run' to see what is left."
        ) from None
    _tell(made, as_json)


@contextlib.contextmanager
def _watching() -> Iterator[Watch]:
    """One table of progress: a line for each part, and one for each job that runs."""
    from dmotion_bench.api.table_work import Watch
    from dmotion_bench.cli.progress import note, progress_bar

    parts: dict[str, TaskID] = {}  # the part that was counted last comes last: running jobs are its
    with progress_bar() as bar:

        def count(part: str, done: int, total: int) -> None:
            parts[part] = parts.pop(part) if part in parts else bar.add_task(part, total=total)
            bar.update(parts[part], completed=done, total=total)

        def jobs(running: Mapping[str, JobProgress]) -> None:
            if parts:
                bar.show_jobs(list(parts.values())[-1], running)

        yield Watch(count=count, jobs=jobs, note=note)


def _show_cost(cost: Cost, plan: Plan) -> None:
    from dmotion_bench.cli.tables import show_rows

    table = plan.table
    if not any(line.jobs for line in cost.lines):
        say(f"Nothing is left to do of the table {plan.name!r}.")
        return
    seeds = ", ".join(map(str, table.seeds))
    say(f"Left of the table {plan.name!r}, {table.title}; preset {table.preset.value}, seeds {seeds}:")
    gpu = any(line.gpu_hours for line in cost.lines)
    head = ("what", "of", "jobs", "amount", "core-hours", *(("GPU-hours",) if gpu else ()))
    rows = [_row(line, gpu) for line in cost.lines if line.jobs]
    total = ("in all", "", f"{sum(line.jobs for line in cost.lines):,}", "", _hours(cost.core_hours))
    show_rows(
        head, [*rows, (*total, *((_hours(cost.gpu_hours),) if gpu else ()))], right=frozenset(head[2:3] + head[4:])
    )
    for assumed in cost.assumptions:
        say(f"- {assumed}")
    for said in cost.unknown:
        say(f"- Not in the sum: {said}")


def _row(line: Line, gpu: bool) -> tuple[str, ...]:
    first = (line.kind, line.what, f"{line.jobs:,}", line.amount, _hours(line.core_hours))
    return (*first, _hours(line.gpu_hours)) if gpu else first


def _hours(hours: float | None) -> str:
    if hours is None:
        return "?"
    if 0 < hours < 0.01:
        return "< 0.01"
    return f"{hours:,.1f}" if hours >= 10 else f"{hours:.2f}"


def _tell(made: Reproduced, as_json: bool) -> None:
    from dmotion_bench.errors import RunError

    if as_json:
        print_json(made.to_json())
    else:
        say(f"{len(made.runs)} runs")
        for page in made.pages:
            say(f"{page}")
    if made.failures:
        told = "\n".join(f"  {what}: {why}" for what, why in made.failures.items())
        raise RunError(f"{len(made.failures)} parts failed; run the same command to try them again.\n{told}")
