"""``dmbench play``: drive a learned model with the arrow keys and see what it imagines."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.cli.arrows import Arrows, arrows_of, by_number

if TYPE_CHECKING:
    import numpy as np

    from dmotion_bench.actions import ActionSpec, ActionTaken
    from dmotion_bench.storage.dataset import Dataset

ARROWS = ("up", "down", "left", "right")


@dataclass(frozen=True)
class Move:
    """An action that keys stand for.

    Attributes:
        action: As an environment and a model take it.
        name: By which the user is told of it.
        arrow: The arrow key that takes it; empty for none.
    """

    action: ActionTaken
    name: str
    arrow: str = ""


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
    actions = dataset.spec.actions
    known = moves(actions, arrows_of(dataset, actions) if isinstance(actions, Continuous) else None)
    chosen = int(dataset.split("test")[0]) if episode is None and len(dataset.split("test")) else episode or 0

    import torch

    from dmotion_bench.cli.live import live_recording
    from dmotion_bench.learning.driving import Drive
    from dmotion_bench.viewing.drive import drive_blueprint, log_drive

    start = dataset.video(chosen)[0]
    drive = Drive(opened.model, torch.from_numpy(start))
    truth = _simulator(dataset, chosen)
    blueprint = drive_blueprint(dataset.spec, truth is not None)
    title = f"{opened.name}, from episode {chosen}"
    with live_recording(title, blueprint, window=not web and save is None, web=web, save=save, linger=False) as log:
        moment, taken = 0, list[str]()
        log_drive(log, moment, start, None if truth is None else truth(None))
        typer.echo(_legend(known), err=True)
        with single_keys(terminal):
            for move in commands(read_keys(terminal), known):
                moment += 1
                if move is None:
                    drive.restart()
                    taken.clear()
                else:
                    drive.step(move.action)
                    taken.append(move.name)
                seen = None if truth is None else truth(None if move is None else move.action)
                log_drive(log, moment, drive.frame.numpy(), seen)
                _tell(taken)
    typer.echo("", err=True)


def moves(actions: ActionSpec, arrows: Arrows | None = None) -> list[Move]:
    """What a user can choose from: every discrete action, or each number of a continuous one at its two bounds.

    An arrow key takes the discrete action of its name. Of a continuous action it takes a number to one of its bounds;
    the other numbers are 0 then, or the bound next to it.

    Args:
        actions: What can be done.
        arrows: The arrow keys of continuous actions; ``by_number`` by default.
    """
    if isinstance(actions, Discrete):
        return [Move(number, name, name if name in ARROWS else "") for number, name in enumerate(actions.names)]
    idle = [min(max(0.0, low), high) for low, high in zip(actions.low, actions.high, strict=True)]
    arrows = by_number(actions) if arrows is None else arrows
    found = []
    for place, (name, unit) in enumerate(zip(actions.names, actions.units, strict=True)):
        for upper, bound in ((False, actions.low[place]), (True, actions.high[place])):
            action = tuple(float(bound if other == place else number) for other, number in enumerate(idle))
            found.append(Move(action, f"{name}={bound:.3g}{unit}", arrows.get((place, upper), "")))
    return found


def commands(keys: Iterator[str], known: Sequence[Move]) -> Iterator[Move | None]:
    """The moves that keys stand for, None for starting again; q and Escape end it, other keys are ignored."""
    bound = bindings(known)
    for key in keys:
        if key in ("q", "escape", "\x04"):
            return
        if key == "r":
            yield None
        elif key in bound:
            yield bound[key]


def bindings(known: Sequence[Move]) -> Mapping[str, Move]:
    """The move of each key: the arrows take those that name them, the digits 1 to 9 take the first nine."""
    arrows = {move.arrow: move for move in known if move.arrow}
    return arrows | {str(number): move for number, move in enumerate(known[:9], start=1)}


def _legend(known: Sequence[Move]) -> str:
    arrows = set(ARROWS) <= {move.name for move in known}
    keys = ", ".join(
        f"{move.arrow} or {number} {move.name}" if move.arrow not in ("", move.name) else f"{number} {move.name}"
        for number, move in enumerate(known[:9], start=1)
    )
    return f"{'arrow keys, or ' if arrows else ''}{keys}; r starts over, q ends."


def _tell(taken: Sequence[str]) -> None:
    last = " ".join(taken[-8:]) or "at the start"
    typer.echo(f"\r\x1b[K{len(taken)}: {last}", nl=False, err=True)


def _simulator(dataset: Dataset, episode: int) -> Callable[[ActionTaken | None], np.ndarray[Any, Any]] | None:
    """A function that takes an action in the simulator (None: start again); None without that environment."""
    from dmotion_bench.errors import DmbenchError
    from dmotion_bench.planning.tasks import take, task_environment
    from dmotion_bench.specs import IMPORTED

    if dataset.recipe.environment == IMPORTED:
        return None
    try:
        env = task_environment(dataset.recipe)
    except DmbenchError:
        return None

    def follow(action: ActionTaken | None) -> np.ndarray[Any, Any]:
        if action is None:
            vary = list(dataset.recipe.vary)
            return env.reset(seed=dataset.rows[episode].seed, options={"vary": vary} if vary else None)[0]
        return take(env, action)

    return follow
