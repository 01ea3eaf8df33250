"""Compute the figures of a trained model, and write the report of a run."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal, get_args

import pyarrow as pa
import pyarrow.compute as pc
import torch

from dmotion_bench.actions import kind_of
from dmotion_bench.errors import InvalidSetting, RunMismatch
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.learning.optimization import has_bf16
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.threads import using_threads
from dmotion_bench.learning.triplets import SplitProtocol
from dmotion_bench.planning.agents import REFERENCES as CONTROL_REFERENCES
from dmotion_bench.scoring.control import ControlScoring, control_tables, require_tasks
from dmotion_bench.scoring.earlier_planning import present_planning, present_settings
from dmotion_bench.scoring.explanation import REMARK as EXPLAINED
from dmotion_bench.scoring.explanation import explain_steps
from dmotion_bench.scoring.figures import Figures, figures_of
from dmotion_bench.scoring.prediction import (
    MODEL,
    Execution,
    Precision,
    predicting,
    score_reference_rollouts,
    score_reference_steps,
    score_rollouts,
    score_steps,
)
from dmotion_bench.scoring.references import REFERENCES, published_for
from dmotion_bench.scoring.report import (
    PROTOCOL,
    SCORING_VERSION,
    Report,
    read_report,
    read_report_samples,
    write_report,
)
from dmotion_bench.scoring.samples import PICTURE_CONTROL, SCHEMA
from dmotion_bench.scoring.statistics import RESAMPLES
from dmotion_bench.scoring.tiers import refused
from dmotion_bench.scoring.transfer import report_folder, training_of, transfer_remark, transferable
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.specs import VERSION, SplitName
from dmotion_bench.storage.atomic import remove_leftovers
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.lock import held
from dmotion_bench.versions import versions
from dmotion_bench.workspace import AnyPath

Metric = Literal["prediction", "rollout", "control"]
METRICS: tuple[Metric, ...] = get_args(Metric)
DEFAULT_METRICS: tuple[Metric, ...] = ("prediction", "rollout")
"""Those that take seconds; control acts in a simulator and takes minutes."""

CONTROL = "control_"
"""How the settings begin that decide the figures of control; they alone do."""

BESIDE = (*REFERENCES, *CONTROL_REFERENCES)
REMARKS = {
    "copy_last": "predicts that nothing changes",
    "agent_moves": "moves the agent as it truly moves, and nothing else; what it uncovers is taken from the truth",
    "idle": "does nothing",
    "random": "takes any action, each as likely",
    "scripted": "pushes by rules that read the simulator",
    "oracle": "plans like the model, with the true simulator in its place",
}


@dataclass(frozen=True, kw_only=True)
class ScoreSettings:
    """The settings that decide a report's figures, besides the weights and the data.

    Attributes:
        split: The episodes that are scored.
        protocol: How triplets are split; a run trained on the paper's leaking split is scored on it.
        horizon: Steps of a rollout.
        precision: Of the model's arithmetic: ``"float32"``, or ``"bf16"`` autocast.
        resamples: Draws of the bootstrap.
        control: Which control tasks are worked on, and how.
    """

    split: SplitName = "test"
    protocol: SplitProtocol = "episode"
    horizon: int = 15
    precision: Precision = "float32"
    resamples: int = RESAMPLES
    control: ControlScoring = field(default_factory=ControlScoring)

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise InvalidSetting(f"the horizon is {self.horizon}; a rollout has at least 1 step.")

    def to_json(self, metrics: tuple[str, ...]) -> dict[str, Any]:
        """The settings as a report with these groups of figures stores them."""
        plain = {one.name: getattr(self, one.name) for one in fields(self) if one.name != "control"}
        return plain | (self.control.to_json() if "control" in metrics else {}) | {"metrics": list(metrics)}


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


class ReferenceScores:
    """The samples of references, which depend on the data alone, so that all runs of a process share them."""

    def __init__(self) -> None:
        self._known: dict[tuple[object, ...], pa.Table] = {}

    def get(self, key: tuple[object, ...], score: Callable[[], pa.Table]) -> pa.Table:
        """The samples stored under a key; computed by ``score`` the first time."""
        if key not in self._known:
            self._known[key] = score()
        return self._known[key]


def score_model(
    model: ForwardModel[Any],
    dataset: Dataset,
    *,
    metrics: tuple[Metric, ...] = DEFAULT_METRICS,
    settings: ScoreSettings | None = None,
    how: Execution | None = None,
    references: ReferenceScores | None = None,
    earlier: pa.Table | None = None,
    journal: Path | None = None,
) -> Scores:
    """Score a model on held-out episodes; one that draws no frames (``needs_pixels``) has none to compare.

    Args:
        model: Aligned, in evaluation mode.
        dataset: With labels; of one whose actions are not known, see ``explanation.py``.
        metrics: Which groups of figures.
        settings: What decides the figures.
        how: Batch size, device, progress; the frames of one batch are in memory, and one episode's labels.
        references: Keeps the references' samples for the next model of this process.
        earlier: Samples of groups that are not asked for now; kept.
        journal: A file in which control keeps how far it is, to go on from there after an interruption.
    """
    settings, how = settings or ScoreSettings(), how or Execution()
    references = references or ReferenceScores()
    model = model.to(how.device).laid_out().eval()
    if dataset.spec.actions is None:
        with predicting(how.device, settings.precision):
            return _scores(explain_steps(model, dataset, settings.split, settings.protocol, how), settings)
    held_out = HeldOut(dataset, settings.split, settings.protocol)
    if not model.needs_pixels:
        metrics = tuple(metric for metric in metrics if metric == "control")
    identity = (dataset.fingerprint, dataset.spec.actions, settings.split, settings.protocol, torch.get_num_threads())
    tables = [] if earlier is None else [earlier]
    with predicting(how.device):
        if "prediction" in metrics:
            tables.append(references.get(identity, lambda: score_reference_steps(held_out, how)))
        if "rollout" in metrics:
            key = (*identity, settings.horizon)
            tables.append(
                references.get(key, lambda: score_reference_rollouts(held_out, how, horizon=settings.horizon))
            )
    with predicting(how.device, settings.precision):
        if "prediction" in metrics:
            tables.append(score_steps(model, held_out, how))
        if "rollout" in metrics:
            tables.append(score_rollouts(model, held_out, how, horizon=settings.horizon))
    if "control" in metrics:
        tables += control_tables(model, dataset, settings.control, how, journal)
    return _scores(pa.concat_tables(tables) if tables else SCHEMA.empty_table(), settings)


def _scores(samples: pa.Table, settings: ScoreSettings) -> Scores:
    found = {name: figures_of(samples, name, resamples=settings.resamples) for name in (MODEL, *BESIDE)}
    return Scores(
        samples=samples,
        figures=found[MODEL],
        reference={name: found[name] for name in BESIDE if found[name]},
    )


def score_run(
    path: AnyPath,
    *,
    metrics: tuple[Metric, ...] = DEFAULT_METRICS,
    settings: ScoreSettings | None = None,
    how: Execution | None = None,
    references: ReferenceScores | None = None,
    renew: bool = True,
    data: AnyPath | None = None,
) -> Report:
    """Score a run on the held-out episodes of its data set, or of another one, and write its report.

    It computes with as many threads as the training: another number rounds otherwise (``learning/threads.py``).
    Groups of figures that are not asked for stay in the report while they are true: same weights, data, settings and
    version; of control the same solver and objective, too.

    Args:
        renew: Whether to score again what the report already holds.
        data: Another data set of the same environment, or an import, see ``transfer.py``; the run's own if left out.
            The other arguments are ``score_model``'s.

    Raises:
        RunMissing, RunCorrupt: There is no trained run at this path.
        RunMismatch: The data set has changed since the run was trained on it, or the other one does not fit the run.
        DatasetMissing: The other one is an import, and the data set of the training is not there.
        LabelsNotAvailable: Nothing says what the actions do in the model; or as ``score_model`` raises it.
        DatasetError, LabelsNotAvailable: Control is asked for where it cannot be scored.
        UsageError: The run's number of threads is not allowed here.
        FolderInUse: Another process scores the run.
    """
    run = Run.open(path)
    dataset = Dataset.open(data or run.dataset_path)
    elsewhere = dataset.fingerprint != run.spec.fingerprint
    if elsewhere and data is None:
        raise RunMismatch(
            f"the data set {str(run.dataset_path)!r} has changed since the run {run.name!r} was trained on it, so its "
            "held-out episodes may no longer be held out; train again with 'dmbench train'."
        )
    protocol: SplitProtocol = "paper" if run.spec.protocol == "paper" and not elsewhere else "episode"
    settings = replace(settings or ScoreSettings(), protocol=protocol)
    if elsewhere:
        dataset = transferable(run, dataset, settings.split)
    if dataset.spec.actions is not None:
        run.require_aligned()
    folder = report_folder(run.path, run.spec.fingerprint, dataset)
    if "control" in metrics:
        require_tasks(dataset)  # said before the work, not after it
    if dataset.spec.actions is None:
        metrics = ("prediction",)
    folder.mkdir(parents=True, exist_ok=True)
    with held(folder):
        remove_leftovers(folder)
        report, samples = _stored(folder, run, dataset)
        true: tuple[str, ...] = ()
        if report is not None:
            settings = _with_stored(settings, report, metrics)
            planned = "control" in report.settings["metrics"]
            planning = _planning(run, dataset, settings) if planned else {}  # asks the environment, which may be absent
            true = tuple(name for name in report.settings["metrics"] if _is_true(name, report, settings, planning))
            if not renew and set(metrics) <= set(true):
                return report
        metrics = metrics if renew else tuple(metric for metric in metrics if metric not in true)
        with using_threads(run.threads):
            scores = score_model(
                run.model,
                dataset,
                metrics=metrics,
                settings=settings,
                how=how,
                references=references,
                earlier=_of_groups(samples, set(true) - set(metrics)),
                journal=(journal := folder / "control.json"),
            )
        scored = _report(run, dataset, scores, settings, tuple(dict.fromkeys((*true, *metrics))))
        if "control" in metrics:
            arithmetic = "bfloat16" if has_bf16((how or Execution()).device) else "float32"
            scored = replace(scored, planning=_planning(run, dataset, settings) | {"arithmetic": arithmetic})
        elif "control" in true and report is not None:
            scored = replace(scored, planning=present_planning(report.planning) or _planning(run, dataset, settings))
        written = write_report(folder, scored, scores.samples)
        journal.unlink(missing_ok=True)
    return written


def _stored(folder: Path, run: Run, dataset: Dataset) -> tuple[Report | None, pa.Table]:
    """The report of a folder with its samples, if it is of these weights on this data."""
    report = read_report(folder)
    if report is not None and run.result is not None:
        same = report.weights == run.result["weights"] and report.dataset["fingerprint"] == dataset.fingerprint
        samples = read_report_samples(folder, report) if same else None
        if samples is not None:
            return report, samples
    return None, SCHEMA.empty_table()


def _of_groups(samples: pa.Table, metrics: Collection[str]) -> pa.Table:
    """The samples of some groups of figures."""
    names = {*metrics, *((PICTURE_CONTROL,) if "control" in metrics else ())}
    return samples.filter(pc.is_in(samples["metric"], pa.array(sorted(names), pa.string())))


def _with_stored(settings: ScoreSettings, report: Report, metrics: tuple[str, ...]) -> ScoreSettings:
    """Take the settings of groups that are not asked for from the report."""
    if "rollout" not in metrics:
        settings = replace(settings, horizon=report.settings["horizon"])
    if "control" not in metrics and "control" in report.settings["metrics"]:
        settings = replace(settings, control=ControlScoring.from_json(report.settings))
    return settings


def _planning(run: Run, dataset: Dataset, settings: ScoreSettings) -> dict[str, Any]:
    return settings.control.planning(dataset, needs_pixels=run.model.needs_pixels)


def _is_true(metric: str, report: Report, settings: ScoreSettings, planning: Mapping[str, Any]) -> bool:
    """Whether a report's figures of one group are those that scoring now would give."""
    said = settings.to_json(METRICS)
    others = {"metrics", *(() if metric == "rollout" else ("horizon",))}
    decisive = [name for name in said if name.startswith(CONTROL) == (metric == "control") and name not in others]
    if metric == "control":  # its version is among its settings; reports of before that hold no solver
        said_of = present_planning(report.planning)
        same = not said_of or all(said_of.get(name) == one for name, one in planning.items())
    else:
        same = report.scoring_version == SCORING_VERSION
    stored = present_settings(report.settings)
    return same and all(said[name] == stored.get(name) for name in decisive)


def _report(run: Run, dataset: Dataset, scores: Scores, settings: ScoreSettings, metrics: tuple[str, ...]) -> Report:
    result = run.result or {}
    own = training_of(run, dataset)
    spec, environment, actions = run.spec, dataset.recipe.environment, dataset.spec.actions
    published = None if own else published_for(spec.model, environment, spec.labels, actions=actions)
    reference = {name: _json(figures) for name, figures in scores.reference.items()}
    remarks = {name: remark for name, remark in REMARKS.items() if name in reference}
    left_out = refused(dataset.spec, dataset.recipe, metrics, scores.figures)
    if dataset.spec.actions is None:
        remarks["actions"] = EXPLAINED
    elif not dataset.spec.objects and not dataset.spec.agent_has_color:
        remarks["positions"] = (
            "where the agent and the objects are is not known, so no figure is about them: " + left_out
        )
    elif left_out:
        remarks["positions"] = f"the environment does not tell everything: {left_out}"
    if any(name.startswith("control_picture") for name in scores.figures):
        remarks["control"] = (
            "control_picture_distance is the mean squared difference from the goal image, 1 at the start; the "
            "environment tells no positions, so it is no distance of objects, and no task counts as solved"
        )
    if own:
        remarks["trained_on"] = transfer_remark(run, dataset)
    if published is not None:
        reference["paper"] = {name: figure.to_json() for name, figure in published.figures.items()}
        remarks["paper"] = f"{published.source}; labels: {published.labels}. {published.note}".strip()
    if "rollout" in metrics and not any(name.startswith("rollout_") for name in scores.figures):
        remarks["rollout"] = (
            f"no {settings.split} episode has the {settings.horizon + 2} frames that a rollout needs; "
            "ask for a smaller '--horizon'"
        )
    if not run.model.needs_pixels:
        remarks["prediction"] = f"{run.spec.model} draws no frames; what it is good for shows in control"
    if settings.protocol == "paper":
        remarks["split"] = "the paper's split shuffles triplets: most test frames were seen in training (it leaks)"
    return Report(
        run=run.name,
        model=run.spec.model,
        arch=run.spec.arch,
        preset=run.spec.preset,
        seed=run.spec.seed,
        labels={
            "asked": run.spec.labels,
            "given": result.get("labels", {}),
            "total": result.get("labels_total", 0),
        },
        dataset={
            "name": dataset.name,
            "environment": dataset.recipe.environment,
            "fingerprint": dataset.fingerprint,
        }
        | ({VERSION: dataset.recipe.version} if dataset.recipe.version != 1 else {})
        | ({"actions": kind_of(actions)} if kind_of(actions) != "discrete" else {})
        | ({"trained_on": own} if own else {}),
        weights=result["weights"],
        settings=settings.to_json(metrics),
        training={
            key: result[key]
            for key in (
                *("seconds", "steps", "triplets", "triplets_per_s", "parameters", "device", "processes"),
                *("threads", "precision"),
            )
            if result.get(key) is not None
        },
        versions=versions(),
        figures=_json(scores.figures),
        reference=reference,
        remarks=remarks,
        protocol=PROTOCOL,
        scoring_version=SCORING_VERSION,
    )


def _json(figures: Figures) -> dict[str, Any]:
    return {name: estimate.to_json() for name, estimate in figures.items()}
