"""A run's report on disk: ``report/report.json`` and, beside it, the samples that its figures are made of.

::

    report.json
      protocol       what the figures' names mean: "dmbench-1"; where a column planned control the column's
      scoring_version  of the code that scores (SCORING_VERSION)
      run, model, arch, preset, seed
      labels         asked for, and the number handed out by purpose; use: where they were not used as is usual
                     (label_use.py)
      dataset        name, environment, fingerprint (the hash of its content); version: of the environment, where it
                     is not 1; actions: "continuous" or "joint", where they are; trained_on: name and fingerprint of
                     the run's own, where it is scored on another (transfer.py)
      weights        the hash of the weights
      settings       split, horizon, precision ...; metrics: what has been scored so far; of control its version, too
      planning       of control: the planner and the cost, every field and every constant, and the arithmetic
      training       what the run cost; threads: that trained it, and scored it
      versions       of Python and the packages; "torch (control)": that a group of figures was scored with, where it
                     was kept from an earlier scoring with another version
      figures        name -> mean, std, low, high, n, episodes; without the last in older reports
      reference      the same for predictors that know nothing, and published results, by their names
      remarks        what to bear in mind of each reference, and what could not be scored
      samples        file, rows and hash of samples.parquet

A killed process may leave its samples as ``samples-new.parquet`` (``write_report``).

Until version 1 a report held hashes of the code instead, which any change of a comment changed: ``code`` of the code
that scores, and ``control_code`` among the settings of the code that plans. ``SCORING_OF_CODE``
and ``CONTROL_OF_CODE`` say which versions the published hashes are; any other is an earlier version without a number.
"""

from __future__ import annotations

import hashlib
import json
import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from types import MappingProxyType
from typing import Any, Final

import pyarrow as pa

from dmotion_bench.errors import RunCorrupt
from dmotion_bench.planning.columns import COLUMNS, column_named
from dmotion_bench.scoring.samples import read_samples, write_samples
from dmotion_bench.scoring.statistics import FEWEST_EPISODES
from dmotion_bench.storage.atomic import sync_folder, write_atomically
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.json_file import JsonUnreadable, read_json
from dmotion_bench.storage.lock import held
from dmotion_bench.wording import shown

PROTOCOL = "dmbench-1"
"""Of all reports but those whose control was planned by a column, which have the column's."""

PROTOCOLS: Final = (PROTOCOL, *sorted({one.protocol for one in COLUMNS.values()}))
CONTRACT: Final = "contract"
"""The remark of a model that breaks its contract; its row is neither the best of a board nor tied with the best."""

SCORING_VERSION: Final = 1
"""The version of scoring: of the samples of predictions, of their figures and intervals.

Raise it when a change gives another figure, beyond rounding, of the same model on the same data. ``tests/golden/
scoring.json`` holds figures to notice that by. A report of another version is scored again. A figure that is new and
leaves the others as they are needs no new version, nor does an interval that is no longer given, or one that has got a
width where all samples are alike.
"""

SCORING_OF_CODE: Final[Mapping[str, int]] = MappingProxyType({"0.1.0+f4b222bec15f": 1})
CONTROL_OF_CODE: Final[Mapping[str, int]] = MappingProxyType({"0.1.0+4fa30b762c67": 1})
"""The versions of published results that name a hash of the code."""

Version = int | str
"""A number; of earlier versions without a number the hash of their code."""

LABEL_USES: Final[Mapping[str, str]] = MappingProxyType(
    {
        "during": "few labels during the training",
        "clustered": "its labels name clusters",
        "finetuned": "fine-tuned on its labels",
        "during, clustered": "few labels during the training, its labels name clusters",
        "during, finetuned": "few labels during the training, fine-tuned on its labels",
    }
)
"""All values of ``labels.use``, and what is written for them."""

LATER_TRAINING: Final = ("threads", "precision")
"""What is said of a training, and was not said in the first reports of this version."""
TRAINING: Final = (
    *("seconds", "steps", "triplets", "triplets_per_s", "parameters", "device", "processes"),
    *LATER_TRAINING,
)
"""What is said of a training."""

REPORT_FOLDER = "report"
REPORT_FILE = "report.json"
TRANSFERS = "on"
"""Folder in a run's report for those on other data sets, a folder each."""
SAMPLES_FILE = "samples.parquet"
_OVER_STEPS: Final = ("rollout_", "control_distance", "control_picture_distance")
"""How the names begin of figures that there are of each step."""
_STEP: Final = re.compile(r"\[\d{1,9}\]$")
_WAITING = "samples-new.parquet"
"""New samples, until the report that holds their hash is written."""

FigureJson = Mapping[str, float | int | None]


@dataclass(frozen=True, kw_only=True)
class Report:
    """The report of one run; its fields are those of the file.

    Attributes:
        run, model, arch, preset, seed: What was scored.
        labels: ``asked``, the budget, and ``total``, how many labels the run was given.
        dataset: ``name``, ``environment`` and ``fingerprint`` of what it was scored on; ``trained_on`` where the run's
            own is another.
        weights: SHA-256 of the weights.
        settings: Of the scoring: ``split``, ``horizon``, ``precision`` and others; ``metrics``, the groups of figures.
        training: What the training cost: ``seconds``, ``steps``, ``parameters`` and others.
        versions: Of Python and the packages that scored it.
        figures: By name: ``mean``, ``std``, ``low`` and ``high``, the bounds of the 95% interval over episodes, which
            are None of fewer than five episodes, ``n``, the number of samples, and ``episodes``.
        reference: The same for predictors that know nothing, by their names, such as ``copy_last``.
        remarks: By the name of a reference what to bear in mind of it, and what could not be scored.
        protocol: What the figures' names mean.
        scoring_version: Of the code that scored.
        planning: Of control: the planner and the objective, with all of their settings.
        samples: ``file``, ``rows`` and ``sha256`` of what the figures are made of.
    """

    run: str
    model: str
    arch: str
    preset: str
    seed: int
    labels: Mapping[str, Any]
    dataset: Mapping[str, Any]
    weights: str
    settings: Mapping[str, Any]
    training: Mapping[str, Any]
    versions: Mapping[str, str]
    figures: Mapping[str, FigureJson]
    reference: Mapping[str, Mapping[str, FigureJson]]
    remarks: Mapping[str, str] = field(default_factory=dict)
    protocol: str = PROTOCOL
    scoring_version: Version = SCORING_VERSION
    planning: Mapping[str, Any] = field(default_factory=dict)
    samples: Mapping[str, Any] = field(default_factory=dict)

    def __repr__(self) -> str:
        scored = ", ".join(self.settings["metrics"])
        return f"<Report of {self.run!r} on {self.dataset['name']!r}, {self.settings['split']}: {scored}>"

    @property
    def trained_on(self) -> str | None:
        """The name of the run's own data set, where it was scored on another."""
        own = self.dataset.get("trained_on")
        return None if own is None else str(own["name"])

    @property
    def frames(self) -> tuple[str, ...]:
        """What decides which frames it is about: the data set, the part of it, and how it was split."""
        return str(self.dataset["fingerprint"]), str(self.settings["split"]), str(self.settings.get("protocol"))

    @property
    def place(self) -> Path:
        """The report's path within the run's folder."""
        elsewhere = None if self.trained_on is None else str(self.dataset["name"])
        return report_place(elsewhere, self.settings["split"], self.column)

    @property
    def column(self) -> str | None:
        """The column of the table of control that planned; None of all other reports."""
        name = self.settings.get("control_column")
        return None if name is None else str(name)

    def summary(self) -> dict[str, Any]:
        """What ``dmbench score --json`` prints of a report."""
        elsewhere = {} if self.trained_on is None else {"trained_on": self.trained_on}
        return elsewhere | {
            "run": self.run,
            "model": self.model,
            "arch": self.arch,
            "dataset": self.dataset["name"],
            "labels": self.labels["asked"],
            "seed": self.seed,
            "figures": self.figures,
            "reference": self.reference,
        }


def protocol_of(column: str | None) -> str:
    """The protocol of a report whose control this column planned, or none of them.

    Raises:
        UnknownName: There is no such column.
    """
    return PROTOCOL if column is None else column_named(column).protocol


def training_facts(result: Mapping[str, Any]) -> dict[str, Any]:
    """What a report says of a training that came to this result; earlier trainings did not take down everything."""
    return {name: result[name] for name in TRAINING if result.get(name) is not None}


def report_place(dataset: str | None, split: str = "test", column: str | None = None) -> Path:
    """The path of a report within its run's folder.

    Args:
        dataset: The name of what it is about; None: the run's own.
        split: Whose episodes were scored; those of the test have the plain place.
        column: Of the table of control, whose tasks are of no split.
    """
    own = Path(REPORT_FOLDER)
    there = own if dataset is None else own / TRANSFERS / Path(dataset).name
    if column is not None:
        return there / Path(column).name
    return there if split == "test" else there / Path(split).name


def why_no_interval(figures: Iterable[FigureJson]) -> str | None:
    """In words that some figures are of too few episodes for an interval; None where none is."""
    known = {figure.get("episodes") for figure in figures if figure["low"] is None}
    few = sorted(int(count) for count in known if count is not None and count < FEWEST_EPISODES)
    if not few:
        return None
    return f"too few episodes for an interval: {' or '.join(map(str, few))}, it takes {FEWEST_EPISODES}"


def write_report(folder: Path, report: Report, samples: pa.Table) -> Report:
    """Write the samples and the report with their hash.

    The new samples wait under a name of their own until the new report is written, and then replace the old ones. So
    a process that is killed leaves the old report with its samples, or the new one with its own.
    """
    folder.mkdir(parents=True, exist_ok=True)
    settle_samples(folder)
    waiting = folder / _WAITING
    write_samples(waiting, samples)
    known = {field.name: getattr(report, field.name) for field in fields(report)}
    known["samples"] = {"file": SAMPLES_FILE, "rows": len(samples), "sha256": _sha256(waiting)}
    complete = Report(**known)
    content = json.dumps({"protocol": PROTOCOL} | known, indent=2, ensure_ascii=False, allow_nan=False) + "\n"
    write_atomically(folder / REPORT_FILE, content.encode())
    waiting.replace(folder / SAMPLES_FILE)
    sync_folder(folder)
    return complete


def settle_samples(folder: Path) -> None:
    """Finish what a process that was killed began; for the one that holds the folder's lock.

    Samples that wait take the place of the old ones if the report is theirs; if not, they are deleted.

    Raises:
        RunCorrupt: The report cannot be read.
    """
    waiting = folder / _WAITING
    if not waiting.is_file():
        return
    report = read_report(folder)
    if report is not None and samples_path(folder, report.samples["sha256"]) == waiting:
        waiting.replace(folder / SAMPLES_FILE)
        sync_folder(folder)
    else:
        waiting.unlink()


def settled(folder: Path) -> Path:
    """The folder, after ``settle_samples`` where a killed process left something; for readers of whole folders.

    Raises:
        FolderInUse: A report is being written there.
        RunCorrupt: The report cannot be read.
    """
    if (folder / _WAITING).is_file():
        with held(folder):
            settle_samples(folder)
    return folder


def samples_path(folder: Path, sha256: str | None) -> Path:
    """The file of a report's samples: ``samples.parquet``, or after a kill perhaps the one that still waits."""
    waiting = folder / _WAITING
    return waiting if waiting.is_file() and _sha256(waiting) == sha256 else folder / SAMPLES_FILE


def read_report(folder: Path) -> Report | None:
    """The report of a folder; None if there is none, or one that another version of dmbench wrote.

    Raises:
        RunCorrupt: It cannot be read.
    """
    path = folder / REPORT_FILE
    try:
        stored = read_json(path)
    except (FileNotFoundError, NotADirectoryError):
        return None
    except (JsonUnreadable, OSError) as error:
        raise _unreadable(path, error) from None
    if "code" in stored:
        stored = _with_versions(stored)
    names = {field.name for field in fields(Report)}
    if stored.get("protocol") not in PROTOCOLS or set(stored) != names:
        return None
    try:
        _require_fields(Fields(stored, "report"))
    except ValueError as error:
        raise _unreadable(path, error) from None
    return Report(**stored)


def _unreadable(path: Path, why: Exception) -> RunCorrupt:
    return RunCorrupt(f"the report {str(path)!r} cannot be read ({why}); delete it and score the run again.")


def _require_fields(report: Fields) -> None:
    """See that the fields that commands use are there and of their kinds.

    Raises:
        ValueError: One is not; says which.
    """
    for name in ("run", "model", "arch", "preset", "weights"):
        report.text(name)
    for name in ("training", "versions", "planning"):
        report.pairs(name)
    planning = report.inner("planning")
    for name in ("planner", "cost", "solver", "objective"):
        if name in report.pairs("planning"):
            planning.pairs(name)
    report.whole("seed")
    labels, dataset, settings = (report.inner(name) for name in ("labels", "dataset", "settings"))
    labels.text("asked")
    labels.whole("total")
    if "use" in report.pairs("labels") and labels.text("use") not in LABEL_USES:
        raise ValueError(f"labels.use is {shown(labels.text('use'))}, none of {', '.join(map(repr, LABEL_USES))}")
    settings.whole("horizon")
    settings.texts("metrics")
    for name in ("split", "protocol"):
        settings.text(name)
    trained_on = dataset.inner("trained_on") if "trained_on" in report.pairs("dataset") else dataset
    for name in ("name", "fingerprint"):
        dataset.text(name)
        trained_on.text(name)
    report.inner("samples").text("sha256")
    remarks, reference = report.inner("remarks"), report.inner("reference")
    for name in report.pairs("remarks"):
        remarks.text(name)
    for holder, of_whom in ((report, "figures"), *((reference, name) for name in report.pairs("reference"))):
        figures = holder.inner(of_whom)
        for name in holder.pairs(of_whom):
            if name.startswith(_OVER_STEPS) and not _STEP.search(name):
                raise ValueError(
                    f"{shown(f'report.{of_whom}.{name}')} does not end in the number of a step in brackets"
                )
            figure = figures.inner(name)
            figure.whole_or_none("n")
            if "episodes" in figures.pairs(name):
                figure.whole_or_none("episodes")
            for part in ("mean", "std", "low", "high"):
                figure.real_or_none(part)


def read_report_samples(folder: Path, report: Report) -> pa.Table | None:
    """The samples that belong to a report; None if they are missing or have another hash."""
    sha256 = report.samples.get("sha256")  # none in a report that was never written
    path = samples_path(folder, sha256)
    if not path.is_file() or _sha256(path) != sha256:
        return None
    return read_samples(path)


def _with_versions(stored: Mapping[str, Any]) -> dict[str, Any]:
    """A report that names hashes of the code, with versions in their place."""
    versioned = {name: value for name, value in stored.items() if name != "code"}
    settings = stored.get("settings")
    if isinstance(settings, dict) and "control_code" in settings:
        others = {name: value for name, value in settings.items() if name != "control_code"}
        code = settings["control_code"]
        versioned["settings"] = others | {"control_version": CONTROL_OF_CODE.get(code, code)}
    code = stored["code"]
    return {"scoring_version": SCORING_OF_CODE.get(code, code), "planning": {}} | versioned


def _sha256(path: Path) -> str:
    with path.open("rb") as handle:
        return hashlib.file_digest(handle, "sha256").hexdigest()
