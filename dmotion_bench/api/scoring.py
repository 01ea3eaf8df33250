"""Figures of trained runs on held-out episodes, and of references of control."""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import SupportsIndex

import torch

from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.settings import DEVICES, Settings, as_texts, require_one_of, whole
from dmotion_bench.errors import RunMismatch, StorageFull, UnknownName, UsageError
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.execution.refusals import reason
from dmotion_bench.learning.hardware.threads import scoring_shortage
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.agents import REFERENCES
from dmotion_bench.planning.choices import DEFAULT_SOLVER
from dmotion_bench.planning.columns import COLUMNS, Column
from dmotion_bench.planning.mpc import GROUP, STEPS, ControlProgress
from dmotion_bench.scoring.control import ControlScoring, control_samples
from dmotion_bench.scoring.differences import behind, standing_words
from dmotion_bench.scoring.figures import Figures, figures_of
from dmotion_bench.scoring.prediction import Execution, Precision
from dmotion_bench.scoring.reference_control import score_reference as control_of_reference
from dmotion_bench.scoring.report import Report, read_report_samples, why_no_interval
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import METRICS, Metric, ScoreSettings
from dmotion_bench.scoring.shared_samples import SharedSamples
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, Workspace, in_workspace

__all__ = [
    "ScoreSettings",
    "as_metrics",
    "behind",
    "columns",
    "compute_device",
    "control_scoring",
    "names_apart",
    "read_report_samples",
    "require_control",
    "score",
    "score_references",
    "score_runs",
    "standing_words",
    "why_no_interval",
]

_LOG = logging.getLogger(__name__)


@in_workspace
def score(
    run: AnyPath | None = None,
    metrics: Sequence[str] | str | None = None,
    *,
    split: SplitName = "test",
    horizon: SupportsIndex = 15,
    tasks: SupportsIndex | None = None,
    planner: str | None = None,
    planner_settings: Settings = None,
    objective: str | None = None,
    objective_settings: Settings = None,
    column: str | None = None,
    data: AnyPath | None = None,
    batch_size: SupportsIndex = 64,
    precision: Precision = "float32",
    device: str | torch.device = "auto",
    renew: bool = True,
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Report:
    """Score a run on held-out episodes, and write its report.

    Args:
        run: A trained run, by folder, name or as ``train`` returned it. Default: the workspace's only one.
        metrics: Groups of figures: ``"prediction"``, ``"rollout"``, ``"gain"``, ``"control"``. Default: all but
            control that the data set can have.
        split: ``"test"`` or ``"validation"``.
        horizon: Steps of a rollout.
        tasks: For control: so many of the data set's first tasks; None for all.
        planner, planner_settings: For control: the solver, ``"cem"`` by default, and its fields that differ from
            their defaults.
        objective, objective_settings: For control: likewise; None for the one that suits.
        column: In place of these a frozen planner of the table of control: ``"generic-risk"``,
            ``"generic-belief"``, ``"generic-wide"``, ``"generic"``, ``"paper"`` or ``"task-knowledge"``; with
            ``data``, whose tasks the run must not know.
        data: Another data set of the same environment, or an import. Default: the one of the training.
        batch_size: Predictions computed at once.
        precision: ``"float32"`` or ``"bf16"``.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        renew: Whether to compute again what the report already holds.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told how far it is, or True for a bar.

    Returns:
        The report: ``figures`` by name, each with mean, std, the bounds ``low`` and ``high`` of its 95% interval over
        episodes, and the number of samples ``n``; ``reference`` holds those of predictors that know nothing.

    Raises:
        RunMissing, RunCorrupt: There is no trained run.
        RunMismatch: The data set does not belong to the run.
        LabelsNotAvailable: Nothing says what the actions do in the model, or the data set has no labels.
        UnknownName, UsageError, InvalidSetting: A name or a value that is not allowed.

    Example:
        >>> report = dm.score("tiny", "prediction")
        >>> report.figures["mse"]["n"]
        20
    """
    require_one_of("split", split, ("test", "validation"))
    require_one_of("precision", precision, ("float32", "bf16"))
    batch_size, tasks = whole("batch_size", batch_size, 1), whole("tasks", tasks, 1)
    place = Workspace.current()
    settings = ScoreSettings(
        split=split,
        horizon=whole("horizon", horizon, 1),
        precision=precision,
        control=control_scoring(tasks, planner, planner_settings, objective, objective_settings, column=column),
    )
    asked = None if metrics is None else as_metrics([metrics] if isinstance(metrics, str) else metrics)
    of_control = {"planner": planner, "planner_settings": planner_settings, "objective": objective, "tasks": tasks}
    require_control(asked, column, of_control)
    try:
        path = place.run(run)
    except UnknownName:
        if str(run) in REFERENCES:
            raise UsageError(
                f"{str(run)!r} is a reference for control; score it with 'dmbench score {run} --metrics control', or "
                f"let it work on a task with dm.plan({str(run)!r})."
            ) from None
        raise
    reports, _ = score_runs(
        [path],
        asked,
        settings,
        batch_size=batch_size,
        device=str(device),  # torch's own may be given, too
        keep=not renew,
        data=None if data is None else place.dataset(data),
        progress=progress,
    )
    return reports[path]


def score_runs(
    paths: Sequence[Path],
    metrics: tuple[Metric, ...] | None,
    settings: ScoreSettings,
    *,
    batch_size: int = 64,
    device: str = "auto",
    keep: bool = False,
    data: Path | None = None,
    progress: Progress = None,
    note: Callable[[str], None] = _LOG.info,
    warn: Callable[[str], None] = _LOG.warning,
) -> tuple[dict[Path, Report], dict[Path, str]]:
    """Score runs one after the other; of several, one that fails does not stop the rest, but a full disk does.

    Args:
        paths: Their folders.
        metrics: Which groups of figures; None for all but control that a data set can have.
        settings: What decides the figures.
        batch_size, device: How they are computed.
        keep: Whether reports that are up to date are left as they are.
        data: What to score on in place of each run's own data set; of many, runs that do not fit it are left out.
        progress: Told how far the present run is.
        note, warn: Told in a sentence what is worth knowing; that a run was left out, or its model changed.

    Returns:
        The report of each run, and what went wrong with each that has none, both by the run's folder.

    Raises:
        StorageFull: There is no space left for a report.
    """
    where, shared = compute_device(device), SharedSamples()
    reports: dict[Path, Report] = {}
    failures: dict[Path, str] = {}
    names = names_apart(paths)
    warned: set[str] = set()
    with telling(progress) as tell:
        for path in paths:

            def show(what: str, done: int, total: int, name: str = names[path]) -> None:
                tell(JobProgress(what=f"scoring {name}", done=done, total=total, status=what))

            try:
                run = Run.open(path)
                slow = scoring_shortage(run.threads or 1, available_workers())
                for told, tell_it in ((slow, note), (changed_code(run), warn)):
                    if told is not None and told not in warned:
                        warned.add(told)
                        tell_it(told)
                reports[path] = score_run(
                    path,
                    metrics=metrics,
                    settings=settings,
                    how=Execution(batch_size=batch_size, device=where, progress=show),
                    shared=shared,
                    renew=not keep,
                    data=data,
                )
            except StorageFull:  # the others would not fit either
                raise
            except Exception as error:
                if len(paths) == 1:
                    raise
                if keep and data is not None and isinstance(error, RunMismatch):
                    warn(f"left out: {error}")
                    continue
                failures[path] = reason(error)
                note(f"{names[path]}: {failures[path]}")
    return reports, failures


def names_apart(paths: Sequence[Path]) -> dict[Path, str]:
    """What to call each run: its name, or its whole path where another run has the same name."""
    known = Counter(path.name for path in dict.fromkeys(paths))
    return {path: path.name if known[path.name] == 1 else str(path) for path in paths}


def changed_code(run: Run) -> str | None:
    """A sentence if a run's model is no longer the code that was trained, the same for all runs of the model."""
    if not run.changed_modules:
        return None
    return (
        f"the code of the model {run.spec.model!r} was changed since it was trained. What is scored now is these "
        "weights in the present code, and reports that are up to date are of the code of their time."
    )


def score_references(
    names: Sequence[str], data: Path, scoring: ControlScoring, progress: Progress = None
) -> dict[str, Figures]:
    """Figures of control of references: ``idle``, ``random``, ``oracle``, ``scripted``.

    Args:
        names: Which ones.
        data: The data set's folder; what they did stays in its cache.
        scoring: Which tasks, and how.
        progress: Told after every step.

    Raises:
        UnknownName: There is no such reference.
        DatasetError, LabelsNotAvailable: Control cannot be scored on this data set.
    """
    dataset, found = Dataset.open(data), dict[str, Figures]()
    with telling(progress) as tell:
        for name in names:

            def show(told: ControlProgress, name: str = name) -> None:
                tell(JobProgress(what=f"control by {name}", done=told.steps, total=told.total))

            result = control_of_reference(name, dataset, scoring, progress=show)
            found[name] = figures_of(control_samples(name, result), name)
    return found


def control_scoring(
    tasks: int | None = None,
    planner: str | None = None,
    planner_settings: Settings = None,
    objective: str | None = None,
    objective_settings: Settings = None,
    *,
    steps: int = STEPS,
    seed: int = 0,
    group: int = GROUP,
    column: str | None = None,
) -> ControlScoring:
    """What decides the figures of control, as ``score`` and ``plan`` are asked for it.

    Raises:
        UnknownName, InvalidSetting: A name or a value that is not allowed.
        UsageError: A column and a planner or an objective are named, or what is given is no name.
    """
    for what, given, known in (("planner", planner, "solver"), ("objective", objective, "objective")):
        if given is not None and not isinstance(given, str):
            raise UsageError(
                f"{what} is {shown(given)}; give a name. A class of your own has one once dm.register_{known} was "
                f"called, and {what}_settings sets its fields."
            )
    if column is not None and any((planner, planner_settings, objective, objective_settings)):
        raise UsageError(
            f"the column {column!r} says how to plan; leave out the planner, the objective and their settings."
        )
    return ControlScoring(
        tasks=tasks,
        steps=steps,
        planner=planner or DEFAULT_SOLVER,
        planner_set=as_texts(planner_settings),
        objective=objective,
        objective_set=as_texts(objective_settings),
        seed=seed,
        group=group,
        column=column,
    )


def require_control(metrics: Sequence[Metric] | None, column: str | None, given: Mapping[str, object]) -> None:
    """Refuse settings of control where no control is scored.

    Args:
        metrics: Which groups of figures are asked for; None for the usual ones, without control.
        column: Of the table of control, which asks for it.
        given: The settings, by what they are called where they were given.

    Raises:
        UsageError: One was given.
    """
    named = " and ".join(name for name, value in given.items() if value)
    if named and column is None and "control" not in (metrics or ()):
        raise UsageError(f"{named} would change nothing without control; ask for it in the metrics, or leave it out.")


def as_metrics(asked: Iterable[str], option: str = "metrics") -> tuple[Metric, ...]:
    """Groups of figures by their names, in the order in which they are computed.

    Args:
        asked: Names, also several in one text, separated by commas.
        option: What the caller knows them by.

    Raises:
        UnknownName: There is no such group.
        UsageError: None is named.
    """
    names = list(asked) if isinstance(asked, Iterable) else [asked]
    for name in names:
        if not isinstance(name, str):
            raise UsageError(f"{option} names {shown(name)}; a group of figures is a word: {', '.join(METRICS)}.")
    wanted = [part.strip() for name in names for part in name.split(",") if part.strip()]
    for name in wanted:
        require_one_of("group of figures", name, METRICS)
    if not wanted:
        raise UsageError(f"{option} names no group of figures; known: {', '.join(METRICS)}.")
    return tuple(name for name in METRICS if name in wanted)


def columns() -> tuple[Column, ...]:
    """The frozen planners that ``column`` may name, in the order of the table of control; the first is the headline."""
    return tuple(COLUMNS.values())


def compute_device(device: str) -> torch.device:
    """Where to compute.

    Raises:
        UnknownName: There is no such kind of device.
        UsageError: It is not here.
    """
    require_one_of("device", device, DEVICES)
    if device == "cuda" and not torch.cuda.is_available():
        raise UsageError("this machine has no CUDA device; leave out --device to compute on the CPU.")
    return torch.device("cuda" if device != "cpu" and torch.cuda.is_available() else "cpu")
