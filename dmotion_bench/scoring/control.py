"""Control: how near to their goals a model and a planner bring the objects in a hundred steps.

A task's figure is its normalised distance: 1 at the start, 0 at the goal, from the simulator's positions, whatever
the model saw (``planning/problems.py``). What becomes of the samples of it stands in ``figures.py``.

The references say what a figure means: ``idle`` (1 by definition), ``random``, ``scripted`` (rules that read the
simulator) and ``oracle`` (the same planner with the true simulator as its model). They depend on the data set alone,
so what they did is kept in its ``cache/``. The oracle takes much longer than any model: it stands beside a model
once it has been scored for itself (``dmbench score oracle``).
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any, Final

import numpy as np
import pyarrow as pa
import torch

from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UnknownName
from dmotion_bench.learning.checkpoint import weights_hash
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.planning.configuration import planning_configuration
from dmotion_bench.planning.control import (
    CONTROL_VERSION,
    GROUP,
    STEPS,
    ControlProgress,
    ControlResult,
    ControlSettings,
    control,
)
from dmotion_bench.planning.controllers import REFERENCES, Controller, ModelController, make_reference
from dmotion_bench.planning.costs import COSTS
from dmotion_bench.planning.journal import Journal
from dmotion_bench.planning.planner import DEFAULT_PLANNER, make_planner
from dmotion_bench.planning.problems import Moving, TaskDataset, load_problems, task_environment
from dmotion_bench.scoring.prediction import MODEL, Execution
from dmotion_bench.scoring.report import CONTROL_OF_CODE
from dmotion_bench.scoring.samples import SampleRows
from dmotion_bench.specs import EnvSpec
from dmotion_bench.workspace import cache_folder

METRIC: Final = "control"
QUICK: Final = ("idle", "random", "scripted")
"""References that take seconds."""

Advance = Callable[[ControlProgress], None]


@dataclass(frozen=True, kw_only=True)
class ControlScoring:
    """The settings that decide the figures of control, besides the weights and the data.

    Attributes:
        tasks: So many of the data set's first tasks; None for all.
        steps: Actions a task.
        planner: Of ``planner_names()``; references that do not plan ignore it.
        cost: Of ``planning.costs.COSTS``; None for what suits the model.
        seed: Of the planner's random numbers.
        group: Tasks side by side; it only decides which numbers are rounded together.
    """

    tasks: int | None = None
    steps: int = STEPS
    planner: str = DEFAULT_PLANNER
    cost: str | None = None
    seed: int = 0
    group: int = GROUP

    def __post_init__(self) -> None:
        if self.tasks is not None and self.tasks < 1:
            raise InvalidSetting(f"tasks is {self.tasks}; control is scored on 1 or more.")
        make_planner(self.planner)
        if self.cost is not None and self.cost not in COSTS:
            raise UnknownName("cost", self.cost, COSTS)

    def to_json(self) -> dict[str, Any]:
        """The settings as a report stores them: with a prefix, and with the version of control."""
        return {f"{METRIC}_{name}": value for name, value in (asdict(self) | {"version": CONTROL_VERSION}).items()}

    def planning(self, spec: EnvSpec, *, needs_pixels: bool | None) -> dict[str, Any]:
        """The planner and the cost in full, see ``planning_configuration``."""
        return planning_configuration(make_planner(self.planner), self.cost, spec, needs_pixels=needs_pixels)

    @classmethod
    def from_json(cls, settings: Mapping[str, Any]) -> ControlScoring:
        """Read the settings back from those of a report."""
        return cls(**{one.name: settings[f"{METRIC}_{one.name}"] for one in fields(cls)})


def score_control(
    model: ForwardModel[Any] | str,
    dataset: TaskDataset,
    scoring: ControlScoring | None = None,
    *,
    device: torch.device | None = None,
    progress: Advance = lambda _: None,
    checkpoint: Path | None = None,
) -> ControlResult:
    """Let a model or a reference work on the tasks that the data set stores.

    Args:
        model: Aligned, or the name of a reference.
        dataset: With labels; its environment must be installed.
        scoring: Which tasks, and how.
        device: Where the model runs.
        progress: Called after every control step.
        checkpoint: A file to go on from after an interruption; it is left there when all is done, so that asking
            again costs nothing, and asking for more tasks only those. One that belongs to something else is
            overwritten.

    Raises:
        DatasetError: The data set stores no tasks, or this machine's simulator does not repeat the recording.
        LabelsNotAvailable: It is a recording of something that is not here to be controlled.
        UnknownName: No such task, planner, cost or reference.
    """
    scoring = scoring or ControlScoring()
    require_tasks(dataset)
    problems = load_problems(dataset, scoring.tasks)
    return control(
        _controller(model, dataset, scoring, device),
        problems,
        lambda: task_environment(dataset.recipe),
        ControlSettings(steps=scoring.steps, seed=scoring.seed, group=scoring.group),
        journal=_journal(checkpoint, model, dataset, scoring, device),
        on_progress=progress,
    )


def score_reference(
    name: str, dataset: TaskDataset, scoring: ControlScoring | None = None, *, progress: Advance = lambda _: None
) -> ControlResult:
    """The results of a reference; they are kept in the data set's cache, also when the work is interrupted.

    Raises:
        UnknownName: There is no such reference; else as ``score_control``.
    """
    scoring = scoring or ControlScoring()
    return score_control(name, dataset, scoring, progress=progress, checkpoint=_kept(name, dataset, scoring))


def require_tasks(dataset: TaskDataset) -> None:
    """Raise an error if control cannot be scored on a data set.

    Raises:
        DatasetError: The data set stores no tasks.
        LabelsNotAvailable: It is a recording of something that is not here to be controlled.
    """
    if dataset.recipe.environment == "imported":
        raise LabelsNotAvailable(
            f"{dataset.name!r} was imported, so there is no environment to act in and control cannot be scored; "
            "leave it out: '--metrics prediction,rollout'."
        )
    if not dataset.tasks():
        load_problems(dataset)


def control_tables(
    model: ForwardModel[Any], dataset: TaskDataset, scoring: ControlScoring, how: Execution, journal: Path | None
) -> list[pa.Table]:
    """The samples of a model's control and of the references beside it."""

    def advance(what: str) -> Advance:
        return lambda progress: how.progress(
            f"control by {what}" + ("" if np.isnan(progress.distance) else f", distance {progress.distance:.3f}"),
            progress.steps,
            progress.total,
        )

    tables = [
        control_samples(name, score_reference(name, dataset, scoring, progress=advance(name)))
        for name in known_references(dataset, scoring)
    ]
    result = score_control(
        model, dataset, scoring, device=how.device, progress=advance("the model"), checkpoint=journal
    )
    return [*tables, control_samples(MODEL, result)]


def known_references(dataset: TaskDataset, scoring: ControlScoring) -> tuple[str, ...]:
    """The references that can be shown beside a model without delay: quick ones, and ones scored before."""
    problems = load_problems(dataset, scoring.tasks)

    def is_done(name: str) -> bool:
        journal = _journal(_kept(name, dataset, scoring), name, dataset, scoring, None)
        return all(len(record.actions) >= scoring.steps for record in journal.all_records(problems).values())

    (env := task_environment(dataset.recipe)).close()
    possible = [name for name in REFERENCES if name != "scripted" or isinstance(env, Moving)]
    return tuple(name for name in possible if name in QUICK or is_done(name))


def control_samples(predictor: str, result: ControlResult) -> pa.Table:
    """The samples of control: one row for each task and step, including the start."""
    moments = result.distance.shape[1]
    rows = SampleRows(METRIC, predictor)
    for place, (task, episode) in enumerate(zip(result.tasks, result.episodes, strict=True)):
        rows.add(
            {
                "episode": np.full(moments, episode),
                "step": np.full(moments, result.starts[place]),
                "ahead": np.arange(moments),
                "action": np.append(result.actions[place], -1),
                "task": np.full(moments, task),
                "control_distance": result.distance[place],
                "control_lost": result.lost[place],
            }
        )
    return rows.table()


def _controller(
    model: ForwardModel[Any] | str, dataset: TaskDataset, scoring: ControlScoring, device: torch.device | None
) -> Controller:
    planner = make_planner(scoring.planner)
    if isinstance(model, str):
        return make_reference(model, dataset.spec, lambda: task_environment(dataset.recipe), planner, scoring.cost)
    return ModelController(model, dataset.spec, planner, cost=scoring.cost, device=device)


def _journal(
    path: Path | None,
    model: ForwardModel[Any] | str,
    dataset: TaskDataset,
    scoring: ControlScoring,
    device: torch.device | None,
) -> Journal:
    """The journal of a control run; it also accepts results that name this version by a hash of the code."""
    earlier = (_earlier_key(code, model, dataset, scoring, device) for code in _codes())
    return Journal(path, _key(model, dataset, scoring, device), earlier=tuple(earlier))


def _key(
    model: ForwardModel[Any] | str, dataset: TaskDataset, scoring: ControlScoring, device: torch.device | None
) -> dict[str, Any]:
    """Everything that decides the result of a task."""
    needs_pixels = None if isinstance(model, str) else model.needs_pixels
    return {
        "version": CONTROL_VERSION,
        "planning": scoring.planning(dataset.spec, needs_pixels=needs_pixels),
    } | _common_key(model, dataset, scoring, device)


def _common_key(
    model: ForwardModel[Any] | str, dataset: TaskDataset, scoring: ControlScoring, device: torch.device | None
) -> dict[str, Any]:
    return {
        "dataset": dataset.fingerprint,
        "who": model if isinstance(model, str) else weights_hash(model.state_dict()),
        "device": "cpu" if device is None else device.type,
        "steps": scoring.steps,
        "seed": scoring.seed,
        "group": scoring.group,
    }


def _kept(name: str, dataset: TaskDataset, scoring: ControlScoring) -> Path:
    """Where a reference's results are kept: in the file of an earlier key, if there is one, or in that of the key."""
    keys = [_earlier_key(code, name, dataset, scoring, None) for code in _codes()]
    earlier = (_place(name, dataset, key) for key in keys)
    return next((path for path in earlier if path.is_file()), _place(name, dataset, _key(name, dataset, scoring, None)))


def _place(name: str, dataset: TaskDataset, key: Mapping[str, Any]) -> Path:
    text = json.dumps(key, sort_keys=True)
    return cache_folder(dataset.path) / f"control-{name}-{hashlib.sha256(text.encode()).hexdigest()[:12]}.json"


def _codes() -> list[str]:
    """Hashes of the code that stand for the present version of control."""
    return [code for code, version in CONTROL_OF_CODE.items() if version == CONTROL_VERSION]


def _earlier_key(
    code: str,
    model: ForwardModel[Any] | str,
    dataset: TaskDataset,
    scoring: ControlScoring,
    device: torch.device | None,
) -> dict[str, Any]:
    """The key by which results were kept when the version was a hash of the code."""
    planner = repr(make_planner(scoring.planner))
    own = {"code": code, "planner": planner, "cost": scoring.cost}
    return own | _common_key(model, dataset, scoring, device)
