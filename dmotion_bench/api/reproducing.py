"""A whole table of figures: record its worlds, train its models, score their runs, build its pages."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.scoring import compute_device
from dmotion_bench.api.settings import DEVICES, EXECUTORS, as_preset, require_one_of, whole
from dmotion_bench.api.side_by_side import Hands
from dmotion_bench.api.table_work import TableWork, Watch
from dmotion_bench.errors import UsageError
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.registry import table as table_named
from dmotion_bench.reproduction.cost import Cost, cost_of
from dmotion_bench.reproduction.plan import Plan, require_models
from dmotion_bench.reproduction.speeds import Speeds
from dmotion_bench.reproduction.table import Table
from dmotion_bench.specs import Preset
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, Workspace, as_path, in_workspace


@dataclass(frozen=True, kw_only=True)
class Reproduced:
    """What became of a table.

    Attributes:
        table: Its name.
        cost: What was left of it before the work began.
        pages: Its pages, those that were there already, too; empty after a dry run.
        runs: The folders of its runs.
        failures: Why a training, a scoring or a page failed, by what it was.
    """

    table: str
    cost: Cost
    pages: tuple[Path, ...] = ()
    runs: tuple[Path, ...] = ()
    failures: Mapping[str, str] = field(default_factory=dict)

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench reproduce --json`` prints."""
        return {
            "table": self.table,
            "left": self.cost.to_json(),
            "pages": list(map(str, self.pages)),
            "runs": list(map(str, self.runs)),
            "failures": dict(self.failures),
        }


@in_workspace
def reproduce(
    table: str | Table,
    *,
    preset: Preset | str | None = None,
    seeds: Sequence[int] | None = None,
    models: Sequence[str] | None = None,
    worlds: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    executor: str = "local",
    workers: int | None = None,
    device: str = "auto",
    speeds: AnyPath | None = None,
    dry_run: bool = False,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Reproduced:
    """Record, train, score and build the pages of a table. The same call goes on with one that was interrupted.

    What is done already is left as it is. Trainings compute with one thread each, so that the weights are the same for
    any number of workers.

    Args:
        table: A registered name (``"paper"``, ``"control"``, ``"continuous"``, ``"labels"``, ``"laom"``), or a table
            of your own.
        preset: Size of recordings and trainings; the table's by default.
        seeds, models, worlds, columns: A part of the table.
        executor: Where jobs run: ``"local"``, ``"ray"`` or ``"slurm"``.
        workers: Jobs at a time; by default as many as there are processors and memory for, also on a GPU, which they
            share. More than one need ``if __name__ == "__main__":`` in a script.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        speeds: A file that ``dmbench bench --json`` wrote; the cost is computed from it where it has the speeds.
        dry_run: Whether to say only what is left and what it costs.
        workspace: The folder with ``data/``, ``runs/`` and ``reports/``; the current one by default.
        progress: A function that is told how far each part is, or True for a bar.

    Raises:
        UnknownName, UsageError: A name or a value that is not allowed.
        RecipeMismatch: The folder of a data set holds another one.
        RunMismatch: The folder of a run holds one of other settings or other data.

    Example:
        >>> told = dm.reproduce("labels", preset="tiny", models=["lapo"], worlds=["planar_push"], dry_run=True)
        >>> told.cost.jobs("record"), told.cost.jobs("train")
        (1, 3)
    """
    require_one_of("executor", executor, EXECUTORS)
    part = {"models": models, "worlds": worlds, "columns": columns}
    plan = plan_table(table, preset=preset, seeds=seeds, **part, workspace=workspace)
    with telling(progress) as tell:

        def count(part: str, done: int, total: int) -> None:
            tell(JobProgress(what=part, done=done, total=total))

        hands = Hands(executor=executor, workers=whole("workers", workers, 1), device=device)
        cost = what_it_costs(plan, hands, speeds, lambda what: count(f"measuring {what}", 0, 1))
        if dry_run:
            return Reproduced(table=plan.name, cost=cost)
        return make(plan, cost, hands, Watch(count=count))


@in_workspace
def plan_table(
    table: str | Table,
    *,
    preset: Preset | str | None = None,
    seeds: Sequence[int] | None = None,
    models: Sequence[str] | None = None,
    worlds: Sequence[str] | None = None,
    columns: Sequence[str] | None = None,
    workspace: AnyPath | None = None,
) -> Plan:
    """The jobs of a table, or of a part of it.

    Raises:
        UnknownName, UsageError: A name that is not registered or not in the table, or nothing is left of it.
        RecipeMismatch: The folder of a data set holds another one.
        RunMismatch: The folder of a run holds one of other settings or other data.
    """
    if not isinstance(table, str | Table):
        raise UsageError(f"{shown(table)} is no table; give a table's name, such as 'paper', or a Table.")
    name, known = (table, table_named(table)) if isinstance(table, str) else ("own", table)
    size = None if preset is None else as_preset(preset)
    part = known.narrowed(preset=size, seeds=seeds, models=models, worlds=worlds, columns=columns)
    require_models(part)
    plan = Plan(part, name, Workspace.current(), whole=known)
    plan.require_own()
    return plan


def what_it_costs(
    plan: Plan, hands: Hands, speeds: AnyPath | None = None, announce: Callable[[str], None] = lambda _: None
) -> Cost:
    """What is left of a table, and what that costs on this machine, also where a cluster is to do it.

    Args:
        plan: The table.
        hands: Who is to do the jobs, and on which device.
        speeds: A file with speeds; those that it lacks are measured.
        announce: Told what is measured.

    Raises:
        UsageError: This machine is to do the jobs and lacks the device, or the file holds no speeds.
    """
    require_one_of("device", hands.device, DEVICES)
    device = compute_device("auto" if hands.on_cluster and hands.device == "cuda" else hands.device)
    stored = None if speeds is None else as_path("file of speeds", speeds)
    return cost_of(plan, Speeds(device=device, announce=announce, stored=stored))


def make(plan: Plan, cost: Cost, hands: Hands, watch: Watch | None = None) -> Reproduced:
    """Do what is left of a table.

    Args:
        plan: The table.
        cost: What was left of it; returned as it is.
        hands: Who does the jobs; of it ``count`` and ``watch`` are not used.
        watch: Who is told how far it is.
    """
    work = TableWork(plan, hands, watch or Watch())
    work.record()
    plan.require_own()  # runs may have learnt from data that were recorded anew
    work.train()
    for columns in plan.pages():
        for column in columns:
            work.score(column)
        work.build(columns)
    runs = dict.fromkeys(path for training in plan.trainings for path in training.runs(plan.workspace))
    return Reproduced(
        table=plan.name,
        cost=cost,
        pages=tuple(work.pages),
        runs=tuple(path for path in runs if path.is_dir()),
        failures=work.failures,
    )
