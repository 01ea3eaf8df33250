"""``dmbench train``: train a model on a data set's video."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer

from dmotion_bench.cli.cache import CacheFolder, use_cache
from dmotion_bench.cli.live import Live, LiveTo, following
from dmotion_bench.cli.options import DEVICES, AsJson, Device, listed, require_one_of
from dmotion_bench.cli.record import LARGEST_SEED, preset_named
from dmotion_bench.specs import MOST_THREADS, Preset
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.learning.run import Conditions
    from dmotion_bench.viewing.follow import Follower
    from dmotion_bench.workspace import Workspace


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
        Path | None, typer.Option(help="The data set, by path or name. Default: the only one of the workspace.")
    ] = None,
    labels: Annotated[
        str | None,
        typer.Option(
            metavar="[none|N|all|P%|one-shot|K-shot]",
            help="Label budget: how many action labels the model is given. 64: this many labelled transitions; 10%, "
            "all: the actions of this share of the episodes; one-shot, 5-shot: this many demonstrations of each "
            "discrete action. Models that learn from video alone use one-shot by default, and 64 if the actions are "
            "continuous; other models need a budget.",
        ),
    ] = None,
    preset: Annotated[
        Preset | None,
        typer.Option(
            parser=preset_named,
            metavar="[tiny|small|paper]",
            help="Length of the training. Default: the data set's preset.",
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
            "number, or 1 where that is faster.",
            show_default=False,
        ),
    ] = None,
    device: Device = "auto",
    cache: CacheFolder = None,
    live: Live = False,
    live_to: LiveTo = None,
    as_json: AsJson = False,
) -> None:
    """Train a model, or all models. Run the same command again to continue an interrupted training."""
    from dmotion_bench.errors import RunMissing, UsageError
    from dmotion_bench.registry import model_class
    from dmotion_bench.workspace import RUN_MANIFEST, Workspace

    require_one_of("split", split, ("episode", "paper"))
    require_one_of("device", device, DEVICES)
    use_cache(cache)
    workspace = Workspace.current()
    if everything:
        own = {"MODEL": model, "--labels": labels, "--arch": arch, "--set": settings, "--out": out, "--resume": resume}
        own |= {"--live": live, "--live-to": live_to}
        if extra := [name for name, value in own.items() if value]:
            raise UsageError(f"--all chooses these for every model; leave out {' and '.join(extra)}.")
        _train_all(workspace, data, preset, seed, split, threads, device, as_json)
        return
    if model is None:
        raise UsageError(
            "no model is named; name one ('dmbench list models' lists them), or give --all to train every model."
        )
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
        raise RunMissing(f"nothing to resume: {str(folder)!r} holds no run; leave out --resume to start one.")
    if not (folder / RUN_MANIFEST).exists() and folder.is_dir() and any(folder.iterdir()):
        raise UsageError(f"{str(folder)!r} is not empty and holds no run; name another folder with '--out DIR'.")
    run = open_run(request, dataset, folder, workspace)
    with following(lambda: _follower(run.path), live, live_to) as poll:
        _tell(run, dataset, train_run(run, dataset, device, poll), as_json)


def _follower(run: Path) -> Follower:
    from dmotion_bench.viewing.follow import TrainingFollower

    return TrainingFollower(run)


def _tell(run: Any, dataset: Any, result: dict[str, Any], as_json: bool) -> None:
    """Print the result of a training."""
    from dmotion_bench.cli.progress import duration

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
        f"  {result['steps']} steps, {result['triplets']} triplets in {duration(result['seconds'])} "
        f"({result['triplets_per_s']:.0f} triplets/s), {result['parameters'] / 1e6:.2f} M parameters"
    )
    typer.echo(f"  best validation loss {result['validation_loss']:.5f} at step {result['best_step']}")
    known = (
        f" of {_transitions(dataset)} transitions in the data set"
        if dataset.spec.actions is not None
        else ", there are none"
    )
    typer.echo(f"  labels used: {result['labels_total']}{known}")
    if run.conditions is not None:
        typer.echo(f"  computed in {_conditions(run.conditions)}")
    if run.spec.labels == "none" and dataset.spec.actions is not None:
        from dmotion_bench.learning.labels import first_budget

        typer.echo(
            "The model does not know yet which action is which. "
            f"The same command with '--labels {first_budget(dataset.spec.actions)}' tells it, without training again."
        )
    else:
        typer.echo(f"Score it with {command('dmbench score', run.path)}.")


def _conditions(conditions: Conditions) -> str:
    threads = f"{conditions.threads} thread{'s' if conditions.threads > 1 else ''}"
    tried = {f"in {precision}": seconds for precision, seconds in conditions.probe.items()}
    tried |= {f"with threads: {count}": seconds for count, seconds in conditions.threads_probe.items()}
    taken = ", ".join(f"{seconds:.3g} s {how}" for how, seconds in tried.items())
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
    """Train every model with each of its budgets; raises an error at the end if one of them failed."""
    from dmotion_bench.cli.progress import duration
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
            done = outcome.error or f"{duration(row['seconds'])}, {row['labels']} labels, {row['run']}"
            typer.echo(f"{row['model']:16s} {row['budget']:9s} {done}")
    if as_json:
        typer.echo(json.dumps({"rows": rows}))
    if failed := [row["model"] for row in rows if row["error"]]:
        raise RunError(
            f"{len(failed)} of {len(rows)} trainings failed: {', '.join(failed)}; "
            "run the same command to try them again."
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
    from dmotion_bench.recording.local_executor import available_workers

    if run.result is not None:
        try:
            run.weights()
        except (RunMissing, RunCorrupt) as error:
            note(f"{error}\ntraining {run.path} anew.")
            run.begin_anew()
        else:
            note(f"{run.path} is already trained; here is its result.")
            finished: dict[str, Any] = run.result
            return finished
    if (twin := take_over(run)) is not None:
        note(f"using the training of {twin.path}, which differs only in its labels.")
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
