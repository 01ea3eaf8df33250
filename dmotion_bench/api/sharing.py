"""Publish runs and data sets by their hashes, and fetch them, verified."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.api.progress import Progress, Tell, telling
from dmotion_bench.errors import (
    DatasetMissing,
    DmbenchError,
    EntryInvalid,
    RunMissing,
    ShareCorrupt,
    ShareMissing,
    UnknownName,
    UsageError,
)
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.report import REPORT_FOLDER, SAMPLES_FILE
from dmotion_bench.sharing.contents import Shared, contents, find
from dmotion_bench.sharing.place import open_place
from dmotion_bench.sharing.pull import Pulled, pull_dataset, pull_run
from dmotion_bench.sharing.push import Pushed, push_dataset, push_run
from dmotion_bench.sharing.wanted import Wanted, entry_files, wanted_by
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import fingerprint_at
from dmotion_bench.storage.shard import file_facts
from dmotion_bench.wording import shown
from dmotion_bench.workspace import (
    DATASET_MANIFEST,
    RUN_MANIFEST,
    AnyPath,
    AnyPaths,
    Workspace,
    as_path,
    in_workspace,
    listed,
)

_HASH: Final = re.compile(r"([0-9a-f]{8,64})(?:/([0-9a-f]{8,64}))?")


@dataclass(frozen=True, kw_only=True)
class _Sources:
    """What is to be published."""

    runs: tuple[Path, ...] = ()
    datasets: tuple[Path, ...] = ()


@in_workspace
def share_push(
    what: AnyPaths,
    place: AnyPath,
    *,
    labels: bool = True,
    mend: bool = False,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> list[Pushed]:
    """Publish runs and data sets, so that others can fetch them by their hashes and check results.

    A run is published with its weights, settings, curves and reports, never with labels. What the place has already is
    not sent again, and nothing there is replaced by other content.

    Args:
        what: Runs or data sets, by path or name; or entries of the leaderboard, by file or folder, for the run and the
            data sets that checking them takes.
        place: A folder, or an address that begins with ``s3://``, ``gs://`` or ``hf://``.
        labels: Whether ``labels/`` of the data sets are published, too: checking an entry takes them.
        mend: Read what the place has already, and replace what is damaged.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how far it is, True for a bar.

    Raises:
        UnknownName, RunMissing, DatasetMissing: Something is not here.
        RunCorrupt, DatasetCorrupt: Something is damaged, so it is not published.
        PlaceUnreachable: The place does not take it.

    Example:
        >>> pushed = dm.share_push(["tiny", "grid_world-tiny"], "published")
        >>> [(one.kind, one.name) for one in pushed]
        [('data set', 'grid_world-tiny'), ('run', 'tiny')]
    """
    here, there = Workspace.current(), open_place(place)
    sources = [_sources(one, here) for one in _some(what)]
    datasets = dict.fromkeys(path for one in sources for path in one.datasets)
    runs = dict.fromkeys(path for one in sources for path in one.runs)
    opened, trained = [Dataset.open(path) for path in datasets], [Run.open(path) for path in runs]
    with telling(progress) as tell:
        told = _telling(tell, "sending")
        pushed = [push_dataset(there, one, labels=labels, mend=mend, tell=told) for one in opened]
        return pushed + [push_run(there, one, mend=mend, tell=told) for one in trained]


@in_workspace
def share_pull(
    what: AnyPaths,
    place: AnyPath,
    *,
    labels: bool = True,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> list[Pulled]:
    """Fetch runs and data sets that were published; each appears as a whole, with the right hashes, or not at all.

    Args:
        what: Entries of the leaderboard, by file or folder, for all that checking them takes; or hashes of weights or
            of a data set, at least their first eight digits.
        place: As for ``share_push``.
        labels: Whether ``labels/`` of the data sets are fetched, too: checking an entry takes them.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how far it is, True for a bar.

    Raises:
        ShareMissing, UnknownName: The place does not have it.
        ShareCorrupt: What it has is not what its hashes say; nothing of it is used.
        UsageError: Something else has the name here.
        PlaceUnreachable: The place does not answer.

    Example:
        >>> run = dm.load_run("tiny")
        >>> _ = dm.share_push(run, "published")
        >>> pulled = dm.share_pull(run.result["weights"], "published", workspace="elsewhere")
        >>> [(one.kind, one.name, one.path.as_posix()) for one in pulled]
        [('run', 'tiny', 'elsewhere/runs/tiny')]
    """
    here, there = Workspace.current(), open_place(place)
    pulled: list[Pulled] = []
    with telling(progress) as tell:
        told = _telling(tell, "fetching")
        for one in _some(what):
            wanted = _wanted(one)
            if wanted is not None:
                for fingerprint, name in wanted.datasets.items():
                    pulled.append(pull_dataset(there, here, fingerprint, name=name, labels=labels, tell=told))
                pulled.append(pull_run(there, here, wanted.weights, samples=wanted.samples, tell=told))
                continue
            beginning, _, share = str(one).partition("/")
            kind, digest = find(there, beginning)
            if kind == "run":
                pulled.append(pull_run(there, here, digest, share=share, tell=told))
            else:
                pulled.append(pull_dataset(there, here, digest, labels=labels, tell=told))
    return list({one.path: one for one in reversed(pulled)}.values())[::-1]


def share_list(place: AnyPath) -> list[Shared]:
    """Everything that is published in a place.

    Args:
        place: As for ``share_push``.

    Raises:
        PlaceUnreachable: It does not answer.

    Example:
        >>> _ = dm.share_push("grid_world-tiny", "published", labels=False)
        >>> [(one.kind, one.name, one.labels) for one in dm.share_list("published")]
        [('data set', 'grid_world-tiny', False)]
    """
    return contents(open_place(place))


@in_workspace
def pull_entries(
    paths: Sequence[Path], place: AnyPath, *, workspace: AnyPath | None = None, progress: Progress = None
) -> list[str]:
    """Fetch what checking some entries takes; says of each that cannot be had why.

    Args:
        paths: Entries' files and folders of them; published results, and paths of runs, need nothing. Nor does a file
            that is no entry, which the check says.
        place, workspace, progress: As for ``share_pull``.

    Raises:
        As ``share_pull``, but for what is missing or damaged there, and for what cannot stand beside what is here.
    """
    missing = []
    open_place(place)  # what is wrong with it is no entry's fault
    given = map(Path, listed(paths))
    for file in (file for path in given for file in (entry_files(path) if _holds_entries(path) else [path])):
        try:
            if not file.is_file() or wanted_by(file) is None:
                continue
        except EntryInvalid:
            continue
        try:
            share_pull(file, place, workspace=workspace, progress=progress)
        except (ShareMissing, ShareCorrupt, UsageError) as error:
            missing.append(f"{file.name}: {error}")
    return missing


def _listed(things: AnyPaths) -> list[AnyPath]:
    """One thing after the other; a folder of entries stands for those of its entries that were measured."""
    paths = [(thing, as_path("run, data set, entry or hash", thing)) for thing in listed(things)]
    return [one for thing, path in paths for one in (_measured(path) if _holds_entries(path) else [thing])]


def _some(things: AnyPaths) -> list[AnyPath]:
    """As ``_listed``.

    Raises:
        UsageError: There is nothing.
    """
    if not (found := _listed(things)):
        raise UsageError(
            f"{shown([str(one) for one in listed(things)])} holds no result that was measured; results that a paper "
            "has published have neither weights nor data."
        )
    return found


def _measured(folder: Path) -> list[Path]:
    return [path for path in entry_files(folder) if wanted_by(path) is not None]


def _holds_entries(path: Path) -> bool:
    """Whether a path is a folder of entries."""
    sources = (RUN_MANIFEST, DATASET_MANIFEST)
    return path.is_dir() and not any((path / name).exists() for name in sources) and bool(entry_files(path))


def _telling(tell: Tell, verb: str) -> Callable[[str, int, int], None]:
    return lambda name, done, total: tell(JobProgress(what=f"{verb} {name}", done=done, total=total, status="files"))


def _wanted(given: AnyPath) -> Wanted | None:
    """The sources of an entry; None for a hash.

    Raises:
        UsageError: It is neither, or an entry that was copied from a paper.
    """
    path = Path(given)
    if path.is_file():
        wanted = wanted_by(path)
        if wanted is None:
            raise UsageError(
                f"{shown(str(path))} is a result that a paper has published: it has neither weights nor data."
            )
        return wanted
    if _HASH.fullmatch(str(given)):
        return None
    raise UsageError(
        f"{shown(str(given))} is neither an entry's file nor a hash of weights or of a data set, at least eight "
        "hexadecimal digits of it; 'dmbench share list PLACE' lists the hashes."
    )


def _sources(given: AnyPath, workspace: Workspace) -> _Sources:
    """The runs and data sets that something stands for.

    Raises:
        UnknownName: It stands for nothing.
        UsageError: It stands for two things, or for a published result.
        RunMissing, DatasetMissing: The sources of an entry are not here.
    """
    path = Path(given)
    if path.is_file():
        wanted = _wanted(path)
        assert wanted is not None, "it is a file"
        return _of_entry(path, wanted, workspace)
    runs = [one for one in (path, workspace.runs / path) if (one / RUN_MANIFEST).is_file()]
    datasets = [one for one in (path, workspace.data / path) if (one / DATASET_MANIFEST).is_file()]
    if runs and datasets:
        raise UsageError(
            f"{shown(str(given))} is a run and a data set; name one by its path: {shown(str(runs[0]))} or "
            f"{shown(str(datasets[0]))}."
        )
    if not runs and not datasets:
        known = [one.name for one in (*workspace.all_runs(), *workspace.datasets())]
        raise UnknownName("run, data set or entry", str(given), known, "dmbench list runs")
    return _Sources(runs=tuple(runs[:1]), datasets=tuple(datasets[:1]))


def _of_entry(path: Path, wanted: Wanted, workspace: Workspace) -> _Sources:
    """The run and the data sets of an entry, found by their hashes."""
    runs = [one for one in workspace.all_runs() if _is_run(one, wanted)]
    if not runs:
        raise RunMissing(
            f"no run in {shown(str(workspace.runs))} has the weights {wanted.weights[:12]} and the samples "
            f"{wanted.samples[:12]} that {shown(path.name)} names; score the run again with 'dmbench score', or go to "
            "its workspace."
        )
    known = {fingerprint_at(one): one for one in workspace.datasets()}
    missing = [name for fingerprint, name in wanted.datasets.items() if fingerprint not in known]
    if missing:
        raise DatasetMissing(
            f"no data set in {shown(str(workspace.data))} has the fingerprint of {shown(missing[0])} that "
            f"{shown(path.name)} names; go to its workspace, or record it again."
        )
    return _Sources(runs=(runs[0],), datasets=tuple(known[one] for one in wanted.datasets))


def _is_run(path: Path, wanted: Wanted) -> bool:
    try:
        result = Run.open(path).result
    except DmbenchError:
        return False
    if result is None or result["weights"] != wanted.weights:
        return False
    found = (one for one in (path / REPORT_FOLDER).rglob(SAMPLES_FILE) if one.is_file())  # a pipe would be waited for
    return any(file_facts(one).sha256 == wanted.samples for one in found)
