"""Training a model: anew, from where an interrupted training stopped, or from what another label budget shares."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Any

from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.runs import Run
from dmotion_bench.api.settings import DEVICES, SPLIT_PROTOCOLS, Settings, as_preset, as_texts, require_one_of
from dmotion_bench.errors import RunMissing, UsageError
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.execution.local_executor import available_workers
from dmotion_bench.learning import run as runs
from dmotion_bench.learning.beginning import finished_result
from dmotion_bench.learning.devices import launch
from dmotion_bench.learning.start import TrainingRequest, default_path, open_run, resolve, training_data
from dmotion_bench.learning.threads import shortage
from dmotion_bench.learning.training import Report, train as train_steps
from dmotion_bench.learning.triplets import SplitProtocol
from dmotion_bench.registry import model_class
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import RUN_MANIFEST, AnyPath, Workspace

_LOG = logging.getLogger(__name__)


def train(
    model: str,
    data: AnyPath | None = None,
    *,
    labels: str | None = None,
    preset: Preset | str | None = None,
    arch: str | None = None,
    seed: int = 0,
    settings: Settings = None,
    split: SplitProtocol = "episode",
    out: AnyPath | None = None,
    resume: bool = False,
    threads: int | None = None,
    device: str = "auto",
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Run:
    """Train a model on a data set's video. The same call continues an interrupted training, or returns a finished one.

    Args:
        model: Its registered name.
        data: The data set, by folder, name or as ``record`` returned it. Default: the workspace's only one.
        labels: The label budget: ``"none"``, ``"one-shot"``, ``"5-shot"``, ``"64"``, ``"10%"``, ``"all"``. Default:
            one-shot, or 64 for continuous actions, for models of video alone; others need one.
        preset: Length of the training. Default: the data set's.
        arch: The architecture. Default: the model's first.
        seed: Of the weights, the batches and the demonstrations.
        settings: Of the model or the training, such as ``{"epochs": 5}``.
        split: ``"episode"`` holds out whole episodes; ``"paper"`` single triplets, which leaks.
        out: The run's folder. Default: ``runs/NAME`` of the workspace.
        resume: Whether there must be a run to continue.
        threads: That compute; the weights depend on their number. Default: the run's own, else what is fastest.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told after every step, or True for a bar. What it raises stops the training,
            and the same call goes on from the last checkpoint.

    Raises:
        UnknownName, InvalidSetting, UsageError: A name or a value that is not allowed.
        RunMismatch: The folder holds another run.
        RunMissing: There is nothing to resume.
        LabelsNotAvailable: The budget asks for labels that are not there.
        FolderInUse: Another process trains the run.

    Example:
        >>> run = dm.train("dmotion", "grid_world-tiny", settings={"epochs": 0.1}, out="runs/short")
        >>> run.result["labels_total"]
        4
    """
    require_one_of("split", split, SPLIT_PROTOCOLS)
    require_one_of("device", device, DEVICES)
    request = TrainingRequest(
        model=model,
        labels=labels,
        preset=None if preset is None else as_preset(preset),
        arch=arch,
        seed=seed,
        settings=as_texts(settings),
        protocol=split,
        threads=threads,
    )
    place = Workspace.current() if workspace is None else Workspace(workspace)
    model_class(model)  # a misspelt name is said before anything is loaded
    dataset = Dataset.open(place.dataset(data))
    run = begin(request, dataset, place, None if out is None else Path(out), resume=resume)
    complete(run, dataset, device, progress)
    return Run.open(run.path)


def begin(
    request: TrainingRequest, dataset: Dataset, workspace: Workspace, out: Path | None, *, resume: bool = False
) -> runs.Run:
    """The run of a request, not trained further than it is.

    Args:
        request: What was asked for.
        dataset: What it learns from.
        workspace: Where runs are if no folder is named.
        out: The folder.
        resume: Whether there must be one already.

    Raises:
        RunMissing: There is nothing to resume.
        UsageError: The folder holds something else.
        RunMismatch: It holds another run.
    """
    folder = out or default_path(request, resolve(request, dataset), workspace)
    if resume and not (folder / RUN_MANIFEST).exists():
        raise RunMissing(f"nothing to resume: {str(folder)!r} holds no run; leave out --resume to start one.")
    if not (folder / RUN_MANIFEST).exists() and folder.is_dir() and any(folder.iterdir()):
        raise UsageError(f"{str(folder)!r} is not empty and holds no run; name another folder with '--out DIR'.")
    return open_run(request, dataset, folder, workspace)


def complete(
    run: runs.Run,
    dataset: Dataset,
    device: str = "auto",
    progress: Progress = None,
    *,
    note: Callable[[str], None] = _LOG.info,
    warn: Callable[[str], None] = _LOG.warning,
) -> dict[str, Any]:
    """Train a run to its end: go on, take over what another label budget shares, or train damaged weights anew.

    Args:
        run: Begun or not; one that is trained already is left as it is.
        dataset: What it learns from.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        progress: Told after every step.
        note: Told in a sentence where the training comes from, if it does not begin.
        warn: Told in a sentence if it will be slow.

    Returns:
        The run's result.
    """
    if (finished := finished_result(run, note)) is not None:
        return finished
    if (told := shortage(run.threads or 1, available_workers())) is not None:
        warn(told)
    fabric = launch(device)
    what = f"training {run.spec.model}"
    with telling(progress) as tell:
        tell(JobProgress(what=what, done=0, total=None, status="reading the data"))

        def on_step(report: Report) -> None:
            status = f"{report.phase} loss {report.loss:.4f}, {report.triplets_per_s:.0f} triplets/s"
            tell(JobProgress(what=what, done=report.step, total=report.steps, status=status))

        return train_steps(run, training_data(run, dataset), fabric, on_step)
