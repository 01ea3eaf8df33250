"""The code of a model: hashes by which a run notices that it is no longer the one that was trained.

A run holds the hash of every module that its class is made of: those of the class and of its bases, and what they
import at their top from their own packages and from files and packages beside them, unless that is where packages are
installed. The core is not among them; its version stands in the run. Comments, docstrings and layout do not count; of a
script that is run, only its classes and functions do. Files are read when a
run begins: a change between the import of a module and that moment is taken for what was trained.

A class that is written in a notebook or at the prompt has no file, and one of a script may be defined again while the
script runs. Of these the class itself is hashed (``defined_class.py``).
"""

from __future__ import annotations

import ast
import importlib.util
import inspect
import sys
import warnings
from collections.abc import Iterator, Mapping
from functools import lru_cache
from pathlib import Path
from typing import Final

from dmotion_bench.errors import DmbenchError
from dmotion_bench.learning.runs.defined_class import hash_of_classes
from dmotion_bench.learning.runs.syntax_hash import hash_of
from dmotion_bench.registry import model_class

MOST_MODULES: Final = 200
"""Of a model; further ones are not looked at."""
_CORE: Final = __name__.partition(".")[0]
_INSTALLED: Final = ("site-packages", "dist-packages")
_NOT_THE_MODELS: Final = {_CORE, "torch", "builtins", "abc", "typing"}


def code_of(model: str) -> dict[str, str]:
    """The SHA-256 of each module that a registered model is made of, by the module's name; none if it is not here.

    Of a module whose file does not tell the classes, that of the model's own classes, as ``"classes of __main__"``.
    """
    try:
        kind: type = model_class(model)
    except DmbenchError:
        return {}
    bases = [base for base in inspect.getmro(kind) if _package(base.__module__) not in _NOT_THE_MODELS]
    found: dict[str, str] = {}
    for name in {base.__module__ for base in bases}:
        if name == "__main__" or getattr(sys.modules.get(name), "__file__", None) is None:
            found[f"classes of {name}"] = hash_of_classes([base for base in bases if base.__module__ == name])
    waiting = [base.__module__ for base in bases]
    while waiting and len(found) < MOST_MODULES:
        module = sys.modules.get(name := waiting.pop())
        if name in found or module is None or (file := getattr(module, "__file__", None)) is None:
            continue
        try:
            found[name], imported = _read(Path(file).read_bytes(), name, module.__package__)
        except (OSError, SyntaxError, ValueError, ImportError, RecursionError, MemoryError):
            continue  # compiled, or just being edited
        waiting += [one for one in imported if _is_own(one, name)]
    return dict(sorted(found.items()))


def changed_modules(recorded: Mapping[str, str], model: str) -> list[str]:
    """Those modules of a model whose code is another one than was recorded, by name; not those that are gone."""
    if not recorded:
        return []
    now = code_of(model)
    return [name for name, told in recorded.items() if name in now and now[name] != told]


def _package(module: str) -> str:
    return module.partition(".")[0]


def _is_own(module: str, importing: str) -> bool:
    """Whether somebody who wrote a module wrote one that it imports, too: one of its package, or beside it."""
    if _package(module) in _NOT_THE_MODELS:
        return False
    folder = _folder(module)
    same = folder is not None and folder == _folder(importing) and folder.name not in _INSTALLED
    return same or _package(module) == _package(importing)


def _folder(module: str) -> Path | None:
    """Where the file of a module, or the folder of its package, lies."""
    file = getattr(sys.modules.get(_package(module)), "__file__", None)
    if file is None:
        return None
    path = Path(file).resolve()
    return path.parent.parent if path.stem == "__init__" else path.parent


@lru_cache(maxsize=5 * MOST_MODULES)
def _read(source: bytes, name: str, package: str | None) -> tuple[str, tuple[str, ...]]:
    """The hash of a module, and what it imports: modules, and perhaps names that are none."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # whoever imports the module is told of them
        tree = ast.parse(source)
    imported = tuple(_imported(tree, package))
    if name == "__main__":
        tree.body = [one for one in tree.body if isinstance(one, ast.ClassDef | ast.FunctionDef)]
    return hash_of(tree), imported


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
