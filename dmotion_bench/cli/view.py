"""``dmbench view``: look at a data set, a run, its report or several runs in Rerun."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.cli.options import listed
from dmotion_bench.specs import SplitName
from dmotion_bench.wording import command

if TYPE_CHECKING:
    from dmotion_bench.learning.run import Run
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.scene import Scene
    from dmotion_bench.viewing.target import Target
    from dmotion_bench.workspace import Workspace

ANIMATED = (".gif", ".webp")
SPLITS: tuple[SplitName, ...] = ("train", "validation", "test")


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
    from dmotion_bench.errors import UnknownName, UsageError
    from dmotion_bench.workspace import Workspace

    if split is not None and split not in SPLITS:
        raise UnknownName("split", split, SPLITS)
    animated = save is not None and save.suffix in ANIMATED
    if save is not None and save.suffix != ".rrd" and not animated:
        raise UsageError(
            f"--save {str(save)!r} must end in .rrd for Rerun, or in .gif or .webp for an animation of runs."
        )
    if steps is not None and not animated:
        raise UsageError("--steps is for an animation; name its file with --save FILE.gif or --save FILE.webp.")

    from dmotion_bench.viewing.target import find_target

    workspace = Workspace.current()
    targets = [find_target(path, workspace) for path in paths]
    if len(targets) > 1 and (odd := next((one for one in targets if one.kind not in ("run", "report")), None)):
        raise UsageError(f"only runs can be shown side by side; {str(odd.path)!r} is a {odd.kind}, so name it alone.")
    target = targets[0]
    if target.kind == "recording" and save is not None:
        raise UsageError(f"{str(target.path)!r} is a Rerun file already; copy it, or leave out --save to show it.")
    data = data or next((one.data for one in targets if one.data is not None), None)
    if data is not None and (live or len(targets) > 1 or target.kind not in ("run", "report")):
        raise UsageError("--data shows one run on another data set; name that run alone.")
    other = None if data is None else workspace.dataset(data)

    if animated and (live or web or target.kind not in ("run", "report")):
        raise UsageError("an animation shows what finished runs imagine; name runs, without --live and --web.")

    from dmotion_bench.viewing.viewer import require_display

    if not web and save is None:
        require_display()  # said before the work, not after it
    if live:
        if len(targets) > 1 or target.kind == "recording":
            raise UsageError("--live follows one training or one recording; name its run or its data set.")
        _follow(target, web, save)
        return
    if target.kind == "recording":
        _show(target.path, web)
        return

    import tempfile

    from dmotion_bench.viewing.scene import write_scene

    part = next((name for name in SPLITS if name == split), None)
    others = beside(target, workspace) if len(targets) == 1 and target.kind == "report" and other is None else []
    beside_each_other = [one.path for one in targets] if len(targets) > 1 else others
    if animated and save is not None:
        _animate(beside_each_other or [target.path], episode or [], part, other, save, steps)
        typer.echo(f"{save}")
        return
    if len(beside_each_other) > 1:
        scene = scene_of_several(beside_each_other, episode or [], part)
    else:
        scene = scene_of(target, episode or [], part, other)
    with tempfile.TemporaryDirectory(prefix="dmbench-view-") as folder:
        file = save or Path(folder) / "scene.rrd"
        write_scene(scene, file)
        if save is not None:
            typer.echo(f"{save}")
            typer.echo(f"Open it with {command('dmbench view', save)} or {command('rerun', save)}.")
        if save is None or web:
            _show(file, web)


def scene_of(target: Target, episodes: list[int], split: SplitName | None, data: Path | None = None) -> Scene:
    """What there is to see of a data set, a run or a report: the episodes asked for, or a few telling ones.

    A run is shown on its own data set, or on the one at ``data``.
    """
    from dataclasses import replace

    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.dataset import dataset_scene
    from dmotion_bench.viewing.episodes import choose_episodes

    if target.kind == "data set":
        dataset = Dataset.open(target.path)
        return dataset_scene(dataset, choose_episodes(dataset, episodes, split))
    from dmotion_bench.viewing.run import run_scene

    (run,), dataset, chosen, told = _chosen([target.path], episodes, split, data)
    scene = run_scene(run, dataset, chosen, told)
    return replace(scene, front="Report") if target.kind == "report" else scene


def _chosen(
    paths: list[Path], episodes: list[int], split: SplitName | None, data: Path | None
) -> tuple[list[Run], Dataset, list[int], dict[int, str]]:
    """Some runs, their data set (or the one at ``data``), the episodes to show, and what is said of these.

    They are the episodes asked for. Otherwise those are chosen that the reports of the runs tell most about: of one
    run the worst, the middle and the best; of several the worst, the best and where they differ most.
    """
    from dmotion_bench.learning.run import Run
    from dmotion_bench.scoring.transfer import fitting, report_folder
    from dmotion_bench.storage.dataset import Dataset
    from dmotion_bench.viewing.comparison import comparable, contrasting_episodes
    from dmotion_bench.viewing.episodes import choose_episodes
    from dmotion_bench.viewing.report import telling_episodes

    runs = [Run.open(path) for path in paths]
    if len(runs) > 1:
        runs = comparable(runs)
    dataset = Dataset.open(data or runs[0].dataset_path)
    if data is not None:
        dataset = fitting(runs[0], dataset)
    told: dict[int, str] = {}
    if not episodes and split is None and len(paths) > 1:
        told = contrasting_episodes([run.path for run in runs])
    elif not episodes and split is None:
        told = telling_episodes(runs[0].path, report_folder(runs[0].path, runs[0].spec.fingerprint, dataset))
    chosen = choose_episodes(dataset, episodes or list(told), split or (None if episodes or told else "test"))
    return runs, dataset, chosen, told


def _follow(target: Target, web: bool, save: Path | None) -> None:
    """Show what is new in a folder until the work there ends, or Ctrl-C is pressed."""
    import time

    from dmotion_bench.cli.live import EVERY, live_recording
    from dmotion_bench.storage.manifest import Manifest
    from dmotion_bench.viewing.follow import Follower, RecordingFollower, TrainingFollower

    follower: Follower = (
        RecordingFollower(target.path, Manifest.read(target.path).spec)
        if target.kind == "data set"
        else TrainingFollower(target.path)
    )
    window = not web and save is None
    with live_recording(follower.title, follower.blueprint(), window=window, web=web, save=save) as recording:
        follower.start(recording)
        try:
            while not follower.done:
                follower.poll(recording)
                time.sleep(EVERY)
        except KeyboardInterrupt:
            pass
        follower.poll(recording)


def beside(target: Target, workspace: Workspace) -> list[Path]:
    """A report's run, and the scored runs of the same data set that stand beside it, the best first."""
    from dmotion_bench.errors import DmbenchError
    from dmotion_bench.scoring.report import REPORT_FOLDER, read_report
    from dmotion_bench.viewing.comparison import MOST

    own = read_report(target.path / REPORT_FOLDER)
    if own is None or "mse" not in own.figures:
        return [target.path]
    others: list[tuple[float, Path]] = []
    for path in workspace.all_runs():
        try:
            report = read_report(path / REPORT_FOLDER)
        except DmbenchError:
            continue
        if report is None or path.resolve() == target.path.resolve():
            continue
        figure = report.figures.get("mse")
        if figure and figure["mean"] is not None and report.dataset["fingerprint"] == own.dataset["fingerprint"]:
            others.append((float(figure["mean"]), path))
    return [target.path, *(path for _, path in sorted(others)[: MOST - 1])]


def scene_of_several(paths: list[Path], episodes: list[int], split: SplitName | None) -> Scene:
    """Several runs side by side: the episodes asked for, or the worst, the best and where they differ most."""
    from dmotion_bench.viewing.comparison import comparison_scene

    return comparison_scene(*_chosen(paths, episodes, split, None))


def _animate(
    paths: list[Path], episodes: list[int], split: SplitName | None, data: Path | None, file: Path, steps: int | None
) -> None:
    """Write an animation of some runs."""
    from dmotion_bench.viewing.animation import STEPS, animate, write_animation
    from dmotion_bench.viewing.comparison import told_apart

    runs, dataset, chosen, told = _chosen(paths, episodes, split, data)
    write_animation(animate(told_apart(runs), dataset, chosen, told, steps=steps or STEPS), file)


def _show(file: Path, web: bool) -> None:
    """Show a file until the window is closed, Ctrl-C is pressed, or the process is asked to end."""
    from dmotion_bench.cli.progress import note
    from dmotion_bench.viewing.viewer import serve_web, show_window

    try:
        if not web:
            note("Rerun is open; close its window or press Ctrl-C to continue.")
            show_window(file)
            return
        with serve_web(file) as viewer:
            typer.echo(viewer.url)
            forward = " ".join(f"-L {port}:127.0.0.1:{port}" for port in (viewer.page_port, viewer.data_port))
            note(
                f"Open it in a browser on this machine, or on another one after running there "
                f"'ssh {forward} HOST'. Press Ctrl-C to stop."
            )
            viewer.process.wait()
    except KeyboardInterrupt:
        return
