"""What a measurement gave: a speed, or the sentence of what kept it from being measured."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from statistics import median
from typing import Any

from dmotion_bench.storage.json_fields import Fields


@dataclass(frozen=True, kw_only=True)
class Result:
    """One speed, measured in several rounds.

    Attributes:
        name: Fixed, for scripts: ``record[grid_world]``.
        unit: What was measured.
        rounds: The speed in each round.
        limits: What would have been reached in each round if only ``limit_name`` took time, measured in turn with
            ``rounds``; empty where nothing physical bounds it.
        limit_name: What that is.
        setting: Of several that were tried, the one that was fastest.
    """

    name: str
    unit: str
    rounds: tuple[float, ...]
    limits: tuple[float, ...] = ()
    limit_name: str = ""
    setting: str = ""

    @property
    def value(self) -> float:
        """The speed: the median over the rounds."""
        return median(self.rounds)

    @property
    def limit(self) -> float | None:
        """The limit: the median over the rounds, None where there is none."""
        return median(self.limits) if self.limits else None

    def to_json(self) -> dict[str, Any]:
        """All of it, as JSON's types."""
        return asdict(self) | {"value": self.value, "limit": self.limit}

    @classmethod
    def from_json(cls, fields: Fields) -> Result:
        """A result out of what ``to_json`` gave.

        Raises:
            ValueError: It is something else; the text says what is wrong.
        """
        rounds, limits = (_speeds(name, fields.many(name)) for name in ("rounds", "limits"))
        if not rounds or len(limits) not in (0, len(rounds)):
            raise ValueError(f"there are {len(rounds)} rounds and {len(limits)} limits")
        return cls(
            name=fields.text("name"),
            unit=fields.text("unit"),
            rounds=rounds,
            limits=limits,
            limit_name=fields.text("limit_name"),
            setting=fields.text("setting"),
        )


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A speed that could not be measured, such as that of a package's broken model.

    Attributes:
        name: Of the speed.
        said: Why not.
    """

    name: str
    said: str


def _speeds(name: str, values: Sequence[object]) -> tuple[float, ...]:
    if not all(type(value) in (int, float) and 0 < float(str(value)) < math.inf for value in values):
        raise ValueError(f"not all {name} are above zero")
    return tuple(float(str(value)) for value in values)
