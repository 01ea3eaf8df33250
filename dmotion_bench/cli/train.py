"""``dmbench train``: train a model on a data set's video."""

from __future__ import annotations

import os
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.api.settings import DEVICES, LARGEST_SEED, TRACKERS, as_preset, require_one_of
from dmotion_bench.cli.cache import CacheFolder, use_cache
from dmotion_bench.cli.jobs import executor_option, require_all, workers_option
from dmotion_bench.cli.live import Live, LiveTo, following
from dmotion_bench.cli.options import AsJson, Device, listed, numbers
from dmotion_bench.cli.stdout import own_stdout, print_json, say
from dmotion_bench.execution.processes import LED, end_with, is_led, lead, place
from dmotion_bench.specs import MOST_PROCESSES, MOST_THREADS, Preset
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.learning.runs.run import Conditions, Run
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.follow import Follower


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(train)


def train(
    model: Annotated[
        str | None, typer.Argument(help="The model's name; 'dmbench list models' lists them.", show_default=False)
    ] = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Train every model with each of its label budgets.")
    ] = False,
    data: Annotated[
        Path | None,
        typer.Option(
            help="The data set, by path, name or address (s3://bucket/path). Default: the only one of the workspace."
        ),
    ] = None,
    labels: Annotated[
        str | None,
        typer.Option(
            metavar="[none|N|all|P%|one-shot|K-shot]",
            help="Label budget: how many action labels the model is given. 1, 2, 64: this many labelled transitions; "
            "10%, all: this share of them; one-shot, 5-shot: this many demonstrations of each discrete action; "
            "one-shot-per-agent, where several agents act: of each agent's every action. Models that learn from video, "
            "alone or with few labels, use one-shot by default, and 64 if the actions are continuous; other models "
            "need a budget.",
        ),
    ] = None,
    preset: Annotated[
        Preset | None,
        typer.Option(
            parser=as_preset,
            metavar="[tiny|small|paper]",
            help="Length of the training. Default: what the data set's name ends with, else small.",
        ),
    ] = None,
    arch: Annotated[
        str | None,
        typer.Option(
            metavar="[compact|paper]",
            help="Architecture: the small, fast one, or the paper's. Default: the model's first.",
        ),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the weights, the batches and the demonstrations.")
    ] = 0,
    seeds: Annotated[
        str | None,
        typer.Option(
            metavar="SEED,SEED...",
            help="Train once with each of these seeds, such as 0,1,2, several at a time. Also with --all.",
            show_default=False,
        ),
    ] = None,
    split: Annotated[
        str,
        typer.Option(
            metavar=listed(("episode", "paper")),
            help="How test data are held out. episode: whole episodes. paper: single shuffled triplets of frames, as "
            "in the paper; training frames leak into the test.",
        ),
    ] = "episode",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="KEY=VALUE",
            help="Change a setting of the model or the training, such as epochs=5. Can be repeated.",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the run. Default: runs/NAME.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Continue an existing run; fail if there is none.")] = False,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_THREADS,
            help="Threads that compute. The weights depend on their number. Default: the run's own; else torch's "
            "number, or 1 where that is faster; with --all 1.",
            show_default=False,
        ),
    ] = None,
    device: Device = "auto",
    devices: Annotated[
        int,
        typer.Option(
            min=1,
            max=MOST_PROCESSES,
            help="Train in so many processes on this machine, one a GPU; on the CPU they share the processors. Each "
            "computes a part of every batch.",
        ),
    ] = 1,
    nodes: Annotated[
        int,
        typer.Option(
            min=1,
            max=MOST_PROCESSES,
            help="Train on so many machines that share the folders. Give the same command on each, with MASTER_ADDR "
            "and MASTER_PORT of the first one and NODE_RANK, the machine's number from 0, in its environment.",
        ),
    ] = 1,
    workers: Annotated[
        int | None,
        workers_option(
            "With --all or --seeds: how many jobs run at a time. Default: as many as there are processors and memory "
            "for."
        ),
    ] = None,
    executor: Annotated[str | None, executor_option("With --all or --seeds: where the jobs run")] = None,
    stream: Annotated[
        bool | None,
        typer.Option(
            "--stream/--no-stream",
            help="Read the compressed files while training instead of a cache of all decoded frames, and shuffle "
            "8,192 triplets at a time ('--set window=N': N). Default: where the cache does not fit on the disk.",
            show_default=False,
        ),
    ] = None,
    loaders: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_THREADS,
            help="Threads that read the compressed files. The order is the same for any number.  [default: 1]",
            show_default=False,
        ),
    ] = None,
    cache: CacheFolder = None,
    live: Live = False,
    live_to: LiveTo = None,
    log: Annotated[
        list[str] | None,
        typer.Option(
            metavar=listed(TRACKERS),
            help="Show the curves in TensorBoard (folder RUN/tensorboard) or Weights & Biases (RUN/wandb; offline "
            "unless WANDB_MODE says otherwise), too. Can be repeated.",
        ),
    ] = None,
    as_json: AsJson = False,
) -> None:
    """Train a model, or all models. Run the same command again to continue an interrupted training."""
    from dmotion_bench.errors import UsageError
    from dmotion_bench.registry import model_class
    from dmotion_bench.workspace import Workspace

    require_one_of("split", split, ("episode", "paper"))
    require_one_of("device", device, DEVICES)
    trackers: tuple[str, ...] = ()
    if log:
        from dmotion_bench.api.training import known_trackers

        trackers = known_trackers(log)
    use_cache(cache)
    workspace = Workspace.current()
    if everything or seeds is not None:
        one = {"--out": out, "--resume": resume, "--live": live, "--live-to": live_to}
        one |= {"--devices": devices > 1, "--nodes": nodes > 1, "--seed": bool(seed) and seeds is not None}
        every = {"MODEL": model, "--labels": labels, "--arch": arch, "--set": settings} if everything else {}
        if extra := [name for name, value in (every | one).items() if value]:
            why = "--all chooses these for every model" if everything else "--seeds makes several runs"
            raise UsageError(f"{why}; leave out {' and '.join(extra)}.")
        if place().world > 1:
            raise UsageError("torchrun shares one training among processes; '--workers N' shares many trainings.")
    else:
        require_all("train", workers, executor)
    if model is None and not everything:
        raise UsageError(
            "no model is named; name one ('dmbench list models' lists them), or give --all to train every model."
        )
    if model is not None:
        model_class(model)  # a misspelt name is said before anything is loaded

    from dmotion_bench.api.training import TrainingRequest, begin, require_sharing
    from dmotion_bench.storage.dataset import Dataset

    request = TrainingRequest(
        model=model or "",
        labels=labels,
        preset=preset,
        arch=arch,
        seed=seed,
        settings=tuple(settings or ()),
        protocol="paper" if split == "paper" else "episode",
        threads=threads,
        stream=stream,
    )
    if everything or seeds is not None:
        from dmotion_bench.api.side_by_side import Hands
        from dmotion_bench.cli.train_many import train_many

        hands = Hands(executor=executor, workers=workers, device=device)
        own = partial(train_run, device=device, trackers=trackers, loaders=loaders)
        train_many(request, numbers("--seeds", seeds), data, hands, own, trackers, loaders, as_json)
        return
    dataset = Dataset.open(workspace.dataset(data))
    run = begin(request, dataset, workspace, out, resume=resume)
    together = place()
    if together.world == 1 and devices * nodes > 1:
        require_sharing(run, devices * nodes)
        with own_stdout():  # one of the processes prints the object
            lead(sys.argv[1:], devices, nodes)
        return
    if devices * nodes > 1 and (devices, nodes) != (together.local_world, together.nodes):
        raise UsageError(
            f"torchrun has started {together.local_world} processes on each of {together.nodes} machines, and "
            f"--devices {devices} --nodes {nodes} says otherwise; leave these options out."
        )
    if is_led():
        end_with(int(os.environ[LED]))
    if together.rank > 0:
        train_run(run, dataset, device, trackers=trackers, loaders=loaders)
        return
    with following(lambda: _follower(run.path), live, live_to) as poll:
        result = train_run(run, dataset, device, poll, trackers, loaders)
        _tell(run, dataset, result, as_json)


def _follower(run: Path) -> Follower:
    from dmotion_bench.viewing.follow import TrainingFollower

    return TrainingFollower(run)


def _tell(run: Run, dataset: Dataset, result: dict[str, Any], as_json: bool) -> None:
    """Print the result of a training."""
    from dmotion_bench.cli.progress import duration
    from dmotion_bench.workspace import Workspace

    summary = {
        "run": str(run.path),
        "model": run.spec.model,
        "steps": result["steps"],
        "triplets_per_s": result["triplets_per_s"],
        "seconds": result["seconds"],
        "labels": result["labels_total"],
        "threads": result.get("threads"),
        "precision": result.get("precision"),
    }
    if as_json:
        print_json(summary)
        return
    say(f"{run.path}")
    say(
        f"  {result['steps']} steps, {result['triplets']} triplets in {duration(result['seconds'])} "
        f"({result['triplets_per_s']:.0f} triplets/s), {result['parameters'] / 1e6:.2f} M parameters"
    )
    for phase, step in result.get("ended", {}).items():
        say(f"  {phase}: ended early, after step {step}, with no lower validation loss for a while (patience)")
    say(f"  best validation loss {result['validation_loss']:.5f} at step {result['best_step']}")
    known = (
        f" of {_transitions(dataset)} transitions in the data set"
        if dataset.spec.actions is not None
        else ", there are none"
    )
    say(f"  labels used: {result['labels_total']}{known}")
    if run.conditions is not None:
        say(f"  computed in {_conditions(run.conditions)}")
    if run.spec.labels == "none" and dataset.spec.actions is not None:
        from dmotion_bench.api.training import first_labels

        say(
            "The model does not know yet which action is which. "
            f"The same command with '--labels {first_labels(dataset)}' tells it, without training again."
        )
    else:
        say(f"Score it with {command('dmbench score', Workspace.current().short(run.path))}.")


def _conditions(conditions: Conditions) -> str:
    threads = f"{conditions.threads} thread{'s' if conditions.threads > 1 else ''}"
    tried = {f"in {precision}": seconds for precision, seconds in conditions.probe.items()}
    tried |= {f"with threads: {count}": seconds for count, seconds in conditions.threads_probe.items()}
    taken = ", ".join(f"{seconds:.3g} s {how}" for how, seconds in tried.items())
    return f"{conditions.precision} with {threads}" + (f"; before the training a step took {taken}" if taken else "")


def train_run(
    run: Run,
    dataset: Dataset,
    device: str = "auto",
    poll: Callable[[], None] = lambda: None,
    trackers: tuple[str, ...] = (),
    loaders: int | None = None,
) -> dict[str, Any]:
    """Train a run to its end with a progress bar; ``poll`` is called after every step."""
    from dmotion_bench.api.training import complete
    from dmotion_bench.cli.progress import BarOnDemand, note

    with BarOnDemand(poll) as tell:
        return complete(
            run,
            dataset,
            device,
            tell,
            trackers,
            loaders=loaders,
            note=note,
            warn=lambda told: say(told, err=True),
        )


def _transitions(dataset: Dataset) -> int:
    return int((dataset.lengths - 1).sum())
