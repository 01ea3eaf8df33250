"""``dmbench train``: train a model on a data set's video."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from dmotion_bench.cli.live import Live, LiveTo, following
from dmotion_bench.cli.record import LARGEST_SEED, preset_named
from dmotion_bench.specs import MOST_THREADS, Preset

if TYPE_CHECKING:
    from dmotion_bench.learning.run import Conditions
    from dmotion_bench.viewing.follow import Follower
    from dmotion_bench.workspace import Workspace


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(train)


def train(
    model: Annotated[
        str | None, typer.Argument(help="A model's name; 'dmbench list models' shows them.", show_default=False)
    ] = None,
    everything: Annotated[bool, typer.Option("--all", help="Every model under each of its label budgets.")] = False,
    data: Annotated[Path | None, typer.Option(help="The data set; the only one of the workspace if left out.")] = None,
    labels: Annotated[
        str | None,
        typer.Option(help="Label budget: none, one-shot, K-shot, 10%, 100%. One-shot for models that see video only."),
    ] = None,
    preset: Annotated[
        Preset | None,
        typer.Option(
            parser=preset_named, metavar="[tiny|small|paper]", help="How long to train; the data set's own if left out."
        ),
    ] = None,
    arch: Annotated[str | None, typer.Option(help="The model's architecture: compact or paper.")] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Of the weights, the batches and the demonstrations.")
    ] = 0,
    split: Annotated[
        str, typer.Option(help="episode, or paper: the paper's shuffled triplets, which leak into the test.")
    ] = "episode",
    settings: Annotated[
        list[str] | None, typer.Option("--set", metavar="KEY=VALUE", help="Change a setting; may be repeated.")
    ] = None,
    out: Annotated[Path | None, typer.Option(help="The run's folder; runs/NAME if left out.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Only go on with a run that is there already.")] = False,
    threads: Annotated[
        int | None,
        typer.Option(
            min=1,
            max=MOST_THREADS,
            help="Threads that compute; the weights depend on their number. The run's own, or as many as torch takes.",
            show_default=False,
        ),
    ] = None,
    device: Annotated[str, typer.Option(help="auto, cpu or cuda.")] = "auto",
    live: Live = False,
    live_to: LiveTo = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Train a model, or all of them. The same command again goes on where it stopped."""
    from dmotion_bench.errors import RunMissing, UnknownName, UsageError
    from dmotion_bench.registry import model_class
    from dmotion_bench.workspace import RUN_MANIFEST, Workspace

    for kind, given, allowed in (("split", split, ("episode", "paper")), ("device", device, ("auto", "cpu", "cuda"))):
        if given not in allowed:
            raise UnknownName(kind, given, allowed)
    workspace = Workspace.current()
    if everything:
        own = {"MODEL": model, "--labels": labels, "--arch": arch, "--set": settings, "--out": out, "--resume": resume}
        own |= {"--live": live, "--live-to": live_to}
        if extra := [name for name, value in own.items() if value]:
            raise UsageError(f"--all trains every model its own way; leave {' and '.join(extra)} away.")
        _train_all(workspace, data, preset, seed, split, threads, device, as_json)
        return
    if model is None:
        raise UsageError("no model is named; name one ('dmbench list models' shows them), or train --all of them.")
    model_class(model)  # a misspelt name is said before anything is loaded

    from dmotion_bench.learning.start import TrainingRequest, default_path, open_run, resolve
    from dmotion_bench.storage.dataset import Dataset

    request = TrainingRequest(
        model=model,
        labels=labels,
        preset=preset,
        arch=arch,
        seed=seed,
        settings=tuple(settings or ()),
        protocol="paper" if split == "paper" else "episode",
        threads=threads,
    )
    dataset = Dataset.open(workspace.dataset(data))
    folder = out or default_path(request, resolve(request, dataset), workspace)
    if resume and not (folder / RUN_MANIFEST).exists():
        raise RunMissing(f"nothing to resume: {str(folder)!r} holds no run; leave --resume away to begin one.")
    run = open_run(request, dataset, folder, workspace)
    with following(lambda: _follower(run.path), live, live_to) as poll:
        _tell(run, dataset, train_run(run, dataset, device, poll), as_json)


def _follower(run: Path) -> Follower:
    from dmotion_bench.viewing.follow import TrainingFollower

    return TrainingFollower(run)


def _tell(run: Any, dataset: Any, result: dict[str, Any], as_json: bool) -> None:
    """Say what a training came to."""
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
        typer.echo(json.dumps(summary))
        return
    typer.echo(f"{run.path}")
    typer.echo(
        f"  {result['steps']} steps, {result['triplets']} triplets in {_duration(result['seconds'])} "
        f"({result['triplets_per_s']:.0f} triplets/s), {result['parameters'] / 1e6:.2f} M parameters"
    )
    typer.echo(f"  best validation loss {result['validation_loss']:.5f} at step {result['best_step']}")
    known = f" of {_transitions(dataset)} transitions in the data set" if dataset.spec.actions else ", there are none"
    typer.echo(f"  labels used: {result['labels_total']}{known}")
    if run.conditions is not None:
        typer.echo(f"  computed in {_conditions(run.conditions)}")
    if run.spec.labels == "none" and dataset.spec.actions:
        typer.echo("Its actions have no names yet; '--labels one-shot' takes this training over and names them.")
    else:
        typer.echo(f"Score it with 'dmbench score {run.path}'.")


def _conditions(conditions: Conditions) -> str:
    threads = f"{conditions.threads} thread{'s' if conditions.threads > 1 else ''}"
    taken = ", ".join(f"{seconds:.3g} s in {precision}" for precision, seconds in conditions.probe.items())
    return f"{conditions.precision} with {threads}" + (f"; before the training a step took {taken}" if taken else "")


def _train_all(
    workspace: Workspace,
    data: Path | None,
    preset: Preset | None,
    seed: int,
    split: str,
    threads: int | None,
    device: str,
    as_json: bool,
) -> None:
    """Train the whole table; fails in the end if a row did."""
    from dmotion_bench.errors import RunError
    from dmotion_bench.learning.start import TrainingRequest
    from dmotion_bench.learning.table import train_table
    from dmotion_bench.storage.dataset import Dataset

    protocol: Literal["paper", "episode"] = "paper" if split == "paper" else "episode"
    request = TrainingRequest(model="", preset=preset, seed=seed, protocol=protocol, threads=threads)
    dataset = Dataset.open(workspace.dataset(data))
    rows: list[dict[str, Any]] = []
    for outcome in train_table(request, dataset, workspace, lambda run: train_run(run, dataset, device)):
        row: dict[str, Any] = {"model": outcome.row.model, "budget": outcome.row.labels, "error": outcome.error}
        if outcome.run is not None:
            row["run"] = str(outcome.run.path)
            result = outcome.run.result or {}
            row |= {name: result[name] for name in ("steps", "triplets_per_s", "seconds") if name in result}
            row["labels"] = result.get("labels_total")
        rows.append(row)
        if not as_json:
            done = outcome.error or f"{_duration(row['seconds'])}, {row['labels']} labels, {row['run']}"
            typer.echo(f"{row['model']:16s} {row['budget']:9s} {done}")
    if as_json:
        typer.echo(json.dumps({"rows": rows}))
    if failed := [row["model"] for row in rows if row["error"]]:
        raise RunError(
            f"{len(failed)} of {len(rows)} rows failed: {', '.join(failed)}; the same command tries them again."
        )
    if not as_json:
        typer.echo("Score them with 'dmbench score --all'.")


def train_run(run: Any, dataset: Any, device: str = "auto", poll: Callable[[], None] = lambda: None) -> dict[str, Any]:
    """Train a run to its end with a progress bar, on the device asked for; ``poll`` is called after every step."""
    from dmotion_bench.cli.progress import note, progress_bar
    from dmotion_bench.errors import RunCorrupt, RunMissing
    from dmotion_bench.learning.devices import launch
    from dmotion_bench.learning.start import training_data
    from dmotion_bench.learning.threads import shortage
    from dmotion_bench.learning.training import Report, train
    from dmotion_bench.learning.twins import take_over
    from dmotion_bench.recording.executor import available_workers

    if run.result is not None:
        try:
            run.require_weights()
        except (RunMissing, RunCorrupt) as error:
            note(f"{error}\ntraining {run.path} anew.")
            run.begin_anew()
        else:
            note(f"{run.path} is already trained; here is its result.")
            finished: dict[str, Any] = run.result
            return finished
    if (twin := take_over(run)) is not None:
        note(f"taking over the training of {twin.path}, which differs in its labels alone.")
    elif run.last.exists():
        note(f"going on with {run.path}.")
    if (told := shortage(run.threads or 1, available_workers())) is not None:
        typer.echo(told, err=True)
    fabric = launch(device)
    with progress_bar() as bar:
        task = bar.add_task(f"training {run.spec.model}", total=None, status="reading the data")

        def on_step(report: Report) -> None:
            bar.update(
                task,
                completed=report.step,
                total=report.steps,
                status=f"{report.phase} loss {report.loss:.4f}, {report.triplets_per_s:.0f} triplets/s",
            )
            poll()

        result: dict[str, Any] = train(run, training_data(run, dataset), fabric, on_step)
    return result


def _transitions(dataset: Any) -> int:
    return int((dataset.lengths - 1).sum())


def _duration(seconds: float) -> str:
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes} min {rest} s" if minutes else f"{rest} s"
