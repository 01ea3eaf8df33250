"""What a measurement gave: a speed, or the sentence of what kept it from being measured."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class Result:
    """One speed.

    Attributes:
        name: Fixed, for scripts: ``record[grid_world]``.
        value, unit: What was measured.
        limit: What would be reached if only ``limit_name`` took time; None where nothing physical bounds it.
        setting: Of several that were tried, the one that was fastest.
    """

    name: str
    value: float
    unit: str
    limit: float | None = None
    limit_name: str = ""
    setting: str = ""


@dataclass(frozen=True, kw_only=True)
class Failure:
    """A speed that could not be measured, such as that of a package's broken model.

    Attributes:
        name: Of the speed.
        said: Why not.
    """

    name: str
    said: str
