"""``dmbench data import``: recordings of other systems become a data set."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Final

import typer

from dmotion_bench.cli.jobs import executor_option, workers_option
from dmotion_bench.cli.options import AsJson
from dmotion_bench.cli.stdout import print_json, say
from dmotion_bench.errors import Interrupted
from dmotion_bench.wording import command, counted, sentence
from dmotion_bench.workspace import Workspace

if TYPE_CHECKING:
    from dmotion_bench.storage.imports.options import ImportReport


_SHOWN: Final = 20  # recordings that are left out and named
MODELS_TAKE = 16
"""The models of this package need frames whose side is a multiple of this."""


def register(data: typer.Typer) -> None:
    """Add the command to the group ``data``."""
    data.command("import")(data_import)


def data_import(
    recordings: Annotated[
        list[Path],
        typer.Argument(
            help="What to import: MCAP, MP4, MKV, WebM, AVI or HDF5 files, folders of such files, folders of pictures, "
            "or LeRobot data sets."
        ),
    ],
    camera: Annotated[
        str | None,
        typer.Option(
            help="Topic (MCAP), feature (LeRobot), path (HDF5), folder or names such as img#_left.png (pictures) of "
            "the camera; of videos the name of the files without suffix, or the number of the stream. "
            "Default: the only one."
        ),
    ] = None,
    actions: Annotated[
        str | None,
        typer.Option(help="Topic, feature or path with the actions; they become labels. Default: import video alone."),
    ] = None,
    action_fields: Annotated[
        str | None,
        typer.Option(
            metavar="FIELD,...",
            help="Fields with the numbers of continuous actions, such as linear.x,angular.z. A field with several "
            "numbers stands for all of them. Default: all numbers of LeRobot's and HDF5's actions.",
        ),
    ] = None,
    action_reduce: Annotated[
        str,
        typer.Option(
            metavar="[last|mean|sum]",
            help="How several continuous commands between two frames become one action: the command in force halfway, "
            "their mean, or their sum.",
        ),
    ] = "last",
    size: Annotated[int, typer.Option(min=8, max=4096, help="Height and width of the frames, in pixels.")] = 128,
    hz: Annotated[float, typer.Option(min=0.01, max=1000, help="Frames per second of the data set.")] = 10.0,
    source_hz: Annotated[
        float | None,
        typer.Option(
            min=0.001,
            max=10_000,
            help="Pictures per second of a recording without times (pictures, HDF5), or in place of a video's times. "
            "Default: what the file says, else --hz.",
        ),
    ] = None,
    fit: Annotated[
        str, typer.Option(metavar="[crop|pad|stretch]", help="How a picture that is not square is made square.")
    ] = "crop",
    clock: Annotated[
        str,
        typer.Option(
            metavar="[log|header]", help="Time of a frame: when it was logged, or the time stamp in its header."
        ),
    ] = "log",
    max_gap: Annotated[
        float | None,
        typer.Option(
            help="Seconds without a picture that end an episode. Default: 2.5 intervals of the camera, but at least "
            "1.5 and at most 20 frames at --hz."
        ),
    ] = None,
    min_frames: Annotated[int, typer.Option(min=3, help="Leave out episodes with fewer frames.")] = 3,
    frames_per_episode: Annotated[
        int, typer.Option(min=3, help="Cut longer episodes into parts of equal length.")
    ] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the split into training, validation and test.")] = 0,
    salvage: Annotated[
        bool,
        typer.Option(
            "--salvage",
            help="Import the undamaged beginning of a damaged file, and repeat the last picture for a damaged one.",
        ),
    ] = False,
    max_chunk: Annotated[
        int, typer.Option(min=1, help="Largest size of a decompressed chunk of an MCAP file, in MiB.")
    ] = 1024,
    max_memory: Annotated[int, typer.Option(min=64, help="Most memory to decode a video with, in MiB.")] = 1024,
    skip_damaged: Annotated[
        bool,
        typer.Option(
            "--skip-damaged",
            help="Leave out recordings, and episodes of HDF5 files and LeRobot data sets, that cannot be imported or "
            "have pictures of other proportions than most, and say why.",
        ),
    ] = False,
    workers: Annotated[
        int | None,
        workers_option(
            "How many recordings are read at a time. Default: one; with --executor, as there are processors and "
            "memory for."
        ),
    ] = None,
    executor: Annotated[
        str | None,
        executor_option("Where recordings are read"),
    ] = None,
    out: Annotated[Path | None, typer.Option(help="Folder of the data set. Default: data/imported-NAME.")] = None,
    as_json: AsJson = False,
) -> None:
    """Make a data set from recordings: videos, pictures, MCAP (foxglove, ROS 2), HDF5 (robomimic) or LeRobot data sets.

    The command checks the times and sizes of all recordings first. If one cannot be imported, it writes nothing.
    """
    from dmotion_bench.api.importing import import_recordings
    from dmotion_bench.cli.progress import progress_bar

    many = workers if workers or executor else 1
    at_once = skip_damaged or executor not in (None, "local") or many != 1
    with progress_bar() as bar:
        try:
            report = import_recordings(
                recordings,
                camera=camera,
                actions=actions,
                action_fields=() if action_fields is None else [name.strip() for name in action_fields.split(",")],
                action_reduce=action_reduce,
                size=size,
                hz=hz,
                source_hz=source_hz,
                fit=fit,
                clock=clock,
                max_gap_s=max_gap,
                min_frames=min_frames,
                frames_per_episode=frames_per_episode,
                seed=seed,
                salvage=salvage,
                skip_damaged=skip_damaged,
                max_chunk_mib=max_chunk,
                max_memory_mib=max_memory,
                out=out,
                workers=many,
                executor=executor or "local",
                progress=bar.tell,
                watch=bar.watch,
            )
        except KeyboardInterrupt:
            if at_once:
                told = (
                    "what is finished stands beside the data set's place. Run the same command again to go on where it "
                    "stopped."
                )
            else:
                told = "the unfinished import was removed. Run the same command again to start over."
            raise Interrupted(f"interrupted; {told}") from None
    if as_json:
        print_json(_as_json(report))
    else:
        say(_summary(report, size, hz, fit))


def _as_json(report: ImportReport) -> dict[str, Any]:
    from dmotion_bench.actions import actions_to_json

    return dataclasses.asdict(report) | {"path": str(report.path), "actions": actions_to_json(report.actions)}


def _rate(report: ImportReport) -> str:
    """How fast the pictures follow one another, to follow their size."""
    lowest, highest = (f"{rate:.3g}" for rate in report.source_hz_range)
    if not report.source_hz:
        return ""
    return f" at {report.source_hz:.1f} Hz" if lowest == highest else f" at {lowest} to {highest} Hz"


def _summary(report: ImportReport, size: int, hz: float, fit: str) -> str:
    lines = [
        f"{report.path}",
        f"  {counted(report.episodes, 'episode')}, {counted(report.frames, 'frame')} of {size}x{size} pixels at "
        f"{hz:g} Hz, from {counted(report.source_frames, 'picture')} of {report.source_width}x{report.source_height}"
        f"{_rate(report)}",
    ]
    width, height = report.source_width, report.source_height
    if fit == "crop" and width != height:
        side = min(width, height)
        lines.append(f"  frames show the middle {side}x{side} of {width}x{height} pixels; '--fit pad' keeps all")
    if size % MODELS_TAKE:
        lines.append(
            f"  the models here take frames whose side is a multiple of {MODELS_TAKE}; import with another '--size'"
        )
    if report.repeated:
        lines.append(
            f"  {counted(report.repeated, 'frame')} like the one before, as no newer picture had come; "
            "a lower '--hz' has fewer of them"
        )
    if report.unreadable:
        lines.append(f"  {counted(report.unreadable, 'damaged picture')}: in place of each stands the one before it")
    if report.left_out:
        lines.append(
            f"  {counted(report.left_out, 'frame')} left out: of episodes too short, or before the first action"
        )
    if report.actions is not None:
        lines.append(f"  actions, held out as labels: {report.actions}")
    else:
        with_actions = "; with '--actions TOPIC' it can" * report.may_hold_actions
        lines.append(f"  no actions: what an action leads to cannot be scored{with_actions}")
    lines += [f"  {sentence(told)}" for told in report.advice]
    if report.skipped:
        many = (
            "1 recording or episode is"
            if len(report.skipped) == 1
            else f"{len(report.skipped)} recordings or episodes are"
        )
        lines.append(f"  {many} left out:")
        lines += ["    " + sentence(why).replace("\n", "\n    ") for _, why in report.skipped[:_SHOWN]]
        if len(report.skipped) > _SHOWN:
            lines.append(f"    and {len(report.skipped) - _SHOWN} more; '--json' names all")
    name = Workspace.current().short(report.path)
    lines.append(
        f"Look at it with {command('dmbench view', name)}, "
        f"train on it with {command('dmbench train dmotion --data', name)}."
    )
    return "\n".join(lines)
