"""The progress of the control loop on disk, so that an interrupted run continues with the same result.

One JSON file: a key that says what the progress is of, the actions and distances of each task, and what the solver
of each unfinished group remembers. A file of another key is not taken up: it belongs to other weights, other tasks
or another solver. Neither is a damaged file, or one that holds what cannot have been done.
"""

from __future__ import annotations

import json
import logging
import time
import zlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Float, Int

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.planning.tasks import Problem, World
from dmotion_bench.storage.atomic import remove_leftovers, write_atomically
from dmotion_bench.storage.json_file import LARGEST, MOST_VALUES, read_json
from dmotion_bench.wording import sentence, shown

FORMAT: Final = "dmbench-control/2"
EARLIER_FORMAT: Final = "dmbench-control/1"
"""Of earlier releases, without a checksum; what the oracle did takes hours, so it is read still."""
WRITE_EVERY: Final = 5.0  # [s]

_LONGEST: Final = 28  # characters of a number, with what sets it apart
_LOST: Final = range(2**31)
_FRAMES: Final = range(2**63)
_log = logging.getLogger(__name__)

Memory = Int[np.ndarray, "b n t"] | Float[np.ndarray, "b n t a"]
"""What a solver remembers of each task: sequences of actions."""


@dataclass(kw_only=True)
class TaskRecord:
    """The actions and distances of one task so far.

    Attributes:
        actions: Taken so far: numbers, or of continuous actions lists; None for none of these.
        distance, lost: At the start and after each of them.
        frames: Predicted for it so far.
    """

    actions: list[int | list[float] | None] = field(default_factory=list)
    distance: list[float] = field(default_factory=list)
    lost: list[int] = field(default_factory=list)
    frames: int = 0

    def took(self, action: Any) -> None:
        """Append an action: a number, or those of a continuous one, NaN for none."""
        if not np.ndim(action):
            self.actions.append(int(action))
        else:
            self.actions.append(None if np.isnan(action).any() else [float(number) for number in action])

    def note(self, world: World) -> None:
        """Append the present distance and the number of lost objects."""
        self.distance.append(world.distance)
        self.lost.append(world.lost)


def as_array(spec: ActionSpec, records: Iterable[TaskRecord]) -> Any:
    """The actions of several tasks: a row a task, a column a step; NaN where no continuous action was taken."""
    taken = [record.actions for record in records]
    steps = len(taken[0]) if taken else 0
    if isinstance(spec, Discrete):
        return np.array(taken, np.int64).reshape(len(taken), steps)
    none = [float("nan")] * spec.width
    plain = [[none if action is None else action for action in own] for own in taken]
    return np.array(plain, np.float64).reshape(len(taken), steps, spec.width)


@dataclass(frozen=True, kw_only=True)
class Extent:
    """What a journal holds at most.

    Attributes:
        actions: What can be done.
        tasks: Of the data set.
        steps: Actions a task.
    """

    actions: ActionSpec
    tasks: int
    steps: int

    @property
    def values(self) -> int:
        """Numbers, texts and lists in the file."""
        wide = self.actions.width if isinstance(self.actions, Continuous) else 0
        return MOST_VALUES + self.tasks * (self.steps + 1) * (wide + 4) + 16 * self.tasks

    @property
    def bytes(self) -> int:
        """Size of the file."""
        return LARGEST + _LONGEST * self.values

    def record(
        self, number: int, actions: list[Any], distance: list[float], lost: list[int], frames: int
    ) -> TaskRecord:
        """The record of a task, from JSON.

        Raises:
            ValueError: There cannot be such a one.
        """
        if number not in range(self.tasks) or len(actions) > self.steps:
            raise ValueError("a record of something else")
        if not len(actions) + 1 == len(distance) == len(lost):
            raise ValueError("a record whose parts do not fit")
        record = TaskRecord(
            actions=[_action(action) for action in actions],
            distance=[float(value) for value in distance],
            lost=[int(value) for value in lost],
            frames=int(frames),
        )
        self._require_possible(record.actions)
        if not all(value in _LOST for value in record.lost) or record.frames not in _FRAMES:
            raise ValueError("a number that cannot be")
        return record

    def memory(self, stored: Mapping[str, Any]) -> dict[int, list[Any]]:
        """What a solver remembers of each task, from JSON.

        Raises:
            ValueError: It is something else than sequences of actions, as many and as long for every task.
        """
        memory = {int(number): own for number, own in stored.items()}
        found = np.array(list(memory.values()))
        kind, axes = (np.integer, 3) if isinstance(self.actions, Discrete) else (np.floating, 4)
        if memory and not (found.ndim == axes and np.issubdtype(found.dtype, kind)):
            raise ValueError("a memory that holds no sequences of actions")
        if isinstance(self.actions, Discrete):
            self._require_possible(found.ravel().tolist())
        elif memory and found.shape[-1] != self.actions.width:
            raise ValueError("a memory of other actions")
        return memory

    def _require_possible(self, actions: Sequence[int | list[float] | None]) -> None:
        none = -1 if isinstance(self.actions, Discrete) else None
        taken = [action for action in actions if action != none]
        if taken and (fault := self.actions.fault(taken)):
            raise ValueError(fault)


class Journal:
    """Keeps records in a file.

    Args:
        path: The file; None keeps nothing.
        key: What decides the result, as JSON's types.
        extent: A file that holds more, or anything else than it can, is begun anew.
        earlier: Keys of earlier releases that stand for the same result.
    """

    def __init__(
        self, path: Path | None, key: Mapping[str, Any], extent: Extent, *, earlier: Sequence[Mapping[str, Any]] = ()
    ) -> None:
        self._path, self._key, self._extent = path, json.loads(json.dumps(key)), extent
        self._accepted = [self._key, *(json.loads(json.dumps(one)) for one in earlier)]
        self._records: dict[int, TaskRecord] = {}
        self._memory: dict[int, list[Any]] = {}
        self._written = time.monotonic()
        if path is not None:
            remove_leftovers(path.parent)
            self._read(path)

    @classmethod
    def nowhere(cls) -> Journal:
        """A journal that keeps nothing."""
        return cls(None, {}, Extent(actions=Discrete.numbered(1), tasks=0, steps=0))

    def reached(self, number: int) -> int:
        """How many actions of a task are kept."""
        return len(self._records.get(number, TaskRecord()).actions)

    def all_records(self, problems: Sequence[Problem]) -> dict[int, TaskRecord]:
        """The records of some tasks; empty ones for tasks that have not begun."""
        return {problem.number: self._records.get(problem.number, TaskRecord()) for problem in problems}

    def records(self, problems: Sequence[Problem]) -> dict[int, TaskRecord]:
        """The records of a group of tasks; all empty if the tasks have not reached the same step."""
        known = self.all_records(problems)
        if len({len(record.actions) for record in known.values()}) > 1:
            known = {number: TaskRecord() for number in known}
        return known

    def memory(self, problems: Sequence[Problem]) -> Memory | None:
        """The solver's memory of these tasks; None if there is none."""
        found = [self._memory.get(problem.number) for problem in problems]
        if any(one is None for one in found):
            return None
        return np.array(found)

    def write(self, records: Mapping[int, TaskRecord], memory: Memory | None, *, last: bool) -> None:
        """Store these records; write them to disk every few seconds and after the group's last step.

        What a solver remembers of other tasks stays: shares that were taken over may be unfinished, too.
        """
        self._records.update(records)
        for number in records:
            self._memory.pop(number, None)
        if memory is not None and not last:
            self._memory.update({number: own.tolist() for number, own in zip(records, memory, strict=True)})
        if self._path is not None and (last or time.monotonic() - self._written >= WRITE_EVERY):
            content = {
                "format": FORMAT,
                "key": self._key,
                "tasks": {str(number): asdict(self._records[number]) for number in sorted(self._records)},
                "memory": {str(number): own for number, own in self._memory.items()},
            }
            write_atomically(self._path, json.dumps(content | {"crc32": _checksum(content)}).encode())
            self._written = time.monotonic()

    def take_over(self, share: Path, *, only: Collection[int] | None = None) -> None:
        """Take up the tasks of another journal of the same key, as far as it is ahead.

        Args:
            share: The file.
            only: Numbers of the tasks that are taken up; all of them by default.
        """
        other = Journal(None, self._key, self._extent)
        other._accepted = self._accepted
        other._read(share)
        for number, record in other._records.items():
            if only is not None and number not in only:
                continue
            if len(record.actions) > len(self._records.get(number, TaskRecord()).actions):
                self._records[number] = record
                self._memory.pop(number, None)
                if number in other._memory:
                    self._memory[number] = other._memory[number]

    def _read(self, path: Path) -> None:
        try:
            content = read_json(path, largest=self._extent.bytes, most_values=self._extent.values, nan=True)
            if content["format"] != EARLIER_FORMAT:
                _require_checksum(content)
            if content["format"] not in (FORMAT, EARLIER_FORMAT) or content["key"] not in self._accepted:
                return
            extent = self._extent
            records = {int(number): extent.record(int(number), **own) for number, own in content["tasks"].items()}
            memory = extent.memory(content["memory"])
        except FileNotFoundError:
            return
        except (OSError, ValueError, TypeError, KeyError, AttributeError, OverflowError) as error:
            _log.warning(
                "the progress in %s cannot be read, and is begun anew: %s", shown(str(path)), sentence(str(error))
            )
            return
        self._records, self._memory = records, memory


def _checksum(content: Mapping[str, Any]) -> int:
    return zlib.crc32(json.dumps(content).encode())


def _require_checksum(content: dict[str, Any]) -> None:
    """Take the checksum out of a file's content.

    Raises:
        ValueError: It is that of something else.
    """
    if content.pop("crc32") != _checksum(content):
        raise ValueError("it does not fit its checksum")


def _action(stored: Any) -> int | list[float] | None:
    if stored is None:
        return None
    return [float(number) for number in stored] if isinstance(stored, list) else int(stored)
