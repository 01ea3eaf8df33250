"""``dmbench view``: look at a data set, a run or its report in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.specs import SplitName

if TYPE_CHECKING:
    from dmotion_bench.viewing.scene import Scene
    from dmotion_bench.viewing.target import Target

SPLITS: tuple[SplitName, ...] = ("train", "validation", "test")


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(view)


def view(
    path: Annotated[Path, typer.Argument(help="A data set, a run, a run's report, or an .rrd; a path or a name.")],
    web: Annotated[bool, typer.Option("--web", help="Serve a web page on this machine instead of a window.")] = False,
    save: Annotated[
        Path | None, typer.Option(metavar="FILE.rrd", help="Write a file for Rerun instead of opening a window.")
    ] = None,
    episode: Annotated[
        list[int] | None, typer.Option(min=0, help="Show this episode; may be repeated. A few if left out.")
    ] = None,
    split: Annotated[
        str | None, typer.Option(help="Take the episodes from train, validation or test; of a run, from test.")
    ] = None,
) -> None:
    """Look at a data set, a run or its report in Rerun."""
    from dmotion_bench.errors import UnknownName, UsageError
    from dmotion_bench.workspace import Workspace

    if split is not None and split not in SPLITS:
        raise UnknownName("split", split, SPLITS)
    if save is not None and save.suffix != ".rrd":
        raise UsageError(f"--save {str(save)!r} must end in .rrd, as Rerun knows its files by it.")

    from dmotion_bench.viewing.target import find_target

    target = find_target(path, Workspace.current())

    from dmotion_bench.viewing.viewer import require_display

    if not web and save is None:
        require_display()  # said before the work, not after it
    if target.kind == "recording":
        _show(target.path, web)
        return

    import tempfile

    from dmotion_bench.viewing.scene import write_scene

    scene = scene_of(target, episode or [], next((name for name in SPLITS if name == split), None))
    with tempfile.TemporaryDirectory(prefix="dmbench-view-") as folder:
        file = save or Path(folder) / "scene.rrd"
        write_scene(scene, file)
        if save is not None:
            typer.echo(f"{save}")
            typer.echo(f"Open it with 'dmbench view {save}' or 'rerun {save}'.")
        if save is None or web:
            _show(file, web)


def scene_of(target: Target, episodes: list[int], split: SplitName | None) -> Scene:
    """What there is to see of a data set, a run or a report: the episodes asked for, or a few telling ones."""
    from dataclasses import replace

    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.dataset import dataset_scene
    from dmotion_bench.viewing.episodes import choose_episodes

    if target.kind == "data set":
        dataset = Dataset.open(target.path)
        return dataset_scene(dataset, choose_episodes(dataset, episodes, split))
    from dmotion_bench.learning.run import Run
    from dmotion_bench.viewing.report import telling_episodes
    from dmotion_bench.viewing.run import run_scene

    run = Run.open(target.path)
    dataset = Dataset.open(run.dataset_path)
    told = {} if episodes or split else telling_episodes(run.path)
    chosen = choose_episodes(dataset, episodes or list(told), split or ("test" if not episodes else None))
    scene = run_scene(run, dataset, chosen, told)
    return replace(scene, front="Report") if target.kind == "report" else scene


def _show(file: Path, web: bool) -> None:
    """Show a file until the window is closed, Ctrl-C is pressed, or the process is asked to end."""
    import signal

    from dmotion_bench.cli.progress import note
    from dmotion_bench.viewing.viewer import serve_web, show_window

    def leave(_signal: int, _frame: object) -> None:
        raise KeyboardInterrupt

    signal.signal(signal.SIGTERM, leave)  # else Rerun would outlive this process
    try:
        if not web:
            note("Rerun is open; close its window or press Ctrl-C to go on.")
            show_window(file)
            return
        with serve_web(file) as viewer:
            typer.echo(viewer.url)
            forward = " ".join(f"-L {port}:127.0.0.1:{port}" for port in (viewer.page_port, viewer.data_port))
            note(f"Open it in a browser on this machine, from another one after 'ssh {forward} HOST'. Ctrl-C ends it.")
            viewer.process.wait()
    except KeyboardInterrupt:
        return
