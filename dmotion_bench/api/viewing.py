"""What there is to see of a data set, a run, a report or several runs: in a file, a window or a browser."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Final, Self, SupportsIndex

from dmotion_bench.api.settings import SPLITS, require_one_of, whole
from dmotion_bench.errors import DmbenchError, UsageError
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.learning.runs.run import Run, require_own_files
from dmotion_bench.scoring.report import REPORT_FOLDER, read_report
from dmotion_bench.scoring.transfer import fitting, report_folder
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.temporary import temporary_folder
from dmotion_bench.viewing.animation import STEPS, animate, write_animation
from dmotion_bench.viewing.comparison import (
    MOST,
    comparable,
    comparison_scene,
    contrasting_episodes,
    told_apart,
)
from dmotion_bench.viewing.dataset import dataset_scene
from dmotion_bench.viewing.episodes import choose_episodes
from dmotion_bench.viewing.follow import Follower, RecordingFollower, TrainingFollower
from dmotion_bench.viewing.report import telling_episodes
from dmotion_bench.viewing.run import run_scene
from dmotion_bench.viewing.scene import Scene, write_scene
from dmotion_bench.viewing.target import Target, find_target
from dmotion_bench.viewing.viewer import WebViewer, require_display, serve_web, show_window, wait_for
from dmotion_bench.wording import shown
from dmotion_bench.workspace import AnyPath, AnyPaths, Workspace, as_path, in_workspace, listed

__all__ = [
    "ANIMATED",
    "Served",
    "beside",
    "data_of",
    "find_targets",
    "follower_of",
    "require_choice",
    "require_display",
    "require_runs",
    "scene_of",
    "scene_of_several",
    "scene_of_targets",
    "show",
    "view",
    "write_animation_of",
    "write_scene_of",
]

ANIMATED: Final = (".gif", ".webp")


class Served:
    """A local web page that shows something; it is there until ``close``, or the end of the ``with`` block.

    Args:
        stack: Closed with the page.
        viewer: What serves it.

    Attributes:
        url: To open in a browser on this machine.
        ports: Over ssh all are forwarded.
    """

    def __init__(self, stack: contextlib.ExitStack, viewer: WebViewer) -> None:
        self._stack, self._viewer = stack, viewer
        self.url, self.ports = viewer.url, (viewer.port,)

    def __repr__(self) -> str:
        return f"<Served: {self.url}>"

    def wait(self) -> None:
        """Wait until the page is not served any more, as when its process was ended."""
        wait_for(self._viewer.process)

    def close(self) -> None:
        """Stop serving."""
        self._stack.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()


@in_workspace
def view(
    what: AnyPaths,
    *,
    save: AnyPath | None = None,
    web: bool = False,
    episodes: Sequence[int] = (),
    split: SplitName | None = None,
    steps: SupportsIndex | None = None,
    data: AnyPath | None = None,
    workspace: AnyPath | None = None,
) -> Path | Served | None:
    """Show a data set, a run, a run's report or several runs in Rerun.

    Args:
        what: A folder, or a name in the workspace; several runs are shown side by side.
        save: A file to write instead of opening a window: ``FILE.rrd`` for Rerun, ``FILE.gif`` or ``FILE.webp`` for an
            animation of real episodes beside the predicted ones.
        web: Whether to serve a local web page instead of opening a window, of a Rerun file that is saved, too.
        episodes: Which ones; a few telling ones by default.
        split: ``"train"``, ``"validation"`` or ``"test"``: where they are chosen from.
        steps: Of an animation, at most; 30 by default.
        data: For one run: another data set to show it on.
        workspace: The folder with ``data/`` and ``runs/``; the current one by default.

    Returns:
        The page, if one is served; else the file, if one was written. A window returns None when it is closed.

    Raises:
        UnknownName: There is nothing of this name.
        UsageError: It cannot be shown in this way, or a number is out of its bounds.
        ViewerError: The file cannot be written, or there is no display for a window.

    Example:
        >>> dm.view("tiny", save="tiny.rrd", episodes=[0]).stat().st_size > 10_000
        True
    """
    if split is not None:
        require_one_of("split", split, SPLITS)
    steps = whole("steps", steps, 1)
    episodes = _numbers_of(episodes)
    file = None if save is None else as_path("file", save)
    if file is not None and file.suffix not in (".rrd", *ANIMATED):
        raise UsageError(
            f"save {str(file)!r} must end in .rrd for Rerun, or in .gif or .webp for an animation of runs."
        )
    animated = file is not None and file.suffix in ANIMATED
    if steps is not None and not animated:
        raise UsageError("steps is for an animation; name its file with save='FILE.gif' or save='FILE.webp'.")
    place = Workspace.current()
    asked = listed(what)
    if not asked:
        raise UsageError("nothing is named to be shown; name a data set or a run.")
    targets = find_targets([as_path("run or data set", one) for one in asked], place)
    require_choice(targets, episodes, split)
    other = data_of(targets, None if data is None else as_path("data set", data), place)
    if file is None and not web:
        require_display()  # said before the work, not after it
    if animated and file is not None:
        require_runs(targets, alone=not web)
        write_animation_of(targets, file, episodes, split, other, steps, place)
        return file
    if targets[0].kind == "recording":
        if file is not None:
            raise UsageError(
                f"{str(targets[0].path)!r} is a Rerun file already; copy it, or leave out save to show it."
            )
        return show(targets[0].path, web=web)
    with contextlib.ExitStack() as stack:
        written = file or stack.enter_context(temporary_folder()) / "scene.rrd"
        write_scene_of(targets, written, episodes, split, other, place)
        served = show(written, web=web, stack=stack) if web or file is None else None
    return served if web else file


def _numbers_of(episodes: object) -> list[int]:
    """The numbers of episodes.

    Raises:
        UsageError: They are no list of whole numbers.
    """
    if isinstance(episodes, str) or not isinstance(episodes, Iterable):
        raise UsageError(f"episodes is {shown(episodes)}; give a list of their numbers, such as [0].")
    return [whole("episode", one, 0) for one in episodes]


def show(file: Path, *, web: bool, stack: contextlib.ExitStack | None = None) -> Served | None:
    """Show a Rerun file in a window, until that is closed, or on a local web page.

    Args:
        file: Which one.
        web: Whether it is a page.
        stack: Closed with the page.

    Raises:
        ViewerError: There is no display, or Rerun could not be started.
    """
    if not web:
        show_window(file)
        return None
    closing = stack or contextlib.ExitStack()
    viewer = closing.enter_context(serve_web(file))
    return Served(closing.pop_all(), viewer)


def find_targets(paths: Sequence[Path], workspace: Workspace) -> list[Target]:
    """What paths or names stand for; several can only be runs.

    Raises:
        UnknownName, RunMissing, UsageError: As ``find_target``; or one of several is no run.
    """
    targets = [find_target(path, workspace) for path in paths]
    if len(targets) > 1 and (odd := next((one for one in targets if one.kind not in ("run", "report")), None)):
        raise UsageError(f"only runs can be shown side by side; {str(odd.path)!r} is a {odd.kind}, so name it alone.")
    return targets


def data_of(targets: Sequence[Target], data: Path | None, workspace: Workspace, *, live: bool = False) -> Path | None:
    """The folder of the other data set that a run is shown on, if it is.

    Raises:
        UsageError: That is not one run.
    """
    data = data or next((one.data for one in targets if one.data is not None), None)
    if data is not None and (live or len(targets) > 1 or targets[0].kind not in ("run", "report")):
        raise UsageError("--data shows one finished run on another data set; name that run alone, without --live.")
    return None if data is None else workspace.dataset(data)


def require_choice(
    targets: Sequence[Target], episodes: Sequence[int], split: SplitName | None, *, live: bool = False
) -> None:
    """Refuse episodes or a split where nothing is chosen.

    Args:
        targets: What is to be shown.
        episodes, split: As asked for.
        live: Whether it is followed.

    Raises:
        UsageError: Episodes or a split are asked for, and all is shown as it comes.
    """
    if (episodes or split is not None) and (live or targets[0].kind == "recording"):
        shown_whole = "what is followed live" if live else f"the Rerun file {str(targets[0].path)!r}"
        raise UsageError(
            f"episodes are chosen from data sets and runs, and {shown_whole} is shown as it is; name neither an "
            "episode nor a split."
        )


def require_runs(targets: Sequence[Target], *, alone: bool = True) -> None:
    """Refuse an animation of anything but runs.

    Args:
        targets: What is to be shown.
        alone: Whether it is only to be animated, not shown in another way, too.

    Raises:
        UsageError: It is something else.
    """
    if not alone or targets[0].kind not in ("run", "report"):
        raise UsageError("an animation shows what finished runs imagine; name runs, without --live and --web.")


def write_scene_of(
    targets: Sequence[Target],
    file: Path,
    episodes: Sequence[int],
    split: SplitName | None,
    data: Path | None,
    workspace: Workspace,
) -> None:
    """Write what there is to see of one thing, or of several runs, for Rerun."""
    write_scene(scene_of_targets(targets, episodes, split, data, workspace), file)


def follower_of(targets: Sequence[Target]) -> Follower:
    """What shows a training or a recording while it runs.

    Raises:
        UsageError: It is neither, or they are several.
    """
    target = targets[0]
    if len(targets) > 1 or target.kind == "recording":
        raise UsageError("--live follows one training or one recording; name its run or its data set.")
    if target.kind == "data set":
        return RecordingFollower(target.path, Manifest.read(target.path).spec)
    require_own_files(target.path)
    return TrainingFollower(target.path)


def scene_of_targets(
    targets: Sequence[Target],
    episodes: Sequence[int],
    split: SplitName | None,
    data: Path | None,
    workspace: Workspace,
) -> Scene:
    """What there is to see of one thing, or of several runs; a report comes with the runs beside it."""
    several = _side_by_side(targets, data, workspace)
    if len(several) > 1:
        return scene_of_several(several, list(episodes), split)
    return scene_of(targets[0], list(episodes), split, data)


def write_animation_of(
    targets: Sequence[Target],
    file: Path,
    episodes: Sequence[int],
    split: SplitName | None,
    data: Path | None,
    steps: int | None,
    workspace: Workspace,
) -> None:
    """Write an animation of some runs."""
    paths = _side_by_side(targets, data, workspace) or [targets[0].path]
    runs, dataset, chosen, told = _chosen(paths, list(episodes), split, data)
    write_animation(animate(told_apart(runs), dataset, chosen, told, steps=steps or STEPS), file)


def _side_by_side(targets: Sequence[Target], data: Path | None, workspace: Workspace) -> list[Path]:
    if len(targets) > 1:
        return [one.path for one in targets]
    plain = targets[0].kind == "report" and targets[0].report is None
    return beside(targets[0], workspace) if plain and data is None else []


def scene_of(target: Target, episodes: list[int], split: SplitName | None, data: Path | None = None) -> Scene:
    """What there is to see of a data set, a run or a report: the episodes asked for, or a few telling ones.

    A run is shown on its own data set, or on the one at ``data``.
    """
    if target.kind == "data set":
        dataset = Dataset.open(target.path)
        return dataset_scene(dataset, choose_episodes(dataset, episodes, split))
    (run,), dataset, chosen, told = _chosen([target.path], episodes, split, data, target.report)
    scene = run_scene(run, dataset, chosen, told, target.report)
    return replace(scene, front="Report") if target.kind == "report" else scene


def scene_of_several(paths: list[Path], episodes: list[int], split: SplitName | None) -> Scene:
    """Several runs side by side: the episodes asked for, or the worst, the best and where they differ most."""
    return comparison_scene(*_chosen(paths, episodes, split, None))


def _chosen(
    paths: list[Path],
    episodes: list[int],
    split: SplitName | None,
    data: Path | None,
    report: Path | None = None,
) -> tuple[list[Run], Dataset, list[int], dict[int, str]]:
    """Some runs, their data set (or the one at ``data``), the episodes to show, and what is said of these.

    They are the episodes asked for. Otherwise those are chosen that the reports of the runs tell most about (of one run
    the report in the folder that is named, if one is): of one run the worst, the middle and the best; of several the
    worst, the best and where they differ most.
    """
    runs = [Run.open(path) for path in paths]
    if len(runs) > 1:
        runs = comparable(runs)
    dataset = dataset_of(runs[0], Dataset) if data is None else Dataset.open(data)
    if data is not None:
        dataset = fitting(runs[0], dataset)
    told: dict[int, str] = {}
    if not episodes and split is None and len(paths) > 1:
        told = contrasting_episodes([run.path for run in runs])
    elif not episodes and split is None:
        plain = report_folder(runs[0].path, runs[0].spec.fingerprint, dataset)
        told = telling_episodes(runs[0].path, report or plain)
    chosen = choose_episodes(dataset, episodes or list(told), split or (None if episodes or told else "test"))
    return runs, dataset, chosen, told


def beside(target: Target, workspace: Workspace) -> list[Path]:
    """A report's run, and the runs scored on the same frames that stand beside it, the best first."""
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
        if figure and figure["mean"] is not None and report.frames == own.frames:
            others.append((float(figure["mean"]), path))
    return [target.path, *(path for _, path in sorted(others)[: MOST - 1])]
