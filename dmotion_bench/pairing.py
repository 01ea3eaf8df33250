"""Comparisons of two models by their runs' reports: of a single training each, or of several that differ in the seed.

What is said of a figure is its paired difference (``scoring/differences.py``). Figures that were measured with
different settings are left out: their difference would be that of the settings, too.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import pyarrow.compute as pc

from dmotion_bench.errors import DmbenchError, RunMismatch, RunMissing
from dmotion_bench.learning.runs.manifest import RunSpec
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.decisive import sample_settings
from dmotion_bench.scoring.differences import CONTROL_DISTANCES, PAIRED, Difference, differences, of_model
from dmotion_bench.scoring.report import (
    REPORT_FOLDER,
    TRANSFERS,
    Report,
    read_report,
    read_report_samples,
    report_place,
)
from dmotion_bench.scoring.transfer import report_folder
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.wording import command, shown

_Otherwise = Mapping[str, Sequence[str]]
_Scored = tuple[Report, pa.Table]
_LOG: Final = logging.getLogger(__name__)


def scored(run: Path, folder: Path | None = None, dataset: ReadableDataset | None = None) -> _Scored:
    """A run's report and samples.

    Args:
        run: Its folder.
        folder: Of a report on another data set; its own if left out.
        dataset: What the report must be about, where that is asked.

    Raises:
        RunMissing: The run is not scored, its samples are not those of the report, or it was scored on other data.
    """
    folder = run / REPORT_FOLDER if folder is None else folder
    report = read_report(folder)
    samples = None if report is None else read_report_samples(folder, report)
    there, split = (folder.parent, ("--split", folder.name)) if folder.name in SPLIT_NAMES else (folder, ())
    data = str(dataset.path) if dataset is not None else there.name if there.parent.name == TRANSFERS else None
    score = command("dmbench score", run, *(() if data is None else ("--data", data)), *split)
    if report is None and not _has_ended(run):
        raise RunMissing(
            f"the training of {str(run)!r} has not ended, so it cannot be scored; continue it with the command that "
            "began it, or delete the folder."
        )
    if report is None or samples is None:
        raise RunMissing(f"the run {str(run)!r} has no whole report; score it with {score}.")
    if dataset is not None and report.dataset["fingerprint"] != dataset.fingerprint:
        raise RunMissing(
            f"the report {str(folder)!r} is not of the data set in {str(dataset.path)!r}, but of one with the "
            f"fingerprint {report.dataset['fingerprint'][:12]}; score the run with {score}."
        )
    return report, samples


def _has_ended(run: Path) -> bool:
    """Whether a run is trained to its end; also True of one that cannot be read, which is said elsewhere."""
    try:
        return Run.open(run).result is not None
    except DmbenchError:
        return True


def scored_on(run: Path, dataset: ReadableDataset | None = None, split: SplitName = "test") -> _Scored:
    """A run's report on a data set, its own (also by None) or another, and the samples.

    Raises:
        RunMissing: There is none, or it is of weights that the run no longer has.
        RunCorrupt: The run, or a report on a data set of the same name, cannot be read.
    """
    trained = Run.open(run)
    place = report_place(None, split)
    folder = run / place if dataset is None else report_folder(run, trained.spec.fingerprint, dataset, split)
    found, samples = scored(run, folder, dataset)
    if trained.result is not None and trained.result["weights"] != found.weights:
        again = command("dmbench score", run, *(() if dataset is None else ("--data", str(dataset.path))))
        raise RunMissing(f"the report of {str(run)!r} is of an earlier training; score the run with {again}.")
    return found, samples


def compare_runs(
    first: Path | Sequence[Path],
    second: Path | Sequence[Path],
    dataset: ReadableDataset | None = None,
    split: SplitName = "test",
    *,
    warn: Callable[[str], None] = _LOG.warning,
) -> list[Difference]:
    """Every figure of two models that can be paired, in the report's order.

    Args:
        first, second: The folder of a run, or of several that differ in their seed alone: their mean is compared.
        dataset: What all were scored on; each one's own data set if left out.
        split: Whose episodes all were scored on.
        warn: Told in a sentence which figures are left out, since they were measured with different settings, and
            which are of a part of a run's samples alone.

    Raises:
        RunMissing: One of them is not scored.
        RunMismatch: Trainings of one model differ in more than their seed, or have the same weights, or runs were not
            scored on the same triplets, or all that they have in common with different settings.
    """
    models = [[scored_on(run, dataset, split) for run in trainings_of(one)] for one in (first, second)]
    for own in models:
        _require_several(own)
    told, left_out = _left_out(models)
    tables = [[_without(of_model(samples), left_out) for _, samples in own] for own in models]
    found = list(differences(*tables))
    told += _in_part([report.run for own in models for report, _ in own], [one for own in tables for one in own])
    if told and not found:
        raise RunMismatch(" ".join(told))
    for sentence in told:
        warn(sentence)
    return found


def _in_part(runs: Sequence[str], tables: Sequence[pa.Table]) -> list[str]:
    """Of which metrics some runs have more samples than others, in sentences: figures are then not those of reports."""
    told = []
    for metric in PAIRED:
        sizes = [pc.sum(pc.equal(samples["metric"], metric)).as_py() or 0 for samples in tables]
        (least, fewer), *_, (most, more) = sorted(zip(sizes, runs, strict=True))
        if least < most:
            told.append(
                f"{more!r} has more samples of {metric} than {fewer!r}; only those that all have are compared, so that "
                "figures differ from its report."
            )
    return told


def _left_out(models: Sequence[Sequence[_Scored]]) -> tuple[list[str], list[str]]:
    """Why some figures cannot be compared, in sentences, and the metrics of their samples.

    Raises:
        RunMismatch: Runs were not scored on the same triplets.
    """
    (one, one_samples), *others = [scored for own in models for scored in own]
    told, metrics = dict[str, None](), list[str]()
    for other, other_samples in others:
        _require_same_triplets(one, other)
        for why, apart in _measured_otherwise(one, one_samples, other, other_samples).items():
            if new := [metric for metric in apart if metric not in metrics]:
                told[
                    f"{' and '.join(new)} of {one.run!r} and {other.run!r} are not compared: {why}; score both again "
                    "with the same settings."
                ] = None
                metrics += new
    measured = [[set(pc.unique(samples["metric"]).to_pylist()) for _, samples in own] for own in models]
    for metric in PAIRED:
        has = [[metric in own for own in each] for each in measured]
        if any(map(any, has)) and not all(map(all, has)):
            lacking = next(
                report.run
                for own, has_it in zip(models, has, strict=True)
                for (report, _), there in zip(own, has_it, strict=True)
                if not there
            )
            told[f"{lacking!r} has no figures of {metric}, as others have; score it for them, too."] = None
            metrics.append(metric)
    return list(told), metrics


def trainings_of(given: Path | Sequence[Path]) -> list[Path]:
    """The folders of a model's trainings.

    Raises:
        RunMismatch: They differ in more than their seed, or two have the same seed.
        RunCorrupt: One of them cannot be read.
    """
    runs = [given] if isinstance(given, Path) else list(given)
    specs = [Run.open(run).spec for run in runs] if len(runs) > 1 else []
    for run, spec in zip(runs[1:], specs[1:], strict=False):
        alike = replace(spec, seed=specs[0].seed)
        if not _same(alike, specs[0]):
            names = [
                field.name for field in fields(spec) if getattr(alike, field.name) != getattr(specs[0], field.name)
            ]
            raise RunMismatch(
                f"{str(runs[0])!r} and {str(run)!r} are no trainings of one model: they differ in {', '.join(names)}. "
                "Trainings whose mean is compared differ in their seed alone."
            )
    seeds = Counter(spec.seed for spec in specs)
    if twice := [seed for seed, count in seeds.items() if count > 1]:
        raise RunMismatch(f"several of the trainings have the seed {twice[0]}; each training is named once.")
    return runs


def _require_several(trainings: Sequence[_Scored]) -> None:
    """No two of a model's trainings have the same weights, whatever their seeds are said to be.

    Raises:
        RunMismatch: Two have.
    """
    known: dict[str, str] = {}
    for report, _ in trainings:
        if report.weights in known:
            raise RunMismatch(
                f"{known[report.weights]!r} and {report.run!r} have the same weights, so they are one training; "
                "name it once."
            )
        known[report.weights] = report.run


def _same(one: RunSpec, other: RunSpec) -> bool:
    """Whether two specs say the same, also where an earlier version left out settings at their defaults."""
    if one == other:
        return True
    try:
        return one.completed() == other.completed()
    except DmbenchError:  # a model that is not installed, or of another version
        return False


def _require_same_triplets(one: Report, other: Report) -> None:
    """Both were scored on the same triplets.

    Raises:
        RunMismatch: They were not.
    """
    for what, left, right in (
        ("data sets", *map(_dataset, (one, other))),
        ("splits", one.settings["split"], other.settings["split"]),
        ("kinds of split", one.settings["protocol"], other.settings["protocol"]),
    ):
        if left != right:
            raise RunMismatch(
                f"{one.run!r} and {other.run!r} were scored on different {what}: {left} and {right}. Only runs that "
                "were scored on the same frames are compared."
            )


def _dataset(report: Report) -> str:
    """What a report was scored on: the data set's name, and the beginning of its hash."""
    return f"{shown(report.dataset['name'])} ({report.dataset['fingerprint'][:12]})"


def _measured_otherwise(one: Report, one_samples: pa.Table, other: Report, other_samples: pa.Table) -> _Otherwise:
    """By the settings that differ, the metrics that both reports have and whose samples these settings decide."""
    both = set(pc.unique(one_samples["metric"]).to_pylist()) & set(pc.unique(other_samples["metric"]).to_pylist())
    found: dict[str, list[str]] = {}
    for metric in PAIRED:
        mine, theirs = (_decisive(metric, report) for report in (one, other))
        if metric in both and mine != theirs:
            found.setdefault(_apart(mine, theirs), []).append(metric)
    return found


def _decisive(metric: str, report: Report) -> dict[str, Any]:
    """What decides a report's samples of a metric; control has a version of its own among its settings."""
    version = {} if metric in CONTROL_DISTANCES else {"scoring_version": report.scoring_version}
    return version | sample_settings(metric, report.settings)


def _apart(first: Mapping[str, Any], second: Mapping[str, Any]) -> str:
    """The settings that differ, in words."""
    differing = (name for name in {**first, **second} if first.get(name) != second.get(name))
    return ", ".join(
        f"{name} is {shown(first.get(name))} of the first and {shown(second.get(name))} of the second"
        for name in differing
    )


def _without(samples: pa.Table, metrics: Sequence[str]) -> pa.Table:
    return samples.filter(pc.invert(pc.is_in(samples["metric"], pa.array(metrics, pa.string()))))
