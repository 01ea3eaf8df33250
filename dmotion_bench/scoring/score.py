"""Compute the figures of a trained model, and write the report of a run."""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import torch

from dmotion_bench.entry_points import MODELS, is_built_in
from dmotion_bench.errors import InvalidSetting, RunMismatch, RunMissing
from dmotion_bench.learning.data.triplets import SplitProtocol
from dmotion_bench.learning.hardware.memory import keep_freed_memory
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.agents import REFERENCES as CONTROL_REFERENCES
from dmotion_bench.planning.columns import column_named, require_fitting_tasks, words_of_test
from dmotion_bench.planning.contract import using
from dmotion_bench.planning.dynamics.model import arithmetic_on
from dmotion_bench.scoring.control import require_tasks
from dmotion_bench.scoring.earlier_planning import present_planning
from dmotion_bench.scoring.explanation import explain_steps
from dmotion_bench.scoring.figures import Figures, figures_of
from dmotion_bench.scoring.gain import gain_tables, reason_after_trying, reason_against, require_gain
from dmotion_bench.scoring.kept_control import shares_of
from dmotion_bench.scoring.latent_models import LatentActionModel
from dmotion_bench.scoring.latent_ranking import can_roll_out
from dmotion_bench.scoring.latent_samples import learned_from_video, score_latent_actions, with_latent_actions
from dmotion_bench.scoring.prediction import (
    MODEL,
    Execution,
    predicting,
    score_reference_rollouts,
    score_reference_steps,
    score_rollouts,
    score_steps,
)
from dmotion_bench.scoring.reference_control import control_tables
from dmotion_bench.scoring.references import REFERENCES
from dmotion_bench.scoring.report import (
    CONTRACT,
    Report,
    read_report,
    settle_samples,
    write_report,
)
from dmotion_bench.scoring.run_report import compose_report
from dmotion_bench.scoring.samples import SCHEMA, require_readable
from dmotion_bench.scoring.settings import DEFAULT_METRICS, OWN_SETTINGS, Metric, ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.scoring.soundness import unsound_prediction
from dmotion_bench.scoring.standing import (
    planning_of,
    samples_of,
    standing_report,
    true_groups,
    versions_with,
    with_standing,
)
from dmotion_bench.scoring.transfer import report_folder, transferable
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.atomic import remove_leftovers
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import held
from dmotion_bench.workspace import AnyPath, cache_folder

CONTROL_JOURNAL = "control.json"
"""The file of a report's folder in which an unfinished control keeps how far it is."""

BESIDE = (*REFERENCES, *CONTROL_REFERENCES)


@dataclass(frozen=True, kw_only=True)
class Scores:
    """The results of scoring a model.

    Attributes:
        samples: As ``scoring/samples.py`` lays them out.
        figures: Of the model.
        reference: Of the predictors that know nothing.
    """

    samples: pa.Table
    figures: Figures
    reference: Mapping[str, Figures]


def score_model(
    model: ForwardModel[Any],
    dataset: Dataset,
    *,
    metrics: tuple[Metric, ...] = DEFAULT_METRICS,
    settings: ScoreSettings | None = None,
    how: Execution | None = None,
    shared: SharedSamples | None = None,
    earlier: pa.Table | None = None,
    journal: Path | None = None,
) -> Scores:
    """Score a model on held-out episodes.

    One that draws no frames (``needs_pixels``) has none to compare, but the states of its rollouts if it has any.

    Args:
        model: Aligned, in evaluation mode.
        dataset: With labels; of one whose actions are not known, see ``explanation.py``.
        metrics: Which groups of figures.
        settings: What decides the figures.
        how: Batch size, device, progress; the frames of one batch are in memory, and one episode's labels.
        shared: Keeps what other runs have in common with this one, for the next model of this process.
        earlier: Samples of groups that are not asked for now; kept.
        journal: A file in which control keeps how far it is, to go on from there after an interruption.

    Raises:
        InvalidSetting: No episode is long enough for rollouts of another length than the usual one.
    """
    settings, how = settings or ScoreSettings(), how or Execution()
    shared = shared or SharedSamples()
    model = model.to(how.device).laid_out().eval()
    keep_freed_memory()
    if dataset.spec.actions is None:
        with predicting(how.device, settings.precision):
            return _scores(explain_steps(model, dataset, settings.split, settings.protocol, how), settings)
    held_out = HeldOut(dataset, settings.split, settings.protocol)
    if not model.needs_pixels:
        others = (*OWN_SETTINGS, "rollout") if can_roll_out(model) else OWN_SETTINGS
        metrics = tuple(metric for metric in metrics if metric in others)
    triplets = len(held_out) if "prediction" in metrics else 0
    rollouts = held_out.count_rollouts(settings.horizon) if "rollout" in metrics else 0
    if "rollout" in metrics and not rollouts and settings.horizon != ScoreSettings.horizon:
        raise InvalidSetting(
            f"no {settings.split} episode of {dataset.name!r} has the frames for a rollout of {settings.horizon} "
            f"steps; ask for at most {max(1, held_out.longest_rollout)}."
        )
    require_readable((1 + len(REFERENCES)) * triplets + 2 * settings.horizon * rollouts)
    identity = {
        "dataset": dataset.fingerprint,
        "actions": str(dataset.spec.actions),
        "split": settings.split,
        "protocol": settings.protocol,
        "batch_size": how.batch_size,  # decides the order of the rows
        "device": how.device.type,
        "threads": torch.get_num_threads(),
    }
    tables, cache = [] if earlier is None else [earlier], cache_folder(dataset.path)
    with predicting(how.device):
        if "prediction" in metrics:
            tables.append(shared.get(identity, lambda: score_reference_steps(held_out, how), cache))
        if "rollout" in metrics and model.needs_pixels:
            key, horizon = identity | {"horizon": settings.horizon}, settings.horizon
            tables.append(shared.get(key, lambda: score_reference_rollouts(held_out, how, horizon=horizon), cache))
    with predicting(how.device, settings.precision):
        if "prediction" in metrics:
            steps = score_steps(model, held_out, how)
            if isinstance(model, LatentActionModel):
                mine = identity | learned_from_video(model) | {"precision": settings.precision}
                latent = shared.latest(mine, lambda: score_latent_actions(model, held_out, how))
                steps = with_latent_actions(steps, latent)
            tables.append(steps)
        if "rollout" in metrics:
            tables.append(score_rollouts(model, held_out, how, horizon=settings.horizon))
    if "gain" in metrics:
        with predicting(how.device):
            tables += gain_tables(model, dataset, settings.split, settings.gain, how)
    if "control" in metrics:
        tables += control_tables(model, dataset, settings.control, how, journal, sum(map(len, tables)))
    return _scores(pa.concat_tables(tables) if tables else SCHEMA.empty_table(), settings)


def _scores(samples: pa.Table, settings: ScoreSettings) -> Scores:
    found = {name: figures_of(samples, name, resamples=settings.resamples) for name in (MODEL, *BESIDE)}
    return Scores(
        samples=samples,
        figures=found[MODEL],
        reference={name: found[name] for name in BESIDE if found[name]},
    )


def contract_remark(run: Run, dataset: Dataset) -> str | None:
    """The remark that a run's predictions break the contract of models; None if they keep it, or the model is ours."""
    unsound = None if is_built_in(MODELS, run.spec.model) else unsound_prediction(run.model, dataset)
    return None if unsound is None else f"the model breaks it: {unsound}"


def score_run(
    path: AnyPath,
    *,
    metrics: tuple[Metric, ...] | None = DEFAULT_METRICS,
    settings: ScoreSettings | None = None,
    how: Execution | None = None,
    shared: SharedSamples | None = None,
    renew: bool = True,
    data: AnyPath | None = None,
) -> Report:
    """Score a run on the held-out episodes of its data set, or of another one, and write its report.

    It computes with as many threads as the training: another number rounds otherwise
    (``learning/hardware/threads.py``).
    Groups of figures that are not asked for stay in the report while they are true: same weights, data, settings and
    version; of control the same solver and objective, too.

    Args:
        metrics: Which groups of figures; None for all but control that the data set can have.
        renew: Whether to score again what the report already holds.
        data: Another data set of the same environment, or an import, see ``transfer.py``; the run's own if left out.
            The other arguments are ``score_model``'s.

    Raises:
        RunMissing, RunCorrupt: There is no trained run at this path.
        RunMismatch: The data set has changed since the run was trained on it, or the other one does not fit the run.
        DatasetMissing: The other one is an import, and the data set of the training is not there.
        LabelsNotAvailable: Nothing says what the actions do in the model; or as ``score_model`` raises it.
        DatasetError, LabelsNotAvailable: Control is asked for where it cannot be scored.
        InvalidSetting: A setting of the planner does nothing with the environment's actions.
        UsageError: The run's number of threads is not allowed here.
        FolderInUse: Another process scores the run.
    """
    run, settings = Run.open(path), settings or ScoreSettings()
    dataset, folder = scored_data(run, settings.split, data, settings.control.column)
    is_usual = metrics is None
    metrics, settings, lacking = _asked(run, dataset, metrics, settings)
    folder.mkdir(parents=True, exist_ok=True)
    with held(folder):
        remove_leftovers(folder)
        settle_samples(folder)
        report, samples = standing_report(folder, run, dataset)
        true: tuple[str, ...] = ()
        if report is not None:
            settings = with_standing(settings, report, metrics)
            true = true_groups(run, dataset, report, settings, metrics)
            if not renew and set(metrics) <= set(true):
                return report
        metrics = metrics if renew else tuple(metric for metric in metrics if metric not in true)
        if is_usual and "gain" in metrics:
            lacking = reason_after_trying(dataset, settings.split, settings.gain, how or Execution())
            metrics = tuple(metric for metric in metrics if metric != "gain" or lacking is None)
        is_ours = is_built_in(MODELS, run.spec.model)
        own = contextlib.nullcontext() if is_ours else using(run.model)
        with using_threads(run.threads), own:
            scores = score_model(
                run.model,
                dataset,
                metrics=metrics,
                settings=settings,
                how=how,
                shared=shared,
                earlier=samples_of(samples, set(true) - set(metrics)),
                journal=(journal := folder / CONTROL_JOURNAL),
            )
            unsound = contract_remark(run, dataset)
        groups = tuple(dict.fromkeys((*true, *metrics)))
        scored = compose_report(run, dataset, scores.figures, scores.reference, settings.to_json(groups))
        if report is not None:
            kept = [name for name in true if name not in metrics]
            scored = replace(scored, versions=versions_with(report, kept, scored.versions))
        if unsound is not None:
            scored = replace(scored, remarks={**scored.remarks, CONTRACT: unsound})
        if lacking is not None:
            scored = replace(scored, remarks={**scored.remarks, "gain": f"not measured: {lacking}"})
        if "control" in metrics:
            arithmetic = {"arithmetic": arithmetic_on((how or Execution()).device)}
            scored = replace(scored, planning=planning_of(run, dataset, settings) | arithmetic)
        elif "control" in true and report is not None:
            scored = replace(scored, planning=present_planning(report.planning) or planning_of(run, dataset, settings))
        written = write_report(folder, scored, scores.samples)
        # an interrupted control goes on where control is asked for again, whatever is scored in between
        for done in (journal, *shares_of(journal)) if "control" in metrics else ():
            done.unlink(missing_ok=True)
    return written


def _asked(
    run: Run, dataset: Dataset, metrics: tuple[Metric, ...] | None, settings: ScoreSettings
) -> tuple[tuple[Metric, ...], ScoreSettings, str | None]:
    """The groups of figures that a run gets on a data set, how, and why the gain captured is none of the usual ones.

    Raises:
        As ``score_run``.
    """
    column = settings.control.column
    if column is not None and metrics not in (None, ("control",)):
        raise InvalidSetting(f"the column {column!r} is of control alone; leave out the other groups of figures.")
    metrics = ("control",) if column is not None else metrics
    elsewhere = dataset.fingerprint != run.spec.fingerprint
    protocol: SplitProtocol = "paper" if run.spec.protocol == "paper" and not elsewhere else "episode"
    settings = replace(settings, protocol=protocol)
    if dataset.spec.actions is not None:
        run.require_aligned()
    lacking = None
    if metrics is None:
        lacking = reason_against(dataset, settings.split, settings.gain)
        metrics = DEFAULT_METRICS if lacking else (*DEFAULT_METRICS, "gain")
    elif "gain" in metrics and dataset.spec.actions is not None:
        require_gain(dataset, settings.split, settings.gain)
    if "control" in metrics:
        require_tasks(dataset)  # said before the work, not after it
        settings.control.require_use(dataset.spec.actions)
    if dataset.spec.actions is None:
        metrics = ("prediction",)
    return metrics, settings, lacking


def is_scored(
    path: AnyPath, metrics: tuple[Metric, ...] | None, settings: ScoreSettings, data: AnyPath | None = None
) -> bool:
    """Whether a run's report holds all that ``score_run`` would be asked for; nothing is written.

    Raises:
        As ``score_run``.
    """
    run = Run.open(path)
    dataset, folder = scored_data(run, settings.split, data, settings.control.column)
    report, _ = standing_report(folder, run, dataset)
    if report is None:
        return False
    metrics, settings, _ = _asked(run, dataset, metrics, settings)
    settings = with_standing(settings, report, metrics)
    return set(metrics) <= set(true_groups(run, dataset, report, settings, metrics))


def scored_data(
    run: Run, split: SplitName, data: AnyPath | None = None, column: str | None = None
) -> tuple[Dataset, Path]:
    """The data set that a run is scored on, as its model reads it, and the folder of the report.

    Args:
        run: Trained.
        split: Whose episodes are scored.
        data: Another data set than the run's own.
        column: Of the table of control.

    Raises:
        InvalidSetting: A column is asked for on the run's own data set, or on tasks that are not the protocol's,
            or for other actions than it is for.
        RunMismatch, DatasetMissing: As ``score_run`` raises them.
    """
    dataset = dataset_of(run, Dataset) if data is None else Dataset.open(data)
    if column is not None:
        if dataset.fingerprint == run.spec.fingerprint:
            raise InvalidSetting(
                f"a column takes tasks in episodes that are new to a run, and {dataset.name!r} is what {run.name!r} "
                f"was trained on; score a column on another data set with '--data', and record one with "
                f"{words_of_test(dataset.recipe)}."
            )
        require_fitting_tasks(dataset)
        column_named(column).require_suited(dataset.spec)  # before a folder is made for it
    if dataset.fingerprint != run.spec.fingerprint:
        if data is None:
            raise RunMismatch(
                f"the data set {str(run.dataset_path)!r} has changed since the run {run.name!r} was trained on it, so "
                "its held-out episodes may no longer be held out; train again with 'dmbench train'."
            )
        dataset = transferable(run, dataset, split, column)
    return dataset, report_folder(run.path, run.spec.fingerprint, dataset, split, column)


def scored_report(path: AnyPath, split: SplitName, data: AnyPath | None = None, column: str | None = None) -> Report:
    """The report of a run that was just scored.

    Raises:
        RunMissing: There is none; else as ``score_run``.
    """
    run = Run.open(path)
    report = read_report(scored_data(run, split, data, column)[1])
    if report is None:
        raise RunMissing(f"the run {run.name!r} has no report; score it with 'dmbench score'.")
    return report
