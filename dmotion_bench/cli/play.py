"""``dmbench play``: drive a learned model with the arrow keys and see what it imagines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

if TYPE_CHECKING:
    import numpy as np

    from dmotion_bench.planning.driving import Drive
    from dmotion_bench.storage.dataset import Dataset


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command()(play)


def play(
    run: Annotated[
        Path | None, typer.Argument(help="The run, by path or name. Default: the only one of the workspace.")
    ] = None,
    episode: Annotated[
        int | None, typer.Option(min=0, help="Episode whose first frame is the start. Default: the first test episode.")
    ] = None,
    web: Annotated[
        bool, typer.Option("--web", help="Show the pictures on a local web page instead of in a window.")
    ] = False,
    save: Annotated[Path | None, typer.Option(metavar="FILE.rrd", help="Also write a Rerun file.")] = None,
) -> None:
    """Choose actions with the arrow keys and see what a model predicts, beside what truly happens."""
    from dmotion_bench.actions import require_discrete
    from dmotion_bench.cli.keys import read_keys, require_terminal, single_keys
    from dmotion_bench.errors import LabelsNotAvailable, UsageError
    from dmotion_bench.workspace import Workspace

    if save is not None and save.suffix != ".rrd":
        raise UsageError(f"--save {str(save)!r} must end in .rrd, as Rerun knows its files by it.")
    terminal = require_terminal("dmbench play")
    path = Workspace.current().run(run)

    from dmotion_bench.viewing.viewer import require_display

    if not web and save is None:
        require_display()

    from dmotion_bench.learning.run import Run
    from dmotion_bench.storage.dataset import Dataset

    opened = Run.open(path)
    opened.require_aligned()
    dataset = Dataset.open(opened.dataset_path)
    if dataset.spec.actions is None:
        raise LabelsNotAvailable(f"the actions of {dataset.name!r} are not known, so its models cannot be driven.")
    names = require_discrete(dataset.spec.actions, "'dmbench play'").names
    chosen = int(dataset.split("test")[0]) if episode is None and len(dataset.split("test")) else episode or 0

    import torch

    from dmotion_bench.cli.live import live_recording
    from dmotion_bench.planning.driving import Drive
    from dmotion_bench.viewing.drive import drive_blueprint, log_drive

    start = dataset.video(chosen)[0]
    drive = Drive(opened.model, torch.from_numpy(start))
    truth = _simulator(dataset, chosen)
    blueprint = drive_blueprint(dataset.spec, truth is not None)
    title = f"{opened.name}, from episode {chosen}"
    with live_recording(title, blueprint, window=not web and save is None, web=web, save=save, linger=False) as log:
        moment = 0
        log_drive(log, moment, start, None if truth is None else truth(None))
        typer.echo(_legend(names), err=True)
        with single_keys(terminal):
            for action in commands(read_keys(terminal), names):
                moment += 1
                if action is None:
                    drive.restart()
                else:
                    drive.step(action)
                log_drive(log, moment, drive.frame.numpy(), None if truth is None else truth(action))
                _tell(drive, names)
    typer.echo("", err=True)


def commands(keys: Iterator[str], actions: Sequence[str]) -> Iterator[int | None]:
    """The actions that keys stand for, None for starting again; q and Escape end it, other keys are ignored."""
    bound = bindings(actions)
    for key in keys:
        if key in ("q", "escape", "\x04"):
            return
        if key == "r":
            yield None
        elif key in bound:
            yield bound[key]


def bindings(actions: Sequence[str]) -> Mapping[str, int]:
    """The action of each key: an arrow takes the action of the same name, the digits 1 to 9 take the first nine."""
    arrows = {name: number for number, name in enumerate(actions) if name in ("up", "down", "left", "right")}
    return arrows | {str(number + 1): number for number in range(min(len(actions), 9))}


def _legend(actions: Sequence[str]) -> str:
    arrows = {"up", "down", "left", "right"} <= set(actions)
    digits = ", ".join(f"{number + 1} {name}" for number, name in enumerate(actions[:9]))
    return f"{'arrow keys, or ' if arrows else ''}{digits}; r starts over, q ends."


def _tell(drive: Drive, actions: Sequence[str]) -> None:
    last = " ".join(actions[action] for action in drive.actions[-8:]) or "at the start"
    typer.echo(f"\r\x1b[K{len(drive.actions)}: {last}", nl=False, err=True)


def _simulator(dataset: Dataset, episode: int) -> Callable[[int | None], np.ndarray[Any, Any]] | None:
    """A function that takes an action in the simulator (None: start again); None without that environment."""
    from dmotion_bench.errors import DmbenchError
    from dmotion_bench.planning.tasks import task_environment
    from dmotion_bench.specs import IMPORTED

    if dataset.recipe.environment == IMPORTED:
        return None
    try:
        env = task_environment(dataset.recipe)
    except DmbenchError:
        return None

    def follow(action: int | None) -> np.ndarray[Any, Any]:
        if action is None:
            vary = list(dataset.recipe.vary)
            return env.reset(seed=dataset.rows[episode].seed, options={"vary": vary} if vary else None)[0]
        return env.step(action)[0]

    return follow
