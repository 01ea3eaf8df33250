"""What truly can be gained in a data set, as it is kept in the data set's cache: one JSON file with a checksum.

The file may be damaged, or somebody else's. It is bounded by what it could hold at most, and all that it says is held
against the data set before it is used.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.errors import DmbenchError
from dmotion_bench.planning.moments import Moment
from dmotion_bench.planning.tasks import as_problems, has_recorded_goals
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.atomic import write_atomically
from dmotion_bench.storage.json_file import LARGEST, MOST_VALUES, parse_json, read_json
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.tasks import ControlTask

FORMAT: Final = "dmbench-gain/1"

_LONGEST: Final = 28  # characters of a number, with what sets it apart
_ABOUT: Final = 32  # values of a moment besides what follows the sequences


@dataclass(frozen=True, kw_only=True)
class Truth:
    """What truly could be gained.

    Attributes:
        sequences: The same at every moment.
        moments: In the order of their episodes; empty if none of the sequences brings anything.
        oracle: Which sequence the true frames speak for, at each moment.
        recorded_goals: Whether the moments' goals are recorded frames, and none that the environment sets itself.
    """

    sequences: Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"]
    moments: Sequence[Moment]
    oracle: Int[np.ndarray, " m"]
    recorded_goals: bool


def keep(path: Path, key: Mapping[str, Any], truth: Truth) -> None:
    """Write what is known.

    Args:
        path: The file.
        key: Everything that decides it, as JSON's types.
        truth: What is known.
    """
    moments = [
        {"task": list(one.problem.task), "offset": one.offset, "now": one.now, "after": one.after.tolist()}
        for one in truth.moments
    ]
    told = {"key": key, "moments": moments, "oracle": truth.oracle.tolist(), "recorded_goals": truth.recorded_goals}
    known = json.dumps(told, sort_keys=True)
    content = {"format": FORMAT, "crc32": zlib.crc32(known.encode()), "known": known}
    write_atomically(path, json.dumps(content).encode())


def kept(
    path: Path,
    key: Mapping[str, Any],
    dataset: ReadableDataset,
    split: SplitName,
    sequences: Int[np.ndarray, "s h"] | Float[np.ndarray, "s h a"],
) -> Truth | None:
    """What a file knows; None where that is nothing, damaged, of something else, or cannot be.

    Also None if the environment sets the goals, or may do so (files of earlier releases do not tell), and is not here.

    Args:
        path: The file.
        key: As of ``keep``.
        dataset: Whose moments they are.
        split: Of their episodes.
        sequences: That are compared.
    """
    most = MOST_VALUES + int(dataset.rows.lengths.sum()) * (len(sequences) + _ABOUT)
    largest = LARGEST + most * _LONGEST
    try:
        content = read_json(path, largest=largest, most_values=most)
        if content["format"] != FORMAT or content["crc32"] != zlib.crc32(content["known"].encode()):
            return None
        known = parse_json(content["known"], largest=largest, most_values=most, nan=True)
        if known["key"] != json.loads(json.dumps(key)):
            return None
        found = [_moment(one, len(sequences)) for one in known["moments"]]
        oracle = _numbers(known["oracle"], len(found), below=len(sequences))
        episodes = set(dataset.split(split).tolist())
        if any(task.episode not in episodes for task, *_ in found):
            return None
        if any(task.goal >= dataset.rows.lengths[task.episode] for task, *_ in found):
            return None
    except (OSError, ValueError, KeyError, TypeError, AttributeError, OverflowError):  # JsonUnreadable is a ValueError
        return None
    try:
        recorded_goals = has_recorded_goals(dataset.recipe)
    except DmbenchError:  # the environment is not here
        recorded_goals = known.get("recorded_goals") is True
        if not recorded_goals:
            return None
    problems = as_problems(dataset, dict(enumerate(task for task, *_ in found)), recorded_goals=recorded_goals)
    moments = [
        Moment(problem=problem, offset=offset, now=now, after=after)
        for problem, (_, offset, now, after) in zip(problems, found, strict=True)
    ]
    return Truth(sequences=sequences, moments=moments, oracle=oracle, recorded_goals=recorded_goals)


def _moment(stored: Mapping[str, Any], sequences: int) -> tuple[ControlTask, int, float, Float[np.ndarray, " s"]]:
    """A moment's task, offset, present distance and what follows each sequence.

    Raises:
        ValueError: They are none.
    """
    task = ControlTask(*_numbers(stored["task"], 3, below=2**31).tolist())
    (offset,) = _numbers([stored["offset"]], 1, below=2**31).tolist()
    after = np.array(stored["after"], np.float64)
    if not task.start + offset < task.goal or after.shape != (sequences,):
        raise ValueError("a moment that is none")
    return task, offset, float(stored["now"]), after


def _numbers(stored: Any, count: int, *, below: int) -> Int[np.ndarray, " n"]:
    """So many whole numbers from 0 on.

    Raises:
        ValueError: They are something else.
    """
    numbers = np.array(stored) if stored else np.zeros(0, np.int64)  # an empty list has no type
    if numbers.dtype != np.int64 or numbers.shape != (count,) or not ((numbers >= 0) & (numbers < below)).all():
        raise ValueError("no whole numbers")
    return numbers
