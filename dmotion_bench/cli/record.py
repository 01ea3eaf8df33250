"""``dmbench record``: record an environment into a data set."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.api.settings import EXECUTORS, LARGEST_SEED, as_preset
from dmotion_bench.cli.live import Live, LiveTo, following
from dmotion_bench.cli.options import AsJson, listed
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.specs import Preset
from dmotion_bench.wording import command, sentence

if TYPE_CHECKING:
    from dmotion_bench.recording.session import Recorded
    from dmotion_bench.specs import DatasetRecipe
    from dmotion_bench.viewing.follow import Follower


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(record)


def record(
    environment: Annotated[
        str,
        typer.Argument(
            help="The environment's name, or gym:ID for any Gymnasium environment; 'dmbench list environments' lists "
            "them."
        ),
    ],
    preset: Annotated[
        Preset,
        typer.Option(
            parser=as_preset, metavar="[tiny|small|paper]", help="Size of the recording: episodes, frames and tasks."
        ),
    ] = Preset.SMALL,
    episodes: Annotated[
        int | None,
        typer.Option(
            min=1, help="Total number of episodes. A larger number extends a data set. Default: the preset's."
        ),
    ] = None,
    frames: Annotated[
        int | None, typer.Option(min=3, help="Largest number of frames in an episode. Default: the preset's.")
    ] = None,
    tasks: Annotated[
        int | None,
        typer.Option(min=0, help="Number of control tasks to store with the data set. Default: the preset's."),
    ] = None,
    seed: Annotated[
        int, typer.Option(min=0, max=LARGEST_SEED, help="Seed of the episodes: the same seed records the same bytes.")
    ] = 0,
    size: Annotated[
        int | None,
        typer.Option(min=16, max=1024, help="Side of the frames in pixels; for gym:ID. Default: 128."),
    ] = None,
    frame_skip: Annotated[
        int | None,
        typer.Option(min=1, help="How often an action is taken between two frames; for gym:ID. Default: 1."),
    ] = None,
    vary: Annotated[
        str,
        typer.Option(
            metavar="FACTOR,FACTOR...",
            help="Factors that differ between episodes, separated by commas, such as light,background. "
            "'dmbench list environments' lists them. Default: none.",
        ),
    ] = "",
    ranges: Annotated[
        str,
        typer.Option(
            metavar="[in-distribution|shifted]",
            help="Values that the factors of --vary take: the usual range, or only values outside of it.",
        ),
    ] = "in-distribution",
    policy: Annotated[
        str | None,
        typer.Option(
            help="Policy that chooses the actions: random, sticky, object-directed, expert-correlated, or another that "
            "'dmbench list environments' names, or MODULE:FUNCTION. Default: the environment's."
        ),
    ] = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set", metavar="KEY=VALUE", help="Set a parameter of the environment, such as objects=3. Can be repeated."
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder of the data set, or an address on object storage: s3://bucket/path, gs://, hf://. "
            "Default: data/ENVIRONMENT-PRESET, with the scene and the policy at the end "
            "if they are not the usual ones, and with -varied or -shifted if factors vary."
        ),
    ] = None,
    workers: Annotated[
        int | None,
        typer.Option(
            min=1, help="Number of processes. The bytes are the same for any number. Default: all processors."
        ),
    ] = None,
    executor: Annotated[
        str,
        typer.Option(
            metavar=listed(EXECUTORS), help="Where the processes run: on this machine, in Ray, or as Slurm jobs."
        ),
    ] = "local",
    live: Live = False,
    live_to: LiveTo = None,
    as_json: AsJson = False,
) -> None:
    """Record a data set. Run the same command again to continue an interrupted recording."""
    from dmotion_bench.api.recording import default_folder, executor_for, record_recipe
    from dmotion_bench.cli.progress import BarOnDemand
    from dmotion_bench.recording.preset import recipe_for
    from dmotion_bench.recording.session import recording_folder
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
        policy=policy,
        settings=settings or (),
        size=size,
        frame_skip=frame_skip,
    )
    folder = out or default_folder(recipe, preset, Workspace.current())
    hands = executor_for(recipe, folder, executor, workers)
    with following(lambda: _follower(recording_folder(folder), recipe), live, live_to) as poll:
        with BarOnDemand(poll) as tell:
            recorded = record_recipe(recipe, folder, hands, tell)
        _tell(recorded, recipe.tasks, as_json)


def _follower(folder: Path, recipe: DatasetRecipe) -> Follower:
    from dmotion_bench.recording.session import environment_facts
    from dmotion_bench.viewing.follow import RecordingFollower

    return RecordingFollower(folder, environment_facts(recipe))


def _tell(recorded: Recorded, tasks_asked: int, as_json: bool) -> None:
    """Print the result of a recording."""
    from dmotion_bench.recording.advice import has_triplets, recording_advice
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.workspace import Workspace

    dataset, replay = Dataset.open(recorded.dataset), recorded.replay
    tasks, advice = len(dataset.tasks()), recording_advice(dataset)
    if as_json:
        print_json(
            {
                "dataset": str(recorded.dataset),
                "episodes": recorded.episodes,
                "frames": recorded.frames,
                "frames_per_s": round(recorded.made.frames_per_s, 1),
                "bytes_per_frame": round(recorded.bytes_per_frame, 1),
                "tasks": tasks,
            }
            | ({} if replay is None else {"repeats": replay.identical})
            | ({"advice": advice} if advice else {})
        )
        return
    say(f"{recorded.dataset}")
    say(
        f"  {recorded.episodes} episodes, {recorded.frames} frames, {recorded.bytes_per_frame:.0f} bytes a frame "
        f"with labels, {recorded.bytes / 2**20:.1f} MiB"
    )
    if replay is not None and replay.identical:
        say(f"  recorded again, {len(replay.episodes)} episodes have the same bytes")
    if replay is not None and not replay.identical:
        say(
            f"  the environment does not repeat: {replay.differs} differs when it is recorded again. So this data set "
            "cannot be recorded again byte for byte, and it has no control tasks."
        )
    elif tasks_asked:
        fewer = f" of the {tasks_asked} asked for; for more, record more or longer episodes"
        say(f"  {tasks} control tasks{fewer if tasks < tasks_asked else ''}")
    if recorded.made.frames:
        say(f"  {recorded.made.frames} frames recorded at {recorded.made.frames_per_s:.0f} frames/s")
    else:
        say("  the data set was complete already; a larger --episodes extends it")
    for told in advice:
        say(f"  {sentence(told)}")
    name = Workspace.current().short(recorded.dataset)
    train = f", train on it with {command('dmbench train dmotion --data', name)}" if has_triplets(dataset) else ""
    say(f"Look at it with {command('dmbench view', name)}{train}.")
