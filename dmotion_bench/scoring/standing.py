"""What of a run's report is still true: the groups of figures that scoring now would give again."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import pyarrow as pa
import pyarrow.compute as pc

from dmotion_bench.errors import DmbenchError, InvalidSetting, RunCorrupt, UnknownName
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.earlier_planning import present_planning, present_settings
from dmotion_bench.scoring.gain import GainScoring
from dmotion_bench.scoring.report import SCORING_VERSION, Report, read_report, read_report_samples
from dmotion_bench.scoring.samples import PICTURE_CONTROL, SCHEMA
from dmotion_bench.scoring.settings import METRICS, OWN_SETTINGS, ScoreSettings
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shown

_SettingsT = TypeVar("_SettingsT")


def standing_report(folder: Path, run: Run, dataset: Dataset) -> tuple[Report | None, pa.Table]:
    """The report of a folder with its samples, if it is of these weights on this data."""
    report = read_report(folder)
    if report is not None and run.result is not None:
        same = report.weights == run.result["weights"] and report.dataset["fingerprint"] == dataset.fingerprint
        samples = read_report_samples(folder, report) if same else None
        if samples is not None:
            return report, samples
    return None, SCHEMA.empty_table()


def samples_of(samples: pa.Table, metrics: Collection[str]) -> pa.Table:
    """The samples of some groups of figures."""
    names = {*metrics, *((PICTURE_CONTROL,) if "control" in metrics else ())}
    return samples.filter(pc.is_in(samples["metric"], pa.array(sorted(names), pa.string())))


def with_standing(settings: ScoreSettings, report: Report, metrics: tuple[str, ...]) -> ScoreSettings:
    """Take the settings of groups that are not asked for from the report.

    Raises:
        DmbenchError: It holds control or a gain by a planner or an objective that is not installed.
        RunCorrupt: It holds settings that cannot be.
    """
    if "rollout" not in metrics:
        settings = replace(settings, horizon=report.settings["horizon"])
    if "gain" not in metrics and "gain" in report.settings["metrics"]:
        settings = replace(settings, gain=_settings_of(report, "the gain captured", GainScoring.from_json))
    if "control" not in metrics and "control" in report.settings["metrics"]:
        settings = replace(settings, control=_settings_of(report, "control", ControlScoring.from_json))
    return settings


def _settings_of(report: Report, what: str, read: Callable[[Mapping[str, Any]], _SettingsT]) -> _SettingsT:
    """The settings of a group of a report's figures."""
    try:
        return read(report.settings)
    except UnknownName as error:
        raise DmbenchError(
            f"the run's report holds {what} by what is not installed here: {error} Install the package that "
            "brings it, or move the report away to begin another."
        ) from None
    except (InvalidSetting, KeyError, TypeError, ValueError, AttributeError) as error:
        why = f"{error.args[0]!r} is missing" if isinstance(error, KeyError) else str(error).rstrip(".")
        raise RunCorrupt(
            f"the report of {shown(report.run)} holds {what} by settings that cannot be ({why}); move the report away "
            "and score the run again."
        ) from None


def planning_of(run: Run, dataset: Dataset, settings: ScoreSettings) -> dict[str, Any]:
    """What decides a run's control beside its settings, as a report says it (``ControlScoring.planning``)."""
    return settings.control.planning(dataset, needs_pixels=run.model.needs_pixels)


def true_groups(
    run: Run, dataset: Dataset, report: Report, settings: ScoreSettings, asked: Collection[str]
) -> tuple[str, ...]:
    """The groups of a report's figures that scoring now would give again.

    Control is taken for one of them where its environment, which has a say in it, is not installed and it is not asked
    for.
    """
    planning: dict[str, Any] = {}
    if "control" in report.settings["metrics"]:
        try:
            planning = planning_of(run, dataset, settings)
        except UnknownName:
            if "control" in asked:
                raise
    return tuple(name for name in report.settings["metrics"] if _is_true(name, report, settings, planning))


def versions_with(report: Report, kept: Collection[str], present: Mapping[str, str]) -> dict[str, str]:
    """The present versions and, of groups that a report keeps from earlier, what differs: ``torch (control)``.

    Args:
        report: The earlier one, which may itself hold groups of several versions.
        kept: The groups of figures that are taken from it.
        present: Of the packages that score the others now.
    """
    told = dict(present)
    plain = {name: version for name, version in report.versions.items() if not name.endswith(")")}
    for group in kept:
        mark = f" ({group})"
        own = {name.removesuffix(mark): one for name, one in report.versions.items() if name.endswith(mark)}
        told |= {f"{name}{mark}": one for name, one in (plain | own).items() if one != present.get(name)}
    return told


def _is_true(metric: str, report: Report, settings: ScoreSettings, planning: Mapping[str, Any]) -> bool:
    """Whether a report's figures of one group are those that scoring now would give."""
    said = settings.to_json(METRICS)
    others = {"metrics", *(() if metric == "rollout" else ("horizon",))}
    owner = {name: next((one for one in OWN_SETTINGS if name.startswith(f"{one}_")), None) for name in said}
    mine = metric if metric in OWN_SETTINGS else None
    shared = ("split",) if metric == "gain" else ()
    decisive = [name for name in said if (owner[name] == mine or name in shared) and name not in others]
    if metric == "control":  # its version is among its settings; reports of before that hold no solver
        said_of = present_planning(report.planning)
        same = not said_of or all(said_of.get(name) == one for name, one in planning.items())
    else:
        same = report.scoring_version == SCORING_VERSION
    stored = present_settings(report.settings)
    return same and all(said[name] == stored.get(name) for name in decisive)
