"""Training shared between label budgets: the part that needs no labels is trained once for all of them.

What an unsupervised model learns does not depend on the budget (the tests compare the bits), only the alignment after
the training does. So the 5-shot run takes over the one-shot run's last checkpoint, and its best weights as they were
before a demonstration was shown. It is then aligned for itself, or fine-tuned (``adaptation.py``). Of a world model the
autoencoder comes first and sees video alone: another budget goes on from where it ended.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Final

from dmotion_bench.errors import InvalidSetting, RunError
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.registry import model_class, model_names
from dmotion_bench.specs import Supervision
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.lock import held

AFTERWARDS: Final = ("adaptation", "adaptation_steps", "adaptation_rate")
"""Of the training's settings those that concern only what comes after the part without labels."""


def training_of(run: Run) -> str | None:
    """The same text for all runs that can share a training; None where there is nothing to share.

    Raises:
        RunError, UnknownName: The run's model is not here.
    """
    if model_class(run.spec.model).supervision is not Supervision.NONE:
        return None
    shared = {name: value for name, value in dataclasses.asdict(run.spec).items() if name != "labels"}
    return json.dumps(shared | {"threads": run.threads}, sort_keys=True)


def take_over(run: Run, ready: Callable[[], None] = lambda: None) -> Run | None:
    """Start a new run from the part of another run that needed no labels; the two differ only in their labels.

    ``run.json`` is written first and the checkpoint last. So a killed process leaves a run that has not begun, and the
    next one takes over the same training, or any other.

    Args:
        run: The new run.
        ready: Asked before anything is written; raises what speaks against it.

    Returns:
        Whose training it was; None where there is none, or the run has one of its own.

    Raises:
        FolderInUse: Another training of the run is going on.
        RunMismatch: Another command has begun a run with other settings in the folder since this one was looked up.
    """
    if run.result is not None or run.last.exists():
        return None
    source, files = next(_sources(run), (None, {}))
    if source is None and "trained_as" not in run.manifest:
        return None
    if source is not None:
        ready()
    run.path.mkdir(parents=True, exist_ok=True)
    with held(run.path):
        run.read_again()
        if run.result is not None or run.last.exists():
            return None
        if source is None:  # the one that a killed process began to take over is gone
            run.begin_anew()
            return None
        taken = {"versions": source.manifest["versions"], "code": source.manifest.get("code", {})}
        run.manifest |= {"trained_as": source.name, **taken}
        if source.conditions is None:
            run.write()
        else:
            run.begin(source.conditions)
        for name, file in files.items():
            write_atomically(run.path / name, file.read_bytes())
    return source


def _sources(run: Run) -> Iterator[tuple[Run, dict[str, Path]]]:
    """The runs beside this one that have a training to take over, each with its files."""
    for folder in _candidates(run):
        if (source := _source(run, folder)) is not None and (files := _shared(source)):
            yield source, files


def _candidates(run: Run) -> Iterator[Path]:
    """The folders beside a run that may hold a source, found without opening any: there may be hundreds of runs.

    A source has the checkpoint that is taken over. A name as ``start.default_path`` makes them tells the model, the
    data set and the seed, and those of a source are the run's own. Any other name tells nothing.
    """
    spec, needed = run.spec, _checkpoint(run).name
    usual = re.compile(rf"(?:{'|'.join(map(re.escape, model_names()))})-.+-s[0-9]+")
    own = re.compile(rf"{re.escape(spec.model)}-(?:.+-)?{re.escape(spec.dataset)}-(?:.+-)?s{spec.seed}")
    for folder in sorted(run.path.parent.glob("*/")):
        if (own.fullmatch(folder.name) or not usual.fullmatch(folder.name)) and (folder / needed).is_file():
            yield folder


def _checkpoint(run: Run) -> Path:
    """The checkpoint of a run with which another one begins."""
    return run.last if model_class(run.spec.model).supervision is Supervision.NONE else run.unlabelled_stage


def _source(run: Run, folder: Path) -> Run | None:
    """The run in a folder, if it differs from this one in nothing that its shared training depends on."""
    try:
        other = Run.open(folder)
        if other.spec.model != run.spec.model or other.path == run.path:
            return None
        adapted = {name: getattr(other.spec.training_config, name) for name in AFTERWARDS}
        wanted = dataclasses.replace(run.spec, labels=other.spec.labels, training={**run.spec.training, **adapted})
        return None if other.differences(wanted, run.threads) else other
    except (RunError, InvalidSetting):
        return None


def _shared(run: Run) -> dict[str, Path]:
    """The files of a training that do not depend on its labels, by name; empty if there are none.

    The checkpoint comes last: with it the other run has begun. What is damaged is not taken over.
    """
    if model_class(run.spec.model).supervision is Supervision.NONE:
        best = run.best if run.spec.labels == "none" else run.unadapted  # before it saw a demonstration
        files = {run.metrics.name: run.metrics, run.best.name: best, run.last.name: run.last}
        files = files if run.result is not None else {}
    else:
        files = {
            run.metrics.name: run.metrics,
            run.unlabelled_stage.name: run.unlabelled_stage,
            run.last.name: run.unlabelled_stage,
        }
    try:
        for path in {*files.values()} - {run.metrics}:
            checkpoint.load(path, required=None)
    except RunError:
        return {}
    return files if all(path.is_file() for path in files.values()) else {}
