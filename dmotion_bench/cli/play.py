"""``dmbench play``: drive a learned model with the arrow keys and see what it imagines."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Final

import numpy as np
import typer
from jaxtyping import Float

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.cli.arrows import Arrows, arrows_of, by_number
from dmotion_bench.cli.stdout import say
from dmotion_bench.wording import command, printable

if TYPE_CHECKING:
    from dmotion_bench.actions import ActionSpec, ActionTaken

ARROWS = ("up", "down", "left", "right")
NUDGE: Final = 0.05
"""The share of a number's range that a key moves it by, where commands are changed."""
_NAMED: Final = 10  # moves without a key


@dataclass(frozen=True)
class Move:
    """An action that keys stand for.

    Attributes:
        action: As an environment and a model take it; of a change, what is added to the present command.
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
    arrows, first = arrows_of(driven.dataset, actions) if isinstance(actions, Continuous) else None, None
    if isinstance(actions, Continuous) and (first := driven.first_command) is not None:
        known = changes(actions, arrows)
    else:
        known = moves(actions, arrows)
    window = not web and save is None
    with (
        contextlib.closing(driven),
        live_recording(
            driven.title, driven.blueprint, window=window, web=web, save=save, linger=lambda: False
        ) as shown,
    ):
        taken = list[str]()
        driven.begin(shown.recording)
        say(legend(known), err=True)
        with single_keys(terminal):
            for move, action in taken_actions(commands(read_keys(terminal), known), actions, first):
                if shown.closed():
                    break
                driven.move(shown.recording, action)
                if move is None:
                    taken.clear()
                else:
                    taken.append(move.name)
                _tell(taken)
    say("", err=True)
    if save is not None:
        say(f"Watch it with {command('dmbench view', save)}.")


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


def changes(actions: Continuous, arrows: Arrows | None = None) -> list[Move]:
    """What a user can choose from where commands are changed: each number, less or more by a share of its range.

    Args:
        actions: What can be done.
        arrows: The arrow keys; ``by_number`` by default.
    """
    arrows = by_number(actions) if arrows is None else arrows
    found = []
    for place, (name, unit) in enumerate(zip(actions.names, actions.units, strict=True)):
        for upper in (False, True):
            change = np.zeros(actions.width)
            change[place] = (2 * upper - 1) * NUDGE * 2 * actions.reach[place]
            found.append(
                Move(tuple(change.tolist()), f"{name}{change[place]:+.3g}{unit}", arrows.get((place, upper), ""))
            )
    return found


def taken_actions(
    chosen: Iterable[Move | None], actions: ActionSpec, first: Float[np.ndarray, " a"] | None
) -> Iterator[tuple[Move | None, ActionTaken | None]]:
    """Moves, each with its action; None, for starting again, goes back to the first command.

    Args:
        chosen: As ``commands`` yields them.
        actions: What can be done.
        first: The command that changes begin with, in the actions' units; None where moves are no changes.
    """
    command = first
    for move in chosen:
        if move is None or command is None or not isinstance(actions, Continuous):
            command = first
            yield move, None if move is None else move.action
        else:
            command = np.clip(command + np.asarray(move.action), actions.low, actions.high)
            yield move, tuple(command.tolist())


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


def legend(known: Sequence[Move]) -> str:
    """The keys and their moves, and the moves without a key."""
    arrows = set(ARROWS) <= {move.name for move in known}
    keys = {
        move: [key for key, bound in bindings(known).items() if bound is move and key != move.name] for move in known
    }
    told = ", ".join(f"{' or '.join(own)} {move.name}" for move, own in keys.items() if own)
    rest = [move.name for move, own in keys.items() if not own and move.arrow != move.name]
    more = f" and {len(rest) - _NAMED} more" if len(rest) > _NAMED else ""
    without = f"; without a key: {', '.join(rest[:_NAMED])}{more}" if rest else ""
    return f"{'arrow keys, or ' if arrows else ''}{told}; r starts over, q ends{without}."


def _tell(taken: Sequence[str]) -> None:
    last = " ".join(taken[-8:]) or "at the start"
    typer.echo(f"\r\x1b[K{len(taken)}: {printable(last)}", nl=False, err=True)
