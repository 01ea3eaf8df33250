"""The leaderboard: its page, the check of its entries, and the difference of two runs.

The core knows no leaderboard: what makes and checks entries comes through entry points of ``dmbench.leaderboard``.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, Final, Protocol, SupportsIndex

from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.settings import EXECUTORS, require_one_of, share, whole
from dmotion_bench.api.sharing import pull_entries
from dmotion_bench.errors import UsageError
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.executor import JobSize
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.execution.job_progress import JobProgress, jobs_folder, watching
from dmotion_bench.registry import leaderboard_part
from dmotion_bench.scoring.differences import Difference
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, AnyPaths, Workspace, as_path, in_workspace, listed

_GIGABYTES: Final = 2.0  # that checking takes beside others
_CLUSTER_GIGABYTES: Final = 16
_CLUSTER_MINUTES: Final = 24 * 60
_LOG = logging.getLogger(__name__)


class Built(Protocol):
    """A leaderboard that was built.

    Attributes:
        page: The page's file.
        measured, published: Entries of each kind.
        left_out: By the runs' names, why they have no entry.
        doubtful: Files of entries that were left in the folder although they have a run's name and place: they are of
            an earlier training, or of somebody else's.
    """

    page: Path
    measured: int
    published: int
    left_out: dict[str, str]
    doubtful: tuple[str, ...]

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON writes it."""
        ...


class Verdict(Protocol):
    """What checking an entry found.

    Attributes:
        entry: Its name.
        findings: What does not hold; empty for a sound entry.
        missing: What would be needed to check it and is not here.
        remarks: What is to be borne in mind.
        figures: How many of the model's were computed again: by a new scoring, or from the stored samples alone.
        samples: How many were held against a new scoring.
    """

    entry: str
    findings: tuple[str, ...]
    missing: tuple[str, ...]
    remarks: tuple[str, ...]
    figures: int
    samples: int

    @property
    def holds(self) -> bool:
        """Whether everything was checked and nothing was found."""
        ...

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON writes it."""
        ...


@in_workspace
def leaderboard_build(
    runs: AnyPaths | None = None,
    *,
    entries: AnyPaths = (),
    out: AnyPath | None = None,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Built:
    """Write a web page that compares scored runs with each other and with published results.

    Args:
        runs: Scored runs, by folder or name. Default: every run of the workspace.
        entries: Entries of other people: files or folders.
        out: The folder to write; ``reports/leaderboard`` of the workspace by default.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how many runs are done, or True for a bar.

    Raises:
        UnknownName, RunMissing: There is no such run. A run that has not been scored is left out, and the result says
            why.
        EntryInvalid: A given entry is none.
        UsageError: The folder holds a page of another kind, or is a file.

    Example:
        >>> report = dm.score("tiny", "prediction")
        >>> built = dm.leaderboard_build("tiny", out="page")
        >>> built.page.as_posix(), built.measured
        ('page/index.html', 1)
    """
    place = Workspace.current()
    paths = place.all_runs() if runs is None else [place.run(one) for one in listed(runs)]
    page = built_page(place) if out is None else as_path("folder of a page", out)
    if page.is_file():
        raise UsageError(f"{str(page)!r} is a file; name a folder for the page.")
    with telling(progress) as tell:
        made: Built = leaderboard_part("build")(
            paths,
            [as_path("entry", one) for one in listed(entries)],
            page,
            on_progress=_told(tell, "building"),
        )
    return made


@in_workspace
def leaderboard_check(
    paths: AnyPaths | None = None,
    *,
    quick: bool = False,
    differing: float = 0.0,
    draw: SupportsIndex | None = None,
    workers: SupportsIndex | None = 1,
    executor: str = "local",
    place: AnyPath | None = None,
    workspace: AnyPath | None = None,
    progress: Progress = None,
    watch: Callable[[Mapping[str, JobProgress]], None] = lambda jobs: None,
    warn: Callable[[str], None] = _LOG.warning,
) -> list[Verdict]:
    """Check that the figures of entries are right: score them again from their weights and data.

    Args:
        paths: Entries, folders of entries, or runs. Default: the entries that ``leaderboard_build`` wrote.
        quick: Compare the figures with the stored samples only, without scoring again.
        differing: Share of samples that may differ, because processors round differently.
        draw: Draws the control tasks that are planned anew, as an earlier check did. Default: drawn now, so that
            nobody knew them.
        workers: How many entries are checked at a time; None: as many as there are processors and memory for. More
            than one need ``if __name__ == "__main__":`` in a script. The verdicts are the same for any number.
        executor: Where they are checked: ``"local"``, ``"ray"`` or ``"slurm"``.
        place: Fetch the runs and data sets that the entries need from there first (``share_pull``).
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how far it is, or True for a bar.
        watch: A function that is told, now and then and by another thread, how far the jobs of an executor are, by
            their names.
        warn: Told in a sentence what could not be fetched.

    Raises:
        UnknownName: A path stands for nothing.
        UsageError: There is nothing to check, or a value is not allowed.

    Example:
        >>> report = dm.score("tiny", "prediction")
        >>> [verdict] = dm.leaderboard_check("tiny", quick=True)
        >>> verdict.holds, verdict.findings
        (True, ())
    """
    require_one_of("executor", executor, EXECUTORS)
    workers, draw, differing = whole("workers", workers, 1), whole("draw", draw, 0), share("differing", differing)
    home = Workspace.current()
    built = built_page(home) / "entries"
    if paths is None and not built.is_dir():
        raise UsageError(
            f"nothing to check: there is no {shown(str(built))}; build it with 'dmbench leaderboard build', or name "
            "entries."
        )
    asked = [built] if paths is None else [as_path("entry or run", one) for one in listed(paths)]
    if place is not None:
        for why in pull_entries(asked, place, workspace=workspace, progress=progress):
            warn(f"not fetched: {why}")
    check = leaderboard_part("check")
    how = {"quick": quick, "differing": differing, "draw": draw}
    with telling(progress) as tell:
        verdicts: list[Verdict]
        if executor == "local" and workers == 1:
            verdicts = check(asked, home, **how, on_progress=_told(tell, "checking"))
            return verdicts

        def count(done: int, total: int) -> None:
            tell(JobProgress(what="checking", done=done, total=total))

        many = available_workers(_GIGABYTES) if workers is None and executor == "local" else workers
        size = JobSize(gigabytes=_CLUSTER_GIGABYTES, minutes=_CLUSTER_MINUTES)
        with jobs_folder(home) as jobs, watching(jobs, watch):
            hands = make_executor(executor, many, scratch=jobs / executor, size=size)
            verdicts = check(asked, home, executor=hands, progress=jobs, on_verdict=count, **how)
            return verdicts


@in_workspace
def leaderboard_compare(
    first: AnyPaths,
    second: AnyPaths,
    *,
    data: AnyPath | None = None,
    split: SplitName = "test",
    workspace: AnyPath | None = None,
    warn: Callable[[str], None] = _LOG.warning,
) -> list[Difference]:
    """Which of two models is better, by their difference on the same frames and its interval.

    Args:
        first, second: A scored run, by folder or name, or several that differ in their seed alone, whose mean is
            compared: all of them, or their name without the seed, such as ``dmotion-grid_world-small``.
        data: Another data set that both were scored on, by folder, name or address. Default: the one of the training.
        split: ``"test"`` or ``"validation"``: which episodes both were scored on.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        warn: Told in a sentence which figures are left out, since they were measured with different settings, and
            which are of a part of a run's samples alone.

    Returns:
        The difference of each figure that both have: ``difference`` with its 95% interval over episodes and, of a
        model with several trainings, over these, and ``verdict``.

    Raises:
        UnknownName, RunMissing: There is no such run, or it was not scored on this data set.
        UsageError: A run is named on both sides.
        DatasetMissing, DatasetIncomplete, DatasetCorrupt: The data set cannot be opened.
        RunMismatch: They were not scored on the same frames, or all that both have with different settings, or the
            trainings of one model differ in more than their seed.

    Example:
        >>> other = dm.train("dmotion", seed=1, settings={"epochs": 0.1}, out="other")
        >>> reports = [dm.score(run, "prediction") for run in ("tiny", other)]
        >>> differences = dm.leaderboard_compare("tiny", other)
        >>> differences[0].figure, differences[0].verdict
        ('mse', 'unknown: 2 episodes')
    """
    require_one_of("split", split, ("test", "validation"))
    place = Workspace.current()
    dataset = None if data is None else Dataset.open(place.dataset(data))
    models = [_trainings(place, one) for one in (first, second)]
    places = [{run.resolve(): run for run in own} for own in models]
    if both := [run for where, run in places[0].items() if where in places[1]]:
        raise UsageError(f"{shown(str(both[0]))} is named on both sides; name two models that differ.")
    differences: list[Difference] = leaderboard_part("compare")(*models, dataset, split, warn=warn)
    return differences


def _trainings(place: Workspace, given: AnyPaths) -> list[Path]:
    """The runs of a model that somebody named.

    Raises:
        UnknownName, RunMissing: There is no such run.
        UsageError: No run was named.
    """
    named = listed(given)
    if not named:
        raise UsageError("no run was named; name one, or the trainings whose mean is compared.")
    return place.trainings(named[0]) if len(named) == 1 else [place.run(one) for one in named]


def built_page(workspace: Workspace | None = None) -> Path:
    """Where a workspace's page is built if nobody names a folder."""
    return (workspace or Workspace.current()).reports / "leaderboard"


def _told(tell: Callable[[JobProgress], None], verb: str) -> Callable[[str, int, int], None]:
    """Tells of a run at work as the leaderboard's functions do."""
    return lambda what, done, total: tell(JobProgress(what=verb, done=done, total=total, status=what))
