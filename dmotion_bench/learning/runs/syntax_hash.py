"""The hash of what Python source means: comments, docstrings and layout do not count."""

from __future__ import annotations

import ast
import hashlib
from typing import Final

_END: Final = object()


def hash_of(tree: ast.Module) -> str:
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
