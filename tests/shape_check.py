"""Shape annotations are checked at the first calls of a function in each test, and ever more rarely after them.

A check costs more than most small functions do. Of each function a test checks the first two calls and those whose
number is a power of two. What is checked does therefore not depend on other tests. An int may stand where a float is
asked for, as in PEP 484.
"""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Callable
from types import CodeType
from typing import Any

import beartype as _beartype
import jaxtyping

FIRST = 2
_calls: Counter[CodeType] = Counter()
_every_call = jaxtyping.jaxtyped
beartype = _beartype.beartype(conf=_beartype.BeartypeConf(is_pep484_tower=True))


def begin_test() -> None:
    """The next call of each function is its first one again."""
    _calls.clear()


def sparingly(function: Any = None, *, typechecker: Callable[..., Any]) -> Any:
    """Decorate in place of ``jaxtyping.jaxtyped``: the check of a function is made when it is first called."""
    if function is None:
        return functools.partial(sparingly, typechecker=typechecker)
    if not hasattr(function, "__code__"):  # a class: if a dataclass, its __init__ is checked at every call
        return _every_call(function, typechecker=typechecker)
    code, checked = function.__code__, None

    @functools.wraps(function)
    def called(*given: Any, **named: Any) -> Any:
        __tracebackhide__ = True
        nonlocal checked
        _calls[code] = number = _calls[code] + 1
        if number > FIRST and number & (number - 1):
            return function(*given, **named)
        if checked is None:
            checked = _every_call(function, typechecker=typechecker)
        return checked(*given, **named)

    return called
