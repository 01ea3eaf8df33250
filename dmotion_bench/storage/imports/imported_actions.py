"""Commands of the recordings -> the actions of the episodes, discrete or continuous."""

from __future__ import annotations

import itertools
import math
from collections.abc import Sequence
from typing import Final

import numpy as np
from jaxtyping import Float, Int64

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.advice import SLOWEST_HZ
from dmotion_bench.storage.imports.commands import Commands, DiscreteCommands, in_force, ordered_names
from dmotion_bench.storage.imports.continuous_commands import (
    LONGEST,
    LOST,
    ContinuousCommands,
    Reduce,
    bounded,
    commands_within,
    first_commands,
    reduced,
)
from dmotion_bench.storage.imports.options import ImportOptions
from dmotion_bench.storage.imports.recording import Named, Survey
from dmotion_bench.storage.imports.timeline import Piece, interval_ns, steady_hz
from dmotion_bench.wording import duration, shown

SEVERAL: Final = 1.1
"""Commands a step from which on it is said that one is kept and the others are not."""
LISTED: Final = 10  # numbers that a sentence names
Actions = Int64[np.ndarray, " s"] | Float[np.ndarray, "s a"]


def discrete_names(surveys: Sequence[Survey], options: ImportOptions) -> tuple[str, ...]:
    """The names of discrete actions; none if the actions are continuous, or unknown.

    Raises:
        RecordingImportError: The recordings do not go together, or there are too many.
    """
    given = given_commands(surveys)
    discrete = [commands for commands in given if isinstance(commands, DiscreteCommands)]
    if discrete and len(discrete) < len(given):
        raise RecordingImportError(
            "the actions are discrete in one recording and continuous in another; import them into data sets of their "
            "own."
        )
    if options.action_reduce is not Reduce.LAST and (discrete or not given):
        what = "the actions are discrete" if discrete else "there are no actions"
        raise RecordingImportError(
            f"'--action-reduce {options.action_reduce}' is for continuous actions, and {what}; leave it out."
        )
    return ordered_names(discrete, options.limits.actions)


def given_commands(surveys: Sequence[Survey]) -> list[Commands]:
    """The commands of all segments that have any."""
    return [segment.commands for survey in surveys for segment in survey.segments if segment.commands is not None]


def action_spec(
    surveys: Sequence[Survey],
    episodes: Sequence[Actions | None],
    names: tuple[str, ...],
    options: ImportOptions,
) -> ActionSpec | None:
    """What the actions are; None where there are none.

    Args:
        surveys: Of the recordings.
        episodes: The actions of each.
        names: Of discrete actions.
        options: How they are imported.

    Raises:
        RecordingImportError: The recordings do not go together.
    """
    continuous = [commands for commands in given_commands(surveys) if isinstance(commands, ContinuousCommands)]
    if not continuous:
        return Discrete(names) if names else None
    return bounded(continuous, [actions for actions in episodes if actions is not None], options.action_reduce)


def constant_advice(actions: ActionSpec | None, episodes: Sequence[Actions | None]) -> tuple[str, ...]:
    """A sentence about what is the same in all actions, if there is anything: the choice, or some of the numbers.

    Args:
        actions: What they are.
        episodes: The actions of each.

    Raises:
        RecordingImportError: All numbers of continuous actions are: a model would learn what nothing depends on, within
            bounds made up.
    """
    if actions is None:
        return ()
    values = np.concatenate([one for one in episodes if one is not None and len(one)])
    if not isinstance(actions, Continuous):
        if len(values) == 1 or (values != values[0]).any():
            return ()
        name = actions.names[int(values[0])]
        return (
            f"all actions are {shown(name)}, so they tell nothing. If others are meant, name them with '--actions'.",
        )
    is_constant = (values == values[0]).all(axis=0)
    if len(values) == 1 or not is_constant.any():
        return ()
    still = [f"{actions.names[place]} is {values[0, place]:g}" for place in np.flatnonzero(is_constant)]
    listed = ", ".join(still[:LISTED]) + (f" ... ({len(still)} numbers in all)" if len(still) > LISTED else "")
    what = f"{listed} in all actions, so {'it tells' if len(still) == 1 else 'they tell'} nothing"
    if is_constant.all():
        raise RecordingImportError(
            f"{what}, and no other number was chosen. Name fields that change with '--action-fields', or import the "
            "video alone by leaving '--actions' out."
        )
    changing = [name for name, is_still in zip(actions.names, is_constant, strict=True) if not is_still]
    fits = len(",".join(changing)) <= LONGEST and not any("," in name for name in changing)
    others = f" {','.join(changing)}" if fits else ""
    without = f"leave {'it' if len(still) == 1 else 'them'} out with '--action-fields{others}'"
    return (f"{what}; {without}.",)


def commanded(piece: Piece, commands: Commands) -> Piece:
    """The piece without what comes before the first command."""
    before = int((in_force(commands, piece.t_ns) < 0).sum())
    return piece.cut(before, len(piece))


def check_pace(recording: Named, commands: Commands, pieces: Sequence[Piece], options: ImportOptions) -> None:
    """See that continuous commands are as many as steps: to hold one would be to say it again.

    Raises:
        RecordingImportError: They are fewer.
    """
    if not isinstance(commands, ContinuousCommands):
        return
    steps = sum(max(len(piece) - 1, 0) for piece in pieces)
    count = sum(commands_within(commands, piece.t_ns) for piece in pieces if len(piece) > 1)
    if count >= steps - steps // LOST:
        return
    usual = interval_ns(commands.times_ns)
    rate = 1e9 / usual if usual else 0.0
    slower = math.floor(100 * min(options.hz * count / steps, rate or options.hz)) / 100
    slow_down = f"Lower '--hz' to {slower:g}, or import" if slower >= SLOWEST_HZ else "Import"
    if rate >= options.hz * (1 - 1 / LOST):  # they pause or end: with fewer frames as many of them would lack one
        missing_s = steps / options.hz - count / rate
        slow_down = (
            f"They come at {rate:.3g} Hz and are missing for {duration(missing_s)} in all: cut the recording to where "
            "there are some, or import"
        )
    raise RecordingImportError(
        f"{str(recording.path)!r} has {count:,} commands on {options.actions!r} for {steps:,} steps between frames at "
        f"{options.hz:g} Hz; continuous actions need one for each step. {slow_down} the video alone by leaving "
        "'--actions' out."
    )


def pace_advice(given: Sequence[tuple[Piece, Commands | None]], options: ImportOptions) -> tuple[str, ...]:
    """Sentences about commands that are not kept, and about steps for which no continuous command came.

    Args:
        given: The episodes, each with the commands of its recording.
        options: How they are imported.
    """
    continuous = [(piece, commands) for piece, commands in given if isinstance(commands, ContinuousCommands)]
    steps = sum(len(piece) - 1 for piece, _ in continuous)
    without = sum(_without_command(piece, commands, options.action_reduce) for piece, commands in continuous)
    told = _dropped_choices([(piece, one) for piece, one in given if isinstance(one, DiscreteCommands)], options.hz)
    count = sum(int(np.ptp(first_commands(commands, piece)[[0, -1]])) for piece, commands in continuous)
    if options.action_reduce is Reduce.LAST and count >= SEVERAL * steps > 0:
        told.append(
            f"each action stands for {count / steps:.2g} commands, of which the one in force halfway is kept, as suits "
            "positions; '--action-reduce sum' adds displacements, 'mean' averages velocities."
        )
    if without <= steps // LOST:
        return tuple(told)
    instead = "their sum is zero" if options.action_reduce is Reduce.SUM else "they repeat an earlier one"
    return (
        *told,
        f"{without:,} of {steps:,} steps have no command of their own on {options.actions!r}: {instead}. If commands "
        "come slower than frames, lower '--hz'; if they pause, cut the pauses out of the recordings.",
    )


def _dropped_choices(given: Sequence[tuple[Piece, DiscreteCommands]], hz: float) -> list[str]:
    """A sentence about discrete commands that differ from those that are kept before and after them, if there are any.

    Args:
        given: The episodes, each with the commands of its recording.
        hz: Frames a second.
    """
    steps = commands_in_all = 0
    lossy = list[tuple[int, DiscreteCommands]]()
    for piece, commands in given:
        kept = in_force(commands, piece.t_ns)
        names = commands.names[kept[0] : kept[-1] + 1]
        changes = np.append(0, np.cumsum([one != two for one, two in itertools.pairwise(names)]))[kept - kept[0]]
        seen = [commands.names[one] != commands.names[two] for one, two in itertools.pairwise(kept.tolist())]
        lossy.append((int((np.diff(changes) > seen).sum()), commands))
        steps += len(kept) - 1
        commands_in_all += int(kept[-1] - kept[0])
    lost = sum(count for count, _ in lossy)
    if lost <= steps // LOST:
        return []
    rate = steady_hz(max(lossy, key=lambda one: one[0])[1].times_ns)
    way_out = f"'--hz {rate:.4g}' keeps all" if rate > hz else "a higher '--hz' keeps more"
    return [
        f"each action stands for {commands_in_all / steps:.2g} commands, of which the one in force halfway is kept, "
        f"and in {lost:,} of {steps:,} steps others are left out that differ; {way_out}."
    ]


def _without_command(piece: Piece, commands: ContinuousCommands, how: Reduce) -> int:
    """For how many steps no command came: none between their middle and the one before, or none to reduce."""
    if how is Reduce.LAST:
        step_before = piece.t_ns - np.diff(piece.t_ns)[0]
        return int((in_force(commands, piece.t_ns) == in_force(commands, step_before)).sum())
    return int((np.diff(first_commands(commands, piece)) == 0).sum())


def step_actions(piece: Piece, commands: Commands, names: tuple[str, ...], options: ImportOptions) -> Actions:
    """The action of each step of an episode: its number, or its vector."""
    if isinstance(commands, ContinuousCommands):
        return reduced(commands, in_force(commands, piece.t_ns), piece, options.action_reduce)
    numbers = {name: number for number, name in enumerate(names)}
    return np.array([numbers[commands.names[index]] for index in in_force(commands, piece.t_ns)], np.int64)
