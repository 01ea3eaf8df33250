"""``dmbench play``: drive a learned model with the arrow keys and see what it imagines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.cli.arrows import Arrows, arrows_of, by_number

if TYPE_CHECKING:
    from dmotion_bench.actions import ActionSpec, ActionTaken

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
    from dmotion_bench.errors import UsageError
    from dmotion_bench.viewing.viewer import require_display
    from dmotion_bench.workspace import Workspace

    if save is not None and save.suffix != ".rrd":
        raise UsageError(f"--save {str(save)!r} must end in .rrd, as Rerun knows its files by it.")
    terminal = require_terminal("dmbench play")
    workspace = Workspace.current()
    path = workspace.run(run)
    if not web and save is None:
        require_display()

    from dmotion_bench.api.driving import open_driven
    from dmotion_bench.cli.live import live_recording

    driven = open_driven(path, episode, workspace)
    actions = driven.actions
    known = moves(actions, arrows_of(driven.dataset, actions) if isinstance(actions, Continuous) else None)
    window = not web and save is None
    with (
        contextlib.closing(driven),
        live_recording(driven.title, driven.blueprint, window=window, web=web, save=save, linger=False) as log,
    ):
        taken = list[str]()
        driven.begin(log)
        typer.echo(_legend(known), err=True)
        with single_keys(terminal):
            for move in commands(read_keys(terminal), known):
                driven.move(log, None if move is None else move.action)
                if move is None:
                    taken.clear()
                else:
                    taken.append(move.name)
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
