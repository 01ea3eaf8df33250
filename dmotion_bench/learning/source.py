"""The code of a model: hashes by which a run notices that it is no longer the one that was trained.

A run holds the hash of every module that its class is made of: those of the class and of its bases, and what they
import at their top from their own packages. The core is not among them; its version stands in the run. Comments,
docstrings and layout do not count; of a script that is run, only its classes and functions do. A class that is written
in a notebook has no file, and so no hash. Files are read when a run begins: a change between the import of a module
and that moment is taken for what was trained.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import inspect
import sys
import warnings
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

from dmotion_bench.errors import DmbenchError
from dmotion_bench.registry import model_class

MOST_MODULES: Final = 200
"""Of a model; further ones are not looked at."""
_CORE: Final = __name__.partition(".")[0]
_NOT_THE_MODELS: Final = {_CORE, "torch", "builtins", "abc", "typing"}
_END: Final = object()


def code_of(model: str) -> dict[str, str]:
    """The SHA-256 of each module that a registered model is made of, by the module's name; none if it is not here."""
    try:
        kind: type = model_class(model)
    except DmbenchError:
        return {}
    found: dict[str, str] = {}
    waiting = [base.__module__ for base in inspect.getmro(kind) if _package(base.__module__) not in _NOT_THE_MODELS]
    while waiting and len(found) < MOST_MODULES:
        module = sys.modules.get(name := waiting.pop())
        if name in found or module is None or (file := getattr(module, "__file__", None)) is None:
            continue
        try:
            found[name], imported = _read(Path(file).read_bytes(), name, module.__package__)
        except (OSError, SyntaxError, ValueError, ImportError, RecursionError, MemoryError):
            continue  # compiled, or just being edited
        waiting += imported
    return dict(sorted(found.items()))


def changed_modules(recorded: Mapping[str, str], model: str) -> list[str]:
    """Those modules of a model whose code is another one than was recorded, by name; not those that are gone."""
    if not recorded:
        return []
    now = code_of(model)
    return [name for name, told in recorded.items() if name in now and now[name] != told]


def _package(module: str) -> str:
    return module.partition(".")[0]


@lru_cache(maxsize=5 * MOST_MODULES)
def _read(source: bytes, name: str, package: str | None) -> tuple[str, tuple[str, ...]]:
    """The hash of a module, and what it imports from its own package: modules, and perhaps names that are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whoever imports the module is told of them
        tree = ast.parse(source)
    imported = [one for one in _imported(tree, package) if _package(one) == _package(name)]
    if name == "__main__":
        tree.body = [one for one in tree.body if isinstance(one, ast.ClassDef | ast.FunctionDef)]
    return _hash_of(tree), tuple(imported)


def _imported(tree: ast.Module, package: str | None) -> Iterator[str]:
    """What a module's own statements import."""
    for statement in tree.body:
        if isinstance(statement, ast.Import):
            yield from (one.name for one in statement.names)
        elif isinstance(statement, ast.ImportFrom):
            written = "." * statement.level + (statement.module or "")
            source = importlib.util.resolve_name(written, package) if statement.level else written
            yield source
            yield from (f"{source}.{one.name}" for one in statement.names)


def _hash_of(tree: ast.Module) -> str:
    """The hash of what a file means: its syntax without texts that nobody reads, alike in all Python versions."""
    told, stack = hashlib.sha256(), list[object]([tree])
    while stack:
        node = stack.pop()
        if isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and isinstance(node.value.value, str):
            continue
        if isinstance(node, ast.JoinedStr):  # Python 3.12 adds empty pieces
            node.values = [one for one in node.values if not (isinstance(one, ast.Constant) and one.value == "")]
        if isinstance(node, ast.AST):
            told.update(f"{type(node).__name__}(".encode())
            stack.append(_END)
            for name, value in reversed(list(ast.iter_fields(node))):
                if value not in (None, []):  # fields that only later versions have
                    stack += [value, name]
        elif isinstance(node, list):
            told.update(b"[")
            stack += [_END, *reversed(node)]
        else:
            told.update(b")" if node is _END else f"{node!r},".encode())
    return told.hexdigest()
