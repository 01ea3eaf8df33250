"""What a solver, an objective or a model breaks of its contract is said in a sentence that names class and method."""

from __future__ import annotations

import contextlib
import sys
import traceback
from collections.abc import Callable, Iterator
from pathlib import Path

import torch

from dmotion_bench.errors import DmbenchError, ModelContractBroken, PlannerContractBroken


def calling(part: object, method: str) -> contextlib.AbstractContextManager[None]:
    """Turn an error of a solver, an objective or an evaluator into one that names the method.

    Raises:
        PlannerContractBroken: The method raised something else than a ``DmbenchError``.
    """
    return _naming(part, method, broken)


def predicting(model: object, method: str) -> contextlib.AbstractContextManager[None]:
    """Turn an error of a model into one that names the model's method, and not the solver that asked for it.

    Raises:
        ModelContractBroken: The method raised something else than a ``DmbenchError``.
    """
    return _naming(model, method, _broken_model)


@contextlib.contextmanager
def using(model: object) -> Iterator[None]:
    """Turn an error that a model's own file raises into one that names the method there, whoever called it.

    An error that does not pass through that file is left as it is: it is not the model's.

    Args:
        model: A model, or its class.

    Raises:
        ModelContractBroken: The model raised something else than a ``DmbenchError``.
    """
    try:
        yield
    except (DmbenchError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # as above
        own = _own_file(model)
        methods = [place.name for place in traceback.extract_tb(error.__traceback__) if place.filename == own]
        if not methods:
            raise
        raise _broken_model(model, methods[0], _raised(model, error)) from error


@contextlib.contextmanager
def _naming(part: object, method: str, breach: Callable[[object, str, str], DmbenchError]) -> Iterator[None]:
    try:
        yield
    except (DmbenchError, MemoryError, torch.OutOfMemoryError):
        raise
    except Exception as error:  # somebody else's part may raise anything
        raise breach(part, method, _raised(part, error)) from error


def _raised(part: object, error: Exception) -> str:
    """What was raised, and the last line of the part's own file that led to it."""
    places = traceback.extract_tb(error.__traceback__)
    own = _own_file(part)
    place = next((one for one in reversed(places) if one.filename == own), places[-1])
    told = f"raised {type(error).__name__} in line {place.lineno} of {Path(place.filename).name}"
    said = str(error).rstrip(".")
    return f"{told}: {said}" if said else told


def _own_file(part: object) -> str | None:
    """Where a part's class is defined; None in a notebook."""
    return getattr(sys.modules.get(_class_of(part).__module__), "__file__", None)


def _class_of(part: object) -> type:
    return part if isinstance(part, type) else type(part)


def require(part: object, method: str, holds: bool, sentence: str) -> None:
    """Raise an error that says what a method did wrong, unless the condition holds.

    Raises:
        PlannerContractBroken: It does not.
    """
    if not holds:
        raise broken(part, method, sentence)


def _broken_model(model: object, method: str, sentence: str) -> ModelContractBroken:
    return ModelContractBroken(
        f"{_class_of(model).__qualname__}.{method} {sentence}. The contract is in docs/your_model.md; "
        "dmotion_bench.testing.check_model checks it."
    )


def broken(part: object, method: str, sentence: str) -> PlannerContractBroken:
    """The error for a breach."""
    return PlannerContractBroken(
        f"{type(part).__qualname__}.{method} {sentence}. The contract is in docs/your_planner.md; "
        "dmotion_bench.testing checks it."
    )
