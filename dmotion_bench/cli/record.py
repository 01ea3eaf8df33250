"""``dmbench record``: record an environment into a data set."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.live import Live, LiveTo, following
from dmotion_bench.errors import UnknownName
from dmotion_bench.specs import Preset
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.recording.executor import Executor
    from dmotion_bench.recording.session import Recorded
    from dmotion_bench.specs import DatasetRecipe
    from dmotion_bench.viewing.follow import Follower


LARGEST_SEED = 2**53 - 1
"""Whatever reads JSON reads it exactly."""


def preset_named(name: str) -> Preset:
    """The preset of a name, or an error that names the one that was probably meant."""
    if name not in set(Preset):
        raise UnknownName("preset", name, [preset.value for preset in Preset])
    return Preset(name)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(record)


def record(
    environment: Annotated[str, typer.Argument(help="An environment; 'dmbench list environments' shows them.")],
    preset: Annotated[
        Preset, typer.Option(parser=preset_named, metavar="[tiny|small|paper]", help="How much to record.")
    ] = Preset.SMALL,
    episodes: Annotated[
        int | None, typer.Option(min=1, help="Episodes in all; more than there are extends the data set.")
    ] = None,
    frames: Annotated[int | None, typer.Option(min=3, help="At most so many frames an episode.")] = None,
    tasks: Annotated[int | None, typer.Option(min=0, help="Control tasks to store.")] = None,
    seed: Annotated[int, typer.Option(min=0, max=LARGEST_SEED, help="Decides every episode.")] = 0,
    vary: Annotated[
        str,
        typer.Option(
            metavar="FACTOR,FACTOR...",
            help="What differs between episodes: friction, mass, colour, light, camera, distractors. Nothing if left "
            "out.",
        ),
    ] = "",
    ranges: Annotated[
        str,
        typer.Option(
            metavar="[in-distribution|shifted]",
            help="What they are drawn from: the usual values, or only values outside of those.",
        ),
    ] = "in-distribution",
    settings: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="KEY=VALUE", help="Set up the environment, as objects=3; may be repeated."),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(help="The data set's folder; data/ENVIRONMENT-PRESET, with -varied or -shifted, if left out."),
    ] = None,
    workers: Annotated[
        int | None, typer.Option(min=1, help="At a time; as many as there are processors if left out. Changes no byte.")
    ] = None,
    executor: Annotated[
        str, typer.Option(help="Who records: local processes, ray or slurm. Changes no byte.")
    ] = "local",
    live: Live = False,
    live_to: LiveTo = None,
    as_json: Annotated[bool, typer.Option("--json", help="One JSON object on stdout.")] = False,
) -> None:
    """Record a data set. The same command again goes on where it stopped, or extends it to --episodes."""
    from dmotion_bench.recording.executor import available_workers, make_executor
    from dmotion_bench.recording.preset import recipe_for
    from dmotion_bench.storage.shard import shard_count
    from dmotion_bench.workspace import Workspace

    recipe = recipe_for(
        environment,
        preset,
        episodes=episodes,
        frames=frames,
        tasks=tasks,
        seed=seed,
        vary=vary.split(","),
        ranges=ranges,
        settings=settings or (),
    )
    folder = out or Workspace.current().data / f"{environment}-{preset.value}{_suffix(recipe)}"
    if workers is None and executor == "local":
        workers = available_workers()
    hands = make_executor(
        executor,
        min(workers, shard_count(recipe)) if workers else None,
        scratch=folder.absolute().parent / f".{folder.absolute().name}-jobs",
    )
    with following(lambda: _follower(folder, recipe), live, live_to) as poll:
        _tell(record_with_progress(folder, recipe, hands, poll), recipe.tasks, as_json)


def _follower(folder: Path, recipe: DatasetRecipe) -> Follower:
    from dmotion_bench.recording.session import environment_facts
    from dmotion_bench.viewing.follow import RecordingFollower

    return RecordingFollower(folder, environment_facts(recipe))


def _tell(recorded: Recorded, tasks_asked: int, as_json: bool) -> None:
    """Say what a recording came to."""
    from dmotion_bench.storage.dataset import Dataset

    tasks = len(Dataset.open(recorded.dataset).tasks())
    if as_json:
        typer.echo(
            json.dumps(
                {
                    "dataset": str(recorded.dataset),
                    "episodes": recorded.episodes,
                    "frames": recorded.frames,
                    "frames_per_s": round(recorded.made.frames_per_s, 1),
                    "bytes_per_frame": round(recorded.bytes_per_frame, 1),
                    "tasks": tasks,
                }
            )
        )
        return
    typer.echo(f"{recorded.dataset}")
    typer.echo(
        f"  {recorded.episodes} episodes, {recorded.frames} frames, {recorded.bytes_per_frame:.0f} bytes a frame "
        f"with labels, {recorded.bytes / 2**20:.1f} MiB"
    )
    if tasks_asked:
        fewer = f" of {tasks_asked} asked for: these episodes have no more, longer or more of them do"
        typer.echo(f"  {tasks} control tasks{fewer if tasks < tasks_asked else ''}")
    if recorded.made.frames:
        typer.echo(f"  {recorded.made.frames} frames recorded at {recorded.made.frames_per_s:.0f} frames/s")
    else:
        typer.echo("  it was complete already; a larger --episodes extends it")
    typer.echo(
        f"Look at it with {command('dmbench view', recorded.dataset)}, "
        f"train on it with {command('dmbench train dmotion --data', recorded.dataset)}."
    )


def _suffix(recipe: DatasetRecipe) -> str:
    """Sets apart, by default, what is recorded to be compared."""
    if not recipe.vary:
        return ""
    return f"-{recipe.parameters.get('ranges', 'varied')}"


def record_with_progress(
    folder: Path, recipe: DatasetRecipe, executor: Executor, poll: Callable[[], None] = lambda: None
) -> Recorded:
    """Record with a progress bar on stderr; ``poll`` is called after each shard."""
    from dmotion_bench.cli.progress import progress_bar
    from dmotion_bench.recording.session import Progress, record_dataset

    with progress_bar() as bar:
        task = bar.add_task(f"recording {recipe.environment}", total=recipe.episodes, status="")

        def show(progress: Progress) -> None:
            bar.update(task, completed=progress.episodes, status=f"{progress.frames_per_s:.0f} frames/s")
            poll()

        return record_dataset(folder, recipe, executor, show)
