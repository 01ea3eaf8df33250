"""Check an entry: compare everything that it says with its run, its data set and a new scoring.

Where the run, the data set or the code that scored it is not here, an entry is neither sound nor wrong: not checked.

In this order:

1. the run of this workspace whose weights have the entry's hash, and what it says of itself (``sources.py``);
2. the data set that has the entry's fingerprint: every file's hash, and the frame cache against the video;
3. the run's stored samples: their hash; the figures and the sums by episode, computed from them once more;
4. control: the actions repeated in the simulator, and some of them planned anew (``control.py``);
5. the weights' own hash, and the held-out episodes scored anew: sample by sample, then figure by figure;
6. the pictures, predicted anew.

What cannot be shown so: that the training used the seed and the labels that it says, how long it took, and which
packages were installed. That takes training again; a run is reproducible from its ``run.json`` and its data set.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
from jaxtyping import Bool

from dmotion_bench.errors import DatasetError, DmbenchError, RunCorrupt
from dmotion_bench.execution.executor import Executor
from dmotion_bench.execution.job_progress import JobProgress, ProgressFile
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.threads import not_allowed, using_threads
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.gain import GainScoring
from dmotion_bench.scoring.prediction import MODEL, Execution, Progress, silent
from dmotion_bench.scoring.reference_samples import ReferenceScores
from dmotion_bench.scoring.references import REFERENCES, published_results
from dmotion_bench.scoring.report import SAMPLES_FILE, SCORING_VERSION
from dmotion_bench.scoring.samples import CONTROL, FIGURE_COLUMNS, GAIN, GAIN_COLUMNS, column, read_samples
from dmotion_bench.scoring.score import (
    METRICS,
    Scores,
    ScoreSettings,
    score_model,
)
from dmotion_bench.scoring.transfer import report_folder, transfer_folders
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.shard import file_facts
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.workspace import RUN_MANIFEST, Workspace
from leaderboard.build import entry_of_run
from leaderboard.comparison import sums_by_episode
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.control import check_control
from leaderboard.entry import Entry, published_entry
from leaderboard.entry_file import read_entry
from leaderboard.paper import label_count
from leaderboard.pictures import from_png, identity, take_pictures
from leaderboard.sources import against_run, as_read, find_dataset, find_run
from leaderboard.verdict import SAME, SHOWN, Findings, Verdict, short

ROUNDING: Final = 1e-3
"""Relative; between the figures of two scorings."""

SAMPLE_ROUNDING: Final = 1e-2
"""Relative and absolute; between two scorings of one sample."""

PICTURE_ROUNDING: Final = 3  # pixel values
LATER: Final = ("probe_", "codebook_")
"""Figures that entries of this version of scoring may lack: they came later, and changed no other."""

MOST_RESAMPLES: Final = 100_000
_REFERENCES: Final = ReferenceScores(on_disk=False)  # what is checked is computed here
"""Of the present process: it computes them once for all entries of a data set that it checks."""
_KEY: Final = ("episode", "step", "ahead")


@dataclass(frozen=True, kw_only=True)
class CheckSettings:
    """How an entry is checked.

    Attributes:
        score: Whether to score anew; without, figures are held against the stored samples only.
        differing: Share of the samples that may differ, for another kind of processor.
    """

    score: bool = True
    differing: float = 0.0


def check_entry(
    entry: Entry,
    workspace: Workspace,
    settings: CheckSettings | None = None,
    *,
    how: Execution | None = None,
    references: ReferenceScores | None = None,
) -> Verdict:
    """Check an entry against the runs and data sets of a workspace.

    Args:
        entry: To be checked.
        workspace: Where its run and data set are looked for, by their hashes.
        settings: How strictly.
        how: Batch size, device and progress of the new scoring.
        references: Keeps the references' samples for the next entry of this process.
    """
    check, settings = Findings(entry=entry), settings or CheckSettings()
    if not entry.is_measured:
        _against_tables(check)
        return check.verdict()
    if entry.scored_by != SCORING_VERSION:
        check.missing.append(
            f"version: the entry was scored by version {short(entry.scored_by)}, this is version {SCORING_VERSION}; "
            "score the run again, or check with the dmbench that scored it"
        )
    run, asked = find_run(check, workspace), _settings(check)
    dataset = find_dataset(check, workspace, run)
    if run is None or dataset is None:
        return check.verdict()
    try:
        read = as_read(check, run, dataset)
    except DatasetError as error:
        check.missing.append(f"data set of the training: {error}")
        return check.verdict()
    split = "test" if asked is None else asked.split
    folder = report_folder(run.path, run.spec.fingerprint, dataset, split, check.entry.column)
    against_run(check, run, dataset, folder)
    samples = _stored_samples(check, folder)
    if asked is None or read is None:
        return check.verdict()
    if samples is not None:
        _against_samples(check, samples, asked)
    how, threads = how or Execution(), run.threads if settings.score else None
    if threads is not None and (told := not_allowed(threads)) is not None:
        check.missing.append(f"threads: {told}")
        return check.verdict()
    try:
        with using_threads(threads):
            if settings.score:
                _score_anew(check, run, read, samples, asked, settings, how, references)
            else:
                check.remarks.append("not scored anew")
            check_control(check, run, read, samples, anew=settings.score, differing=settings.differing, how=how)
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
    references: ReferenceScores | None,
) -> None:
    metrics = tuple(name for name in METRICS if name in check.entry.content["settings"]["metrics"] and name != CONTROL)
    scores = score_model(run.model, dataset, metrics=metrics, settings=asked, how=how, references=references)
    _same_scores(check, scores)
    if samples is not None:
        _same_samples(check, samples, scores.samples, settings.differing)
        _same_pictures(check, take_pictures(run, dataset, scores.samples))


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
        verdict = check_entry(entry, workspace, job.settings, how=how, references=_REFERENCES)
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
        differing: See ``CheckSettings``.
        on_progress: Told how far the scoring is, where it is done in this process.
        executor: Checks entries beside each other, with the same verdicts; all its machines see the same paths.
        progress: A folder in which its jobs say how far they are (``job_progress.watching``); None: nowhere.
        on_verdict: Told how many entries of how many are checked.

    Raises:
        UnknownName: A path stands for nothing.
    """
    settings = CheckSettings(score=not quick, differing=differing)
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
        for number, verdict in results:
            verdicts[number] = verdict
            on_verdict(len(verdicts), len(jobs))
    return [verdicts[number] for number in range(len(jobs))]


def _meant(path: Path, workspace: Workspace) -> list[tuple[Path, Path | None]]:
    """The entry files that a path stands for, or the run with all its reports."""
    if path.is_file():
        return [(path, None)]
    if path.is_dir() and not (path / RUN_MANIFEST).is_file() and (found := sorted(path.glob("*.json"))):
        return [(one, None) for one in found]
    run = workspace.run(path)
    return [(run, None), *((run, folder) for folder in transfer_folders(run))]


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
        check.figures = len(ours.figures)
        check.remarks.append("published: held against the table, not scored")
        return
    check.remarks.append("published elsewhere: there is nothing to hold it against")


def _settings(check: Findings) -> ScoreSettings | None:
    """The settings of the new scoring; None if the entry's settings are not possible."""
    given = dict(check.entry.content["settings"])
    known = {one.name for one in fields(ScoreSettings)}
    allowed = {
        "split": given["split"] in SPLIT_NAMES,
        "protocol": given["protocol"] in ("episode", "paper"),
        "precision": given["precision"] in ("float32", "bf16"),
        "resamples": type(given.get("resamples")) is int and 1 <= given["resamples"] <= MOST_RESAMPLES,
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
    try:
        return replace(settings, gain=GainScoring.from_json(given))
    except (DmbenchError, KeyError, TypeError) as error:
        check.wrong.append(f"settings of the gain captured that cannot be: {short(str(error))}")
        return None


def _stored_samples(check: Findings, folder: Path) -> pa.Table | None:
    """The samples beside the run's report."""
    said, path = check.entry.content["samples"], folder / SAMPLES_FILE
    if not path.is_file():
        check.wrong.append(f"samples: there is no {str(path)!r} to hold the figures against")
        return None
    check.expect("samples.file", said["file"], SAMPLES_FILE)
    check.expect("samples.sha256", said["sha256"], file_facts(path).sha256)
    try:
        samples = read_samples(path)
    except RunCorrupt as error:
        check.wrong.append(f"samples: {error}")
        return None
    check.expect("samples.rows", said["rows"], len(samples))
    return samples


def _against_samples(check: Findings, samples: pa.Table, settings: ScoreSettings) -> None:
    """Compare every figure with the one computed from the stored samples."""
    content = check.entry.content
    stored = np.unique(column(samples, "predictor").astype(str)).tolist()
    everything = {**{name: {} for name in (*REFERENCES, *stored)}, **content["reference"], MODEL: content["figures"]}
    for predictor, said in everything.items():
        if predictor == "paper":
            continue
        found = figures_of(samples, predictor, resamples=settings.resamples)
        mine = {name: one.to_json() for name, one in found.items()}
        where = "figures" if predictor == MODEL else f"reference.{predictor}"
        check.expect_figures(f"{where}, from the samples", said, mine)
    said, ours = content["by_episode"], sums_by_episode(samples)
    if said.keys() != ours.keys() or not all(_same_sums(said[name], ours[name]) for name in ours):
        check.wrong.append("by_episode: other sums than those of the samples")


def _same_sums(said: Mapping[str, Any], found: Mapping[str, Any]) -> bool:
    same = (said["episode"], said["n"]) == (found["episode"], found["n"])
    return same and np.allclose(said["sum"], found["sum"], rtol=SAME, atol=SAME)


def _same_scores(check: Findings, scores: Scores) -> None:
    """Compare every mean with the new scoring; intervals were compared with the samples already."""
    content = check.entry.content
    everything = {"figures": (content["figures"], scores.figures)}
    for name, figures in scores.reference.items():
        everything[f"reference.{name}"] = (content["reference"].get(name, {}), figures)
    for where, (said, figures) in everything.items():
        mine = {name: one.to_json() for name, one in figures.items()}
        others = {name: figure for name, figure in said.items() if not name.startswith(CONTROLLED)}
        for later in (False, True):
            ours, theirs = (
                {name: one for name, one in all_of.items() if name.startswith(LATER) == later}
                for all_of in (mine, others)
            )
            if theirs or not later:  # entries from before there were such figures have none
                absolute = SAMPLE_ROUNDING if later else 0.0  # scores of probes are near zero where they read nothing
                check.expect_figures(
                    f"{where}, scored anew", theirs, ours, ROUNDING, means_only=True, absolute=absolute
                )
    check.figures = len(scores.figures)


def _same_samples(check: Findings, stored: pa.Table, scored: pa.Table, differing: float) -> None:
    """Compare the samples row by row; a given share may differ, because processors round differently."""
    predictors = np.unique(np.concatenate([column(table, "predictor") for table in (stored, scored)]).astype(str))
    wrong = list[str]()
    for predictor in predictors.tolist():
        for metric in ("prediction", "rollout", GAIN):
            one, other = (_part(table, predictor, metric) for table in (stored, scored))
            keys, others = (np.stack([column(table, name) for name in _KEY], axis=1) for table in (one, other))
            if not np.array_equal(keys, others):
                check.wrong.append(f"samples: the stored {metric} of {predictor} are of other frames")
                continue
            check.samples += len(one)
            rows = keys[_apart(one, other)].tolist()
            wrong += [f"{metric} of {predictor}, episode {episode}, step {step}" for episode, step, _ in rows]
    if wrong:
        told = f"{len(wrong)} of {check.samples} differ from the new scoring"
        if len(wrong) > differing * check.samples:
            check.wrong.append(f"samples: {told}: {'; '.join(wrong[:SHOWN])}")
        else:
            check.remarks.append(f"samples: {told}")


def _part(table: pa.Table, predictor: str, metric: str) -> pa.Table:
    rows = (column(table, "predictor") == predictor) & (column(table, "metric") == metric)
    part = table.filter(pa.array(rows))
    order = np.lexsort(tuple(column(part, name) for name in reversed(_KEY)))
    return part.take(pa.array(order))


def _apart(stored: pa.Table, scored: pa.Table) -> Bool[np.ndarray, " n"]:
    """Which rows differ by more than rounding."""
    wrong: Bool[np.ndarray, " n"] = np.zeros(len(stored), np.bool_)
    for name in (*FIGURE_COLUMNS, *GAIN_COLUMNS, "action", "pushed"):
        wrong |= _far(*(column(table, name).astype(np.float64) for table in (stored, scored)))
    for name in ("distance", "found", "found_truth", "motion", "command"):
        sizes, others = (
            pc.fill_null(pc.list_value_length(table[name]), 0).to_numpy().astype(np.int64) for table in (stored, scored)
        )
        wrong |= sizes != others
        if np.array_equal(sizes, others):
            left, right = (_flat(table, name) for table in (stored, scored))
            wrong[np.repeat(np.arange(len(sizes)), sizes)[_far(left, right)]] = True
    return wrong


def _flat(table: pa.Table, name: str) -> Any:
    values = table[name].combine_chunks().flatten().to_numpy(zero_copy_only=False)
    return values.astype(np.float64)


def _far(left: Any, right: Any) -> Bool[np.ndarray, " n"]:
    far: Bool[np.ndarray, " n"] = ~np.isclose(left, right, rtol=SAMPLE_ROUNDING, atol=SAMPLE_ROUNDING, equal_nan=True)
    return far


def _same_pictures(check: Findings, mine: list[dict[str, Any]]) -> None:
    said = {identity(picture): picture for picture in check.entry.pictures}
    if not said:
        if mine:
            check.remarks.append("the entry has no pictures")
        return
    if said.keys() != {identity(picture) for picture in mine}:
        check.wrong.append("pictures: of other steps than the data set's")
        return
    for picture in mine:
        one = said[identity(picture)]
        where = f"pictures, episode {picture['episode']}, step {picture['step']}"
        for name in ("action", "pushed"):
            check.expect(f"{where}, {name}", one[name], picture[name])
        for name, rounding in (("current", 0), ("truth", 0), ("predicted", PICTURE_ROUNDING)):
            left, right = (from_png(taken[name]).astype(np.int16) for taken in (one, picture))
            if left.shape != right.shape or np.abs(left - right).max() > rounding:
                check.wrong.append(f"{where}: the frame {name!r} is another")
