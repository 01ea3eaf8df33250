"""``dmbench view``: look at a data set, a run, its report or several runs in Rerun."""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.api.settings import SPLITS, require_one_of
from dmotion_bench.cli.live import say_written
from dmotion_bench.cli.options import listed
from dmotion_bench.cli.stdout import say

if TYPE_CHECKING:
    from dmotion_bench.viewing.follow import Follower


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(view)


def view(
    paths: Annotated[
        list[Path],
        typer.Argument(
            metavar="PATH",
            help="What to show: a data set, a run, a run's report or an .rrd file, by path or name. Several runs are "
            "shown side by side.",
        ),
    ],
    web: Annotated[bool, typer.Option("--web", help="Show it on a local web page instead of in a window.")] = False,
    save: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE",
            help="Write a file instead of opening a window: FILE.rrd for Rerun, or FILE.gif or FILE.webp for an "
            "animation of real episodes beside the ones that runs predict.",
        ),
    ] = None,
    steps: Annotated[
        int | None, typer.Option(min=1, help="For an animation: largest number of predicted steps. Default: 30.")
    ] = None,
    episode: Annotated[
        list[int] | None, typer.Option(min=0, help="Episode to show. Can be repeated. Default: a few telling ones.")
    ] = None,
    split: Annotated[
        str | None,
        typer.Option(
            metavar=listed(SPLITS), help="Part of the data set to take the episodes from. Default for a run: test."
        ),
    ] = None,
    data: Annotated[
        Path | None,
        typer.Option(help="For a run: data set to show it on. Default: the one that it was trained on."),
    ] = None,
    live: Annotated[
        bool, typer.Option("--live", help="Show a training or a recording that is still running, until it ends.")
    ] = False,
) -> None:
    """Show a data set, a run, a report or several runs in Rerun."""
    from dmotion_bench.api import viewing
    from dmotion_bench.errors import UsageError
    from dmotion_bench.storage.temporary import temporary_folder
    from dmotion_bench.workspace import Workspace

    if split is not None:
        require_one_of("split", split, SPLITS)
    animated = save is not None and save.suffix in viewing.ANIMATED
    if save is not None and save.suffix != ".rrd" and not animated:
        raise UsageError(
            f"--save {str(save)!r} must end in .rrd for Rerun, or in .gif or .webp for an animation of runs."
        )
    if steps is not None and not animated:
        raise UsageError("--steps is for an animation; name its file with --save FILE.gif or --save FILE.webp.")

    workspace = Workspace.current()
    targets = viewing.find_targets(paths, workspace)
    target = targets[0]
    if target.kind == "recording" and save is not None:
        raise UsageError(f"{str(target.path)!r} is a Rerun file already; copy it, or leave out --save to show it.")
    part = next((name for name in SPLITS if name == split), None)
    viewing.require_choice(targets, episode or [], part, live=live)
    other = viewing.data_of(targets, data, workspace, live=live)
    if animated:
        viewing.require_runs(targets, alone=not (live or web))
    if not web and save is None:
        viewing.require_display()  # said before the work, not after it
    if live:
        _follow(viewing.follower_of(targets), web, save)
        if save is not None:
            say_written(save)
        return
    if target.kind == "recording":
        _show(target.path, web)
        return

    if animated and save is not None:
        viewing.write_animation_of(targets, save, episode or [], part, other, steps, workspace)
        say(f"{save}")
        return
    with temporary_folder() as folder:
        file = save or folder / "scene.rrd"
        viewing.write_scene_of(targets, file, episode or [], part, other, workspace)
        if save is not None:
            say_written(save)
        if save is None or web:
            _show(file, web)


def _follow(follower: Follower, web: bool, save: Path | None) -> None:
    """Show what is new in a folder until the work there ends or nobody looks any more.

    That is: the window is closed, Ctrl-C is pressed, or the process is asked to end.
    """
    from dmotion_bench.cli.live import EVERY, live_recording

    window, ended = not web and save is None, False
    with live_recording(
        follower.title, follower.blueprint(), window=window, web=web, save=save, linger=lambda: not ended
    ) as shown:
        follower.start(shown.recording)
        try:
            while not (follower.done or shown.closed()):
                follower.poll(shown.recording)
                time.sleep(EVERY)
        except KeyboardInterrupt:
            ended = True
        follower.poll(shown.recording)


def _show(file: Path, web: bool) -> None:
    """Show a file until the window is closed, Ctrl-C is pressed, or the process is asked to end."""
    from dmotion_bench.api.viewing import show
    from dmotion_bench.cli.progress import note

    try:
        if not web:
            note("Rerun is open; close its window or press Ctrl-C to continue.")
        page = show(file, web=web)
        if page is None:
            return
        with page:
            say(page.url)
            forward = " ".join(f"-L {port}:127.0.0.1:{port}" for port in page.ports)
            note(
                f"Open it in a browser on this machine, or on another one after running there "
                f"'ssh {forward} HOST'. Press Ctrl-C to stop."
            )
            page.wait()
    except KeyboardInterrupt:
        return
