"""Commands that are numbers -> one action for each step between two frames, and the bounds of all actions.

Decision 059 says which commands count for which step, decision 060 where the bounds come from.
"""

from __future__ import annotations

import difflib
from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Final

import numpy as np
from jaxtyping import Float, Int64, Shaped

from dmotion_bench.actions import MOST_NUMBERS, Continuous
from dmotion_bench.errors import InvalidSetting, RecordingImportError
from dmotion_bench.storage.imports.timeline import ROUNDED_NS, Piece
from dmotion_bench.wording import shown

MEANT: Final = 3  # fields that are suggested
LONGEST: Final = 100  # characters of a number's name
FORGIVEN: Final = 4  # a command may come a quarter of a step before its frame
LOST: Final = 100  # one command in so many may be missing
EXACT: Final = 2**53  # beyond it whole numbers have no place in 64 bits of floating point


class Reduce(StrEnum):
    """What several commands between two frames become."""

    LAST = "last"  # the command in force halfway to the next frame
    MEAN = "mean"  # their mean; the command in force where there is none
    SUM = "sum"  # their sum; zeros where there is none


@dataclass(frozen=True, kw_only=True)
class ContinuousCommands:
    """The commands of a recording that are numbers, in time order.

    Attributes:
        times_ns: When each was given.
        values: All finite, in the recording's units.
        names: Of the numbers of a command.
        stated: Bounds and units, where the recording says them.
        of_pictures: Whether command i was stored together with picture i, so that none can be early or late.
    """

    times_ns: Int64[np.ndarray, " n"]
    values: Float[np.ndarray, "n a"]
    names: tuple[str, ...]
    stated: Continuous | None = None
    of_pictures: bool = False


def first_commands(commands: ContinuousCommands, piece: Piece) -> Int64[np.ndarray, " t"]:
    """The number of the first command that counts for the step after each tick; the step ends where the next begins.

    A command that was stored with a picture counts from that picture on. Any other may come a quarter of a step early.
    """
    if commands.of_pictures:
        with_picture: Int64[np.ndarray, " t"] = np.minimum(piece.frames, len(commands.times_ns))
        return with_picture
    early = np.diff(piece.t_ns) // FORGIVEN + ROUNDED_NS
    begin = np.append(piece.t_ns[:-1] - early, piece.t_ns[-1] - early[-1:])
    first: Int64[np.ndarray, " t"] = np.searchsorted(commands.times_ns, begin, side="left").astype(np.int64)
    return first


def reduced(
    commands: ContinuousCommands, latest: Int64[np.ndarray, " s"], piece: Piece, how: Reduce
) -> Float[np.ndarray, "s a"]:
    """The action of each step between two ticks; ``first_commands`` says which commands the mean and the sum are of.

    A single command is taken as it is, to the bit.

    Args:
        commands: Of the recording.
        latest: The number of the command in force halfway through each step.
        piece: The ticks, one more than steps.
        how: What several commands become.
    """
    held: Float[np.ndarray, "s a"] = commands.values[latest]
    if how is Reduce.LAST:
        return held
    edges = first_commands(commands, piece)
    first, counts = edges[:-1], np.diff(edges)
    actions: Float[np.ndarray, "s a"] = held.copy() if how is Reduce.MEAN else np.zeros_like(held)
    some = counts > 0
    if some.any():
        with np.errstate(over="ignore"):
            sums = np.add.reduceat(commands.values[: edges[-1]], first[some], axis=0)
        actions[some] = sums / counts[some, None] if how is Reduce.MEAN else sums
    return actions


def commands_within(commands: ContinuousCommands, t_ns: Int64[np.ndarray, " t"]) -> int:
    """How many commands there are over the time of some ticks, a tick more at either end."""
    tick = (t_ns[-1] - t_ns[0]) // max(len(t_ns) - 1, 1)
    first, end = np.searchsorted(commands.times_ns, [t_ns[0] - tick, t_ns[-1] + tick])
    return int(end - first)


def bounded(
    recordings: Sequence[ContinuousCommands], actions: Sequence[Float[np.ndarray, "s a"]], how: Reduce
) -> Continuous:
    """What the actions of a data set are: as the recordings state it, or within their smallest and largest numbers.

    A number that never changes has room of its own size to both sides, 1 at least.

    Args:
        recordings: With the same names.
        actions: Of all episodes.
        how: They came about; a sum can be larger than any command, so stated bounds do not hold for it.

    Raises:
        RecordingImportError: The recordings disagree about the names, or an action cannot be.
    """
    first = recordings[0]
    other = next((one for one in recordings if one.names != first.names), None)
    if other is not None:
        raise RecordingImportError(
            f"the recordings have different actions: {_listed(first.names)} in one, {_listed(other.names)} in another; "
            "name what they share with '--action-fields', or import them into data sets of their own."
        )
    values = np.concatenate([action for action in actions if len(action)])
    if not np.isfinite(values).all():
        raise RecordingImportError(
            f"the {how} of the commands between two frames is too large for a number; take '--action-reduce last'."
        )
    stated = first.stated
    if how is not Reduce.SUM and stated is not None and all(one.stated == stated for one in recordings):
        if fault := stated.fault(values, "in action"):
            raise RecordingImportError(f"the recording contradicts its own bounds: it holds {fault}.")
        return stated
    low, high = values.min(0), values.max(0)
    room = np.where(low == high, np.maximum(np.abs(low), 1.0), 0.0)
    units = stated.units if stated is not None else ("",) * len(first.names)
    try:
        return Continuous(
            names=first.names, low=tuple((low - room).tolist()), high=tuple((high + room).tolist()), units=units
        )
    except InvalidSetting as error:
        raise RecordingImportError(f"the actions cannot be imported: {error}") from error


class BadCommands(Exception):
    """Rows that are no commands; the reason, for the sentence of the file's reader."""


def from_rows(
    rows: Shaped[np.ndarray, "n *a"],
    times_ns: Int64[np.ndarray, " n"],
    feature: str,
    *,
    names: Sequence[str] = (),
    fields: Sequence[str] = (),
    stated: Continuous | None = None,
    most: int,
) -> ContinuousCommands:
    """The commands of a format that keeps them as a table.

    Args:
        rows: Of numbers: one for each picture, of which the last need not be finite, or one less: the last leads to no
            picture.
        times_ns: When each picture was taken.
        feature: What the format calls them.
        names: Of the columns; where there are not as many, ``feature`` and a number.
        fields: The columns that are wanted; none for all.
        stated: Bounds of all columns, where the format says them.
        most: Numbers that there may be.

    Raises:
        BadCommands: They are no such table.
    """
    values = rows[:, None] if rows.ndim == 1 else rows
    if values.ndim != 2 or values.dtype.kind not in "fiu":
        raise BadCommands(f"holds {values.dtype} of the shape {rows.shape} as actions, not rows of numbers")
    if values.size > most:
        raise BadCommands(f"holds {values.size:,} numbers as actions, more than the {most:,} that can be imported")
    exact = values.astype(np.float64)
    if values.dtype.kind != "f" and (np.abs(exact) > EXACT).any():
        raise BadCommands("holds whole numbers as actions that are too large to be kept exactly")
    if values.dtype.itemsize > 8 and (exact != values).any():
        raise BadCommands(f"holds {values.dtype} as actions, more digits than can be kept")
    columns = column_names(feature, names, values.shape[1])
    if len(columns) > MOST_NUMBERS:
        raise BadCommands(f"holds {name_fault(columns)}")
    wanted = places_of(fields, columns) if fields else list(range(len(columns)))
    chosen, numbers = tuple(columns[place] for place in wanted), exact[:, wanted]
    if len(numbers) == len(times_ns) and not np.isfinite(numbers[-1:]).all():
        numbers = numbers[:-1]
    fault = name_fault(chosen) or value_fault(chosen, numbers)
    if fault:
        raise BadCommands(
            f"holds {fault}; cut it out, choose other numbers with '--action-fields', or leave '--actions' out"
        )
    if stated is not None and stated.names != columns:
        raise BadCommands(f"states bounds of {_listed(stated.names)}, and its numbers are {_listed(columns)}")
    if stated is not None:
        low, high = (tuple(bound[place] for place in wanted) for bound in (stated.low, stated.high))
        stated = Continuous(names=chosen, low=low, high=high, units=tuple(stated.units[place] for place in wanted))
    given_ns = times_ns[: len(numbers)]
    return ContinuousCommands(times_ns=given_ns, values=numbers, names=chosen, stated=stated, of_pictures=True)


def places_of(fields: Sequence[str], columns: Sequence[str]) -> list[int]:
    """The places of fields among columns.

    Raises:
        BadCommands: One is not among them.
    """
    lacking = next((field for field in fields if field not in columns), None)
    if lacking is not None:
        raise BadCommands(
            f"has no field {shown(lacking)} in its actions; {meant(columns, lacking)} fields are: {_listed(columns)}"
        )
    return [columns.index(field) for field in fields]


def column_names(feature: str, names: Sequence[str], width: int) -> tuple[str, ...]:
    """What the columns of a table are called: as it says, or if that is not for all, ``feature`` and a number."""
    return tuple(names) if len(names) == width else tuple(f"{feature}.{number}" for number in range(width))


def meant(known: Sequence[str], field: str) -> str:
    """Which fields somebody may have meant, to precede "fields are": those whose last part it is, or a similar one."""
    asked, alike = _as_path(field), {_as_path(name): name for name in known}
    near = [name for path, name in alike.items() if path.endswith(f".{asked}")][:MEANT]
    near = near or [alike[path] for path in difflib.get_close_matches(asked, alike, 1)]
    return f"did you mean {' or '.join(map(shown, near))}? Its" if near else "its"


def _as_path(field: str) -> str:
    """A field in lower case as fields are written here: ``data.0`` where others write ``Data[0]`` or ``data/0``."""
    return field.casefold().replace("[", ".").replace("]", "").replace("/", ".").strip(".")


def name_fault(names: Sequence[str]) -> str | None:
    """Why numbers cannot have these names, to follow "holds"; None if they can."""
    if not 1 <= len(names) <= MOST_NUMBERS:
        return f"{len(names):,} numbers a command; there can be 1 to {MOST_NUMBERS}"
    for name in names:
        if not 0 < len(name) <= LONGEST or not name.isprintable():
            return f"a number called {shown(name)}; a name has 1 to {LONGEST} printable characters"
    if len(set(names)) < len(names):
        return f"two numbers of the same name: {_listed(names)}"
    return None


def value_fault(names: Sequence[str], values: Float[np.ndarray, "n a"], where: str = "in command") -> str | None:
    """Which value is not finite, to follow "holds"; None if all are."""
    wrong = np.argwhere(~np.isfinite(values))
    if not len(wrong):
        return None
    row, place = wrong[0].tolist()
    return f"{shown(names[place])} = {values[row, place]} {where} {row}; a command must be finite"


def _listed(names: Sequence[str]) -> str:
    return ", ".join(map(shown, names[:30])) + (f" ... ({len(names)} in all)" if len(names) > 30 else "")
