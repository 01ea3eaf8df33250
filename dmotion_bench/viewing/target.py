"""Finds what a path stands for: a data set, a run, a run's report, or a saved .rrd file."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from dmotion_bench.errors import RunMissing, UnknownName, UsageError
from dmotion_bench.scoring.report import REPORT_FILE, REPORT_FOLDER, TRANSFERS
from dmotion_bench.wording import command
from dmotion_bench.workspace import DATASET_MANIFEST, RUN_MANIFEST, Workspace


@dataclass(frozen=True)
class Target:
    """Something to show, and its kind.

    Attributes:
        kind: What it is; a report is shown with its run.
        path: The data set's, the run's or the file's.
        data: The data set of a report on another one than the run's own.
        report: The folder of a report on validation episodes, or of one of a column of control.
    """

    kind: Literal["data set", "run", "report", "recording"]
    path: Path
    data: Path | None = None
    report: Path | None = None


def find_target(given: Path, workspace: Workspace) -> Target:
    """Find what a path, or a name in the workspace, stands for.

    Raises:
        UnknownName: Nothing does; the closest name is said.
        RunMissing: It is the report of a run that has none.
        DmbenchError: It is a report on a data set that is not in the workspace.
        UsageError: Something else does.
    """
    if given.is_file() and given.suffix == ".rrd":
        return Target("recording", given)
    for folder in (given, workspace.runs / given, workspace.data / given):
        if (folder / DATASET_MANIFEST).is_file():
            return Target("data set", folder)
        if (folder / RUN_MANIFEST).is_file():
            return Target("run", folder)
        if (folder / REPORT_FILE).is_file() and (found := _report(folder.resolve(), workspace)) is not None:
            return found
    if given.name == REPORT_FOLDER:
        for run in (given.parent, workspace.runs / given.parent):
            if (run / RUN_MANIFEST).is_file():
                score = command("dmbench score", run.name)
                raise RunMissing(f"the run {str(run)!r} has no report; score it with {score}.")
    if given.exists():
        raise UsageError(
            f"{str(given)!r} cannot be shown: it is no .rrd file, no data set (with {DATASET_MANIFEST}), "
            f"no run (with {RUN_MANIFEST}) and no report (with {REPORT_FILE})."
        )
    known = [path.name for path in (*workspace.datasets(), *workspace.all_runs())]
    asked = given.parent.name if given.name == REPORT_FOLDER else given.name
    raise UnknownName("data set or run", asked, known, "dmbench list datasets' or 'dmbench list runs")


def _report(folder: Path, workspace: Workspace) -> Target | None:
    """The report in a folder of a run, ``RUN/report[/on/NAME][/SPLIT or COLUMN]`` (``scoring.report.report_place``)."""
    run = next((parent for parent in folder.parents if (parent / RUN_MANIFEST).is_file()), None)
    if run is None:
        return None
    data, (first, *below) = None, folder.relative_to(run).parts
    if below[:1] == [TRANSFERS] and len(below) > 1:
        data, below = workspace.dataset(below[1]), below[2:]
    if first != REPORT_FOLDER or len(below) > 1:
        return None
    return Target("report", run, data, folder if below else None)
