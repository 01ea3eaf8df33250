"""Training a model: anew, from where an interrupted training stopped, or from what another label budget shares."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, SupportsIndex

from dmotion_bench.api.contract import begins_all_the_same, breach_before, explaining, explaining_settings
from dmotion_bench.api.progress import Progress, telling
from dmotion_bench.api.runs import Run
from dmotion_bench.api.settings import (
    DEVICES,
    LARGEST_SEED,
    SPLIT_PROTOCOLS,
    TRACKERS,
    Settings,
    as_preset,
    as_texts,
    require_one_of,
    whole,
)
from dmotion_bench.errors import RunMissing, UsageError
from dmotion_bench.execution.available import available_workers
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.execution.processes import place
from dmotion_bench.learning.data.label_request import first_budget
from dmotion_bench.learning.data.triplets import SplitProtocol
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.hardware.threads import shortage
from dmotion_bench.learning.runs import run as runs
from dmotion_bench.learning.runs.start import (
    TrainingRequest,
    default_path,
    open_run,
    prepare_frames,
    require_enough,
    require_labels,
    resolve,
    training_data,
)
from dmotion_bench.learning.training.beginning import finished_result
from dmotion_bench.learning.training.companions import Companions
from dmotion_bench.learning.training.loop import train as train_steps
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.learning.training.tracking import require_trackers
from dmotion_bench.registry import model_class
from dmotion_bench.specs import MOST_THREADS, Preset
from dmotion_bench.storage.atomic import is_unused
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import shown
from dmotion_bench.workspace import RUN_MANIFEST, AnyPath, Workspace, as_path, in_workspace

if TYPE_CHECKING:
    import torch
    from lightning_fabric import Fabric

__all__ = [
    "TrainingRequest",
    "begin",
    "complete",
    "first_labels",
    "known_trackers",
    "require_sharing",
    "train",
]

_LOG = logging.getLogger(__name__)


@in_workspace
def train(
    model: str,
    data: AnyPath | None = None,
    *,
    labels: str | SupportsIndex | None = None,
    preset: Preset | str | None = None,
    arch: str | None = None,
    seed: SupportsIndex = 0,
    settings: Settings = None,
    split: SplitProtocol = "episode",
    out: AnyPath | None = None,
    resume: bool = False,
    threads: SupportsIndex | None = None,
    stream: bool | None = None,
    loaders: SupportsIndex | None = None,
    device: str | torch.device = "auto",
    log: Sequence[str] = (),
    workspace: AnyPath | None = None,
    progress: Progress = None,
) -> Run:
    """Train a model on a data set's video. The same call continues an interrupted training, or returns a finished one.

    In a script that torchrun starts, its processes share the training.

    Args:
        model: Its registered name.
        data: The data set, by folder, name or as ``record`` returned it. Default: the workspace's only one.
        labels: The label budget: ``"none"``, ``"one-shot"``, ``"5-shot"``, ``64``, ``"10%"``, ``"all"``. Default:
            one-shot, or 64 for continuous actions, for models of video alone; others need one.
        preset: Length of the training. Default: the data set's.
        arch: The architecture. Default: the model's first.
        seed: Of the weights, the batches and the demonstrations.
        settings: Of the model or the training, such as ``{"epochs": 5}``.
        split: ``"episode"`` holds out whole episodes; ``"paper"`` single triplets, which leaks.
        out: The run's folder. Default: ``runs/NAME`` of the workspace.
        resume: Whether there must be a run to continue.
        threads: That compute; the weights depend on their number. Default: the run's own, else what is fastest.
        stream: Whether to read the compressed files while training instead of a cache of all decoded frames.
            Default: where the cache does not fit on the disk.
        loaders: Threads that read them; the order is the same for any number.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        log: Where the curves are shown, too: ``"tensorboard"``, ``"wandb"``.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.
        progress: A function that is told after every step, or True for a bar. What it raises stops the training,
            and the same call goes on from the last checkpoint.

    Raises:
        UnknownName, InvalidSetting, UsageError: A name or a value that is not allowed.
        RunMismatch: The folder holds another run.
        RunMissing: There is nothing to resume.
        LabelsNotAvailable: The budget asks for labels that are not there.
        RunError: A tracker's package is not installed, or it cannot begin.
        FolderInUse: Another process trains the run.

    Example:
        >>> run = dm.train("dmotion", "grid_world-tiny", settings={"epochs": 0.1}, out="runs/short")
        >>> run.result["labels_total"]
        4
    """
    if not isinstance(model, str):
        raise UsageError(
            f"model is {shown(model)}; give a name. A class of your own has one once dm.register_model was called, and "
            "settings sets the fields of its Config."
        )
    require_one_of("split", split, SPLIT_PROTOCOLS)
    device = str(device)  # torch's own may be given, too
    require_one_of("device", device, DEVICES)
    loaders = whole("loaders", loaders, 1, MOST_THREADS)
    trackers = known_trackers([log] if isinstance(log, str) else log)
    request = TrainingRequest(
        model=model,
        labels=None if labels is None else str(labels),
        preset=None if preset is None else as_preset(preset),
        arch=arch,
        seed=whole("seed", seed, 0, LARGEST_SEED),
        settings=as_texts(settings),
        protocol=split,
        threads=whole("threads", threads, 1, MOST_THREADS),
        stream=stream,
    )
    where = Workspace.current()
    model_class(model)  # a misspelt name is said before anything is loaded
    dataset = Dataset.open(where.dataset(data))
    run = begin(request, dataset, where, None if out is None else as_path("folder", out), resume=resume)
    complete(run, dataset, device, progress, trackers, loaders=loaders)
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
        UsageError: The folder holds something else, or the budget asks for more labels than there are.
        LabelsNotAvailable: The budget asks for labels, and the actions of the data set are not known.
        RunMismatch: It holds another run.
    """
    require_enough(request, dataset)
    with explaining_settings(request.model):
        folder = out or default_path(request, resolve(request, dataset), workspace)
    if resume and not (folder / RUN_MANIFEST).exists():
        raise RunMissing(f"nothing to resume: {str(folder)!r} holds no run; leave out --resume to start one.")
    if not (folder / RUN_MANIFEST).exists() and not is_unused(folder):
        raise UsageError(f"{str(folder)!r} is not empty and holds no run; name another folder with '--out DIR'.")
    with explaining_settings(request.model):
        return open_run(request, dataset, folder, workspace)


def complete(
    run: runs.Run,
    dataset: Dataset,
    device: str = "auto",
    progress: Progress = None,
    trackers: Sequence[str] = (),
    *,
    loaders: int | None = None,
    note: Callable[[str], None] = _LOG.info,
    warn: Callable[[str], None] = _LOG.warning,
) -> dict[str, Any]:
    """Train a run to its end: go on, take over what another label budget shares, or train damaged weights anew.

    Of several processes that torchrun has started, the first one settles what is to be done, and builds the frame
    cache with the first ones of the other machines, before the others look at any file.

    Args:
        run: Begun or not; one that is trained already is left as it is.
        dataset: What it learns from.
        device: ``"auto"``, ``"cpu"`` or ``"cuda"``.
        progress: Told after every step, in the first process alone.
        trackers: Names of ``TRACKERS`` that are told the curves, too.
        loaders: Threads that read the compressed files of a run that streams them; None for the usual number.
        note: Told in a sentence where the training comes from, if it does not begin.
        warn: Told in a sentence if it will be slow, and if the model's code was changed since it began.

    Returns:
        The run's result.

    Raises:
        ModelContractBroken: The training failed, and the model breaks the contract; that alone is a warning.
    """
    mine, ready = place(), partial(require_labels, run, dataset, loaders)
    fabric: Fabric | None = None
    if mine.world > 1:
        fabric = launch(device)
        companions = Companions(fabric)
        with companions.noticing_losses():
            finished, run.manifest, run.threads = companions.of_first(
                lambda: (finished_result(run, note, warn, ready), run.manifest, run.threads)
            )
            if finished is None and mine.local_rank == 0:
                prepare_frames(run, dataset)
            companions.gathered(mine.rank)
    else:
        finished = finished_result(run, note, warn, ready)
    if finished is not None:
        return finished
    breach = breach_before(run)
    if breach is not None and mine.rank == 0:
        warn(begins_all_the_same(breach))
    told = shortage(run.threads or 1, available_workers(), mine.local_world)
    if mine.rank == 0 and told is not None:
        warn(told)
    fabric = fabric or launch(device)
    with explaining(run.spec.model, breach):
        if mine.rank > 0:
            return train_steps(run, training_data(run, dataset, loaders), fabric, lambda _: None)
        return _train(run, dataset, fabric, progress, trackers, loaders)


def _train(
    run: runs.Run,
    dataset: Dataset,
    fabric: Fabric,
    progress: Progress,
    trackers: Sequence[str],
    loaders: int | None,
) -> dict[str, Any]:
    """Train in the process that tells how far it is."""
    what = f"training {run.spec.model}"
    with telling(progress) as tell:
        tell(JobProgress(what=what, done=0, total=None, status="reading the data"))

        def on_step(report: StepReport) -> None:
            tell(report.as_progress(what))

        return train_steps(run, training_data(run, dataset, loaders), fabric, on_step, tuple(trackers))


def require_sharing(run: runs.Run, processes: int) -> None:
    """Refuse what each of several processes would refuse, before they are started.

    Raises:
        UsageError: There are more of them than samples in a batch.
    """
    batch = run.spec.training_config.batch_size
    if batch < processes:
        raise UsageError(
            f"{processes} processes cannot share a batch of {batch}; start at most {batch}, or give a larger "
            "'--set batch_size=N'."
        )


def first_labels(dataset: Dataset) -> str:
    """The label budget that a model of video has by default, as it is written."""
    return first_budget(dataset.spec.actions)


def known_trackers(names: Sequence[str]) -> tuple[str, ...]:
    """The trackers of these names, each once.

    Raises:
        UnknownName: There is no such tracker.
        DmbenchError: Its package is not installed.
    """
    once = tuple(dict.fromkeys(names))
    for name in once:
        require_one_of("log", name, TRACKERS)
    if once:
        require_trackers(once)
    return once
