"""The hash of classes as they are defined in this process, whatever a file says of them.

Of a function its source counts where Python has it, as in a notebook, without comments and docstrings; elsewhere its
bytecode and constants do, which another version of Python may write otherwise. What a function holds of the function
around it counts, too, and so do the functions and classes that it calls from its own module.
"""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import inspect
import textwrap
from collections.abc import Iterator, Sequence
from functools import cached_property
from types import CellType, CodeType, FunctionType
from typing import Any

from dmotion_bench.learning.runs.syntax_hash import hash_of


def hash_of_classes(kinds: Sequence[type]) -> str:
    """The SHA-256 of some classes of one module, in their order."""
    seen: set[int] = set()
    told = hashlib.sha256()
    for kind in kinds:
        for part in _class_parts(kind, seen):
            told.update(f"{part},".encode(errors="backslashreplace"))
    return told.hexdigest()


def _class_parts(kind: type, seen: set[int]) -> Iterator[str]:
    """What a class consists of; its bases are not looked at."""
    seen.add(id(kind))
    yield "class"
    for name, value in sorted(vars(kind).items()):
        special = name.startswith("__") and name.endswith("__")
        if special and not isinstance(value, FunctionType | classmethod | staticmethod):
            continue  # such as where it was defined
        if dataclasses.is_dataclass(kind) and _is_generated(value):
            continue  # made of the fields
        yield name
        yield from _parts(value, kind.__module__, seen)


def _parts(value: Any, module: str, seen: set[int]) -> Iterator[str]:
    """What a value of a class, or one that its functions use, consists of."""
    if isinstance(value, classmethod | staticmethod):
        value = value.__func__
    if isinstance(value, cached_property):
        value = value.func
    value = inspect.unwrap(value) if isinstance(value, FunctionType) else value
    if isinstance(value, property):
        for function in (value.fget, value.fset, value.fdel):
            yield from _parts(function, module, seen)
    elif isinstance(value, FunctionType | type):
        if id(value) in seen or value.__module__ != module:
            yield value.__qualname__
        elif isinstance(value, type):
            yield from _class_parts(value, seen)
        else:
            yield from _function_parts(value, seen)
    elif isinstance(value, tuple):
        yield "("
        for one in value:
            yield from _parts(one, module, seen)
        yield ")"
    elif isinstance(value, list | dict) and id(value) not in seen:
        seen.add(id(value))
        yield from _parts(tuple(value.items() if isinstance(value, dict) else value), module, seen)
    elif value is None or isinstance(value, bool | int | float | complex | str | bytes):
        yield repr(value)
    elif isinstance(value, frozenset):
        yield from sorted(repr(one) for one in value)
    elif isinstance(value, CodeType):
        yield value.co_code.hex()
        yield repr((value.co_names, value.co_varnames))
        yield from _parts(value.co_consts, module, seen)
    else:
        yield type(value).__qualname__


def _function_parts(function: FunctionType, seen: set[int]) -> Iterator[str]:
    seen.add(id(function))
    module, code = function.__module__, function.__code__
    try:
        yield hash_of(ast.parse(textwrap.dedent(inspect.getsource(function))))
    except (OSError, TypeError, SyntaxError, ValueError, RecursionError, MemoryError):
        yield from _parts(code, module, seen)
    held = (*(function.__defaults__ or ()), *sorted((function.__kwdefaults__ or {}).items()))
    yield from _parts(held, module, seen)
    yield from _parts(tuple(map(_content, function.__closure__ or ())), module, seen)
    for name in sorted(_names(code)):
        used = function.__globals__.get(name)
        if isinstance(used, FunctionType | type) and used.__module__ == module:
            yield name
            yield from _parts(used, module, seen)


def _content(cell: CellType) -> Any:
    try:
        return cell.cell_contents
    except ValueError:  # nothing was put into it yet
        return None


def _names(code: CodeType) -> set[str]:
    """Every name that a function uses, and the functions within it."""
    return set(code.co_names).union(*(_names(one) for one in code.co_consts if isinstance(one, CodeType)))


def _is_generated(value: Any) -> bool:
    """Whether a dataclass's function has no source of its own."""
    function = inspect.unwrap(value) if isinstance(value, FunctionType) else None
    return isinstance(function, FunctionType) and function.__code__.co_filename == "<string>"
