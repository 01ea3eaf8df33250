"""A solver or an objective is a frozen dataclass whose fields have defaults."""

from __future__ import annotations

from typing import TypeVar

from dmotion_bench.errors import PlannerContractBroken
from dmotion_bench.learning.settings import to_json
from dmotion_bench.values import is_frozen_dataclass

_T = TypeVar("_T")


def built(kind: type[_T]) -> _T:
    """One of a class of solvers or objectives, with its defaults.

    Raises:
        PlannerContractBroken: The class is no frozen dataclass, or a field has no default.
        InvalidSetting: A field has a value that no report can hold.
    """
    name = getattr(kind, "__qualname__", repr(kind))
    if not isinstance(kind, type) or not is_frozen_dataclass(kind):
        raise _broken(f"{name} is no frozen dataclass; write @dataclass(frozen=True, kw_only=True) above the class")
    try:
        made = kind()
    except Exception as error:
        raise _broken(
            f"{name}() raised {type(error).__name__}: {str(error).rstrip('.')}; a field must have a default"
        ) from error
    to_json(made)  # as reports hold it
    return made


def _broken(sentence: str) -> PlannerContractBroken:
    return PlannerContractBroken(f"{sentence}. The contract is in docs/your_planner.md.")
