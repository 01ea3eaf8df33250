"""Check an entry: compare everything that it says with its run, its data set and a new scoring.

Where the run, the data set or the code that scored it is not here, an entry is neither sound nor wrong: not checked.

In this order:

1. the run of this workspace whose weights have the entry's hash, and what it says of itself (``sources.py``);
2. the data set that has the entry's fingerprint: every file's hash, and the frame cache against the video;
3. the run's stored samples: their hash; the figures and the sums by episode, computed from them (``rescored.py``);
4. control: the actions repeated in the simulator, and those of some tasks planned anew (``control.py``);
5. the weights' own hash, and the held-out episodes scored anew: sample by sample, then figure by figure; the number of
   labels that the budget gives on the data set of the training;
6. the pictures, predicted anew.

What cannot be shown so: that the weights are what the training made, and no copy that was changed a little; that the
training used the seed and the labels that it says, how long it took, and which packages were installed. That takes
training again; a run is reproducible from its ``run.json`` and its data set.
"""

from __future__ import annotations

import contextlib
import secrets
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Final

import pyarrow as pa

from dmotion_bench.errors import (
    CacheNotWritable,
    DatasetError,
    DmbenchError,
    FolderInUse,
    JobsLost,
    PackageNotInstalled,
    PlaceUnreachable,
    RunMissing,
    StorageFull,
    UnknownName,
    UsageError,
)
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.learning.hardware.threads import not_allowed, using_threads
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.scoring.gain import GAIN_VERSION, GainScoring
from dmotion_bench.scoring.prediction import Execution, Progress, silent
from dmotion_bench.scoring.references import published_results
from dmotion_bench.scoring.report import CONTRACT, REPORT_FILE, REPORT_FOLDER, SCORING_VERSION
from dmotion_bench.scoring.samples import CONTROL, GAIN
from dmotion_bench.scoring.score import contract_remark, score_model
from dmotion_bench.scoring.settings import METRICS, ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.scoring.transfer import report_folder, transfer_folders
from dmotion_bench.sharing.wanted import entry_files
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shown
from dmotion_bench.workspace import RUN_MANIFEST, Workspace
from leaderboard.build import entry_of_run
from leaderboard.control import check_control
from leaderboard.entry import Entry, published_entry
from leaderboard.entry_file import read_entry
from leaderboard.paper import label_count
from leaderboard.pictures import take_pictures
from leaderboard.rescored import against_samples, same_pictures, same_samples, same_scores, stored_samples
from leaderboard.sources import against_run, as_read, find_dataset, find_run, same_labels
from leaderboard.verdict import Findings, Verdict, copies_found, short

LEAST_RESAMPLES: Final = 100  # of very few draws an interval is as narrow as one likes
MOST_RESAMPLES: Final = 20_000  # each draw holds a number of every episode
_HERE: Final = (CacheNotWritable, FolderInUse, PlaceUnreachable, StorageFull)
"""What keeps this machine from checking says nothing against an entry."""
_SHARED: Final = SharedSamples(on_disk=False)  # what is checked is computed here
"""Of the present process: it computes them once for all entries of a data set that it checks."""


@dataclass(frozen=True, kw_only=True)
class CheckSettings:
    """How an entry is checked.

    Attributes:
        score: Whether to score anew; without, figures are held against the stored samples only.
        differing: Share of the samples that may differ, for another kind of processor.
        draw: Seed by which the control tasks that are planned anew are drawn; by default whoever checks draws it, so
            that no author knows it.
    """

    score: bool = True
    differing: float = 0.0
    draw: int = field(default_factory=lambda: secrets.randbits(32))


def check_entry(
    entry: Entry,
    workspace: Workspace,
    settings: CheckSettings | None = None,
    *,
    how: Execution | None = None,
    shared: SharedSamples | None = None,
) -> Verdict:
    """Check an entry against the runs and data sets of a workspace.

    Args:
        entry: To be checked.
        workspace: Where its run and data set are looked for, by their hashes.
        settings: How strictly.
        how: Batch size, device and progress of the new scoring.
        shared: Keeps what other entries have in common with this one, for the next entry of this process.
    """
    check, settings = Findings(entry=entry), settings or CheckSettings()
    if not entry.is_measured:
        _against_tables(check)
        return check.verdict()
    is_ours = entry.scored_by == SCORING_VERSION
    if not is_ours:
        check.missing.append(
            f"version: the entry was scored by version {short(entry.scored_by)}, this is version {SCORING_VERSION}; "
            "its figures were not compared; score the run again, or check with the dmbench that scored it"
        )
    if check.entry.column not in (None, *COLUMNS):
        check.wrong.append(f"settings.control_column is {short(check.entry.column)}, which cannot be")
        return check.verdict()
    run, asked = find_run(check, workspace), _settings(check)
    dataset = find_dataset(check, workspace, run)
    if run is None or dataset is None:
        return check.verdict()
    try:
        read = as_read(check, run, dataset)
    except DatasetError as error:
        check.missing.append(f"data set of the training: {error}")
        return check.verdict()
    folder = report_folder(run.path, run.spec.fingerprint, dataset, column=check.entry.column)
    against_run(check, run, dataset, folder)
    samples = stored_samples(check, folder)
    if asked is None or read is None or not is_ours:
        return check.verdict()
    if samples is not None:
        against_samples(check, samples, asked, read)
    how, threads = how or Execution(), run.threads if settings.score else None
    if threads is not None and (told := not_allowed(threads)) is not None:
        check.missing.append(f"threads: {told}")
        return check.verdict()
    try:
        with using_threads(threads):
            if settings.score:
                _score_anew(check, run, read, samples, asked, settings, how, shared)
            else:
                check.remarks.append("not scored anew")
            check_control(
                check,
                run,
                read,
                samples,
                anew=settings.score,
                differing=settings.differing,
                draw=settings.draw,
                how=how,
            )
    except (UnknownName, PackageNotInstalled) as error:
        check.missing.append(f"code: {error}")
    except _HERE as error:
        check.missing.append(f"this machine: {error}")
    except DmbenchError as error:
        check.wrong.append(f"scoring anew fails: {error}")
    return check.verdict()


def _score_anew(
    check: Findings,
    run: Run,
    dataset: Dataset,
    samples: pa.Table | None,
    asked: ScoreSettings,
    settings: CheckSettings,
    how: Execution,
    shared: SharedSamples | None,
) -> None:
    said = check.entry.content["settings"]
    others = {CONTROL} if said.get(f"{GAIN}_version", GAIN_VERSION) == GAIN_VERSION else {CONTROL, GAIN}
    if not run.model.needs_pixels and not any(name.startswith("rollout_") for name in check.entry.figures):
        others.add("rollout")
        check.remarks.append("figures: the entry has no ranks of states, which came later for a model without frames")
    metrics = tuple(name for name in METRICS if name in said["metrics"] and name not in others)
    scores = score_model(run.model, dataset, metrics=metrics, settings=asked, how=how, shared=shared)
    same_scores(check, scores, metrics)
    same_labels(check, run, dataset)
    check.expect(f"remarks.{CONTRACT}", check.entry.content["remarks"].get(CONTRACT), contract_remark(run, dataset))
    if samples is not None:
        same_samples(check, samples, scores.samples, settings.differing, metrics)
        same_pictures(check, take_pictures(run, dataset, scores.samples))


@dataclass(frozen=True, kw_only=True)
class CheckJob:
    """An entry to be checked, as plain values, so that it can be sent anywhere.

    Attributes:
        number: Its place among the verdicts.
        path: Of the entry's file, or of the run that it would be.
        report: The run's report that is meant; None: that of its own data set.
        workspace: Where runs and data sets are.
        settings: How strictly it is checked.
        progress: The file in which the job says how far it is; None: nowhere.
    """

    number: int
    path: Path
    report: Path | None
    workspace: Path
    settings: CheckSettings
    progress: Path | None = None


def check_job(job: CheckJob, on_progress: Progress = silent) -> tuple[int, Verdict]:
    """Check one entry in the present process, and tell its number with the verdict."""
    told = ProgressFile(job.progress)

    def show(what: str, done: int, total: int) -> None:
        told.tell(JobProgress(what=job.path.stem, done=done, total=total, status=what))
        on_progress(what, done, total)

    try:
        entry = read_entry(job.path) if job.path.is_file() else entry_of_run(job.path, job.report)
        how, workspace = Execution(progress=show), Workspace(job.workspace)
        verdict = check_entry(entry, workspace, job.settings, how=how, shared=_SHARED)
    except (RunMissing, *_HERE) as error:  # a run without a report claims nothing
        verdict = Verdict(entry=job.path.name, findings=(), missing=(str(error),))
    except DmbenchError as error:
        verdict = Verdict(entry=job.path.name, findings=(str(error),))
    finally:
        told.end()
    return job.number, verdict


def check_paths(
    paths: Sequence[Path],
    workspace: Workspace,
    *,
    quick: bool = False,
    differing: float = 0.0,
    draw: int | None = None,
    on_progress: Progress = silent,
    executor: Executor | None = None,
    progress: Path | None = None,
    on_verdict: Callable[[int, int], None] = lambda done, total: None,
) -> list[Verdict]:
    """Check entries' files, folders of them, and runs as the entries that they would be.

    Args:
        paths: Of files, folders or runs.
        workspace: Where runs and data sets are.
        quick: Score nothing anew.
        differing, draw: See ``CheckSettings``.
        on_progress: Told how far the scoring is, where it is done in this process.
        executor: Checks entries beside each other, with the same verdicts; all its machines see the same paths.
        progress: A folder in which its jobs say how far they are (``job_progress.watching``); None: nowhere.
        on_verdict: Told how many entries of how many are checked.

    Raises:
        UnknownName, UsageError: A path stands for nothing.
    """
    settings = CheckSettings(score=not quick, differing=differing)
    settings = settings if draw is None else replace(settings, draw=draw)
    meant = [one for given in paths for one in _meant(given, workspace)]
    jobs = [
        CheckJob(
            number=number,
            path=path.absolute(),
            report=None if report is None else report.absolute(),
            workspace=workspace.root.absolute(),
            settings=settings,
            progress=None if progress is None else progress / f"check-{number}.json",
        )
        for number, (path, report) in enumerate(meant)
    ]
    on_verdict(0, len(jobs))
    results = (
        (check_job(job, on_progress) for job in jobs) if executor is None else executor.map_unordered(check_job, jobs)
    )
    verdicts: dict[int, Verdict] = {}
    with contextlib.closing(results):
        try:
            for number, verdict in results:
                verdicts[number] = verdict
                on_verdict(len(verdicts), len(jobs))
        except JobsLost as lost:
            for job in lost.jobs:
                verdicts[job.number] = Verdict(entry=job.path.name, findings=(), missing=(str(lost),))
    return copies_found(_told_apart([(job.path, verdicts[job.number]) for job in jobs]))


def _told_apart(found: Sequence[tuple[Path, Verdict]]) -> list[Verdict]:
    """The verdicts; where several entries call themselves the same, with the names of their files."""
    often = Counter(verdict.entry for _, verdict in found)
    return [
        replace(verdict, entry=f"{verdict.entry}, {path.name}")
        if often[verdict.entry] > 1 and path.is_file()
        else verdict
        for path, verdict in found
    ]


def _meant(path: Path, workspace: Workspace) -> list[tuple[Path, Path | None]]:
    """The entry files that a path stands for, or the run with all the reports that it has.

    Raises:
        UsageError: It names an entry's file that is not there.
        UnknownName: It stands for nothing else.
    """
    if path.is_file():
        return [(path, None)]
    if path.is_dir() and not (path / RUN_MANIFEST).is_file() and (found := entry_files(path)):
        return [(one, None) for one in found]
    if path.suffix == ".json" and not path.exists():
        build = "'dmbench leaderboard build'"
        raise UsageError(f"there is no entry {shown(str(path))}; {build} writes those of the workspace's runs.")
    run = workspace.run(path)
    elsewhere = [(run, folder) for folder in transfer_folders(run)]
    has_own = (run / REPORT_FOLDER / REPORT_FILE).is_file() or not elsewhere  # else that it has none is said
    return [(run, None), *elsewhere] if has_own else [*elsewhere]


def _against_tables(check: Findings) -> None:
    """Compare a published row with our copy of its table."""
    entry = check.entry
    wanted = (entry.model, entry.environment, entry.labels)
    for row in published_results():
        if (row.model, row.environment, row.labels) != wanted:
            continue
        ours = published_entry(row, label_count(row.environment, row.labels))
        check.expect_figures("as published", entry.figures, ours.figures)
        for name in ("labels", "source", "note"):
            check.expect(name, entry.content[name], ours.content[name])
        check.figures |= ours.figures.keys()
        check.remarks.append("published: held against the table, not scored")
        return
    check.missing.append("published elsewhere: there is nothing to hold it against")


def _settings(check: Findings) -> ScoreSettings | None:
    """The settings of the new scoring; None if the entry's settings are not possible."""
    given = dict(check.entry.content["settings"])
    known = {one.name for one in fields(ScoreSettings)}
    allowed = {
        "precision": given["precision"] in ("float32", "bf16"),
        "resamples": type(given.get("resamples")) is int and LEAST_RESAMPLES <= given["resamples"] <= MOST_RESAMPLES,
        "metrics": isinstance(given["metrics"], list),
    }
    wrong = [
        f"settings.{name} is {short(given.get(name))}, which cannot be" for name, fine in allowed.items() if not fine
    ]
    check.wrong += wrong
    if wrong:
        return None
    settings = ScoreSettings(**{name: value for name, value in given.items() if name in known})
    if GAIN not in given["metrics"]:
        return settings
    if (version := given.get(f"{GAIN}_version")) != GAIN_VERSION:
        check.missing.append(
            f"version: the gain captured was measured by version {short(version)}, this is version {GAIN_VERSION}; "
            "score the run again, or check with the dmbench that scored it"
        )
    try:
        return replace(settings, gain=GainScoring.from_json(given))
    except (DmbenchError, KeyError, TypeError) as error:
        check.wrong.append(f"settings of the gain captured that cannot be: {short(str(error))}")
        return None
