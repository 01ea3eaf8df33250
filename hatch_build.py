"""Builds the wheel: everything in it lies in the one package ``dmotion_bench``.

In the repository ``recorders``, ``baselines`` and ``leaderboard`` are folders at the top. In a wheel they would be
packages at the top of everyone's environment, where another distribution has a package ``baselines``: pip would mix the
files of both, and uninstalling one would break the other. The wheel therefore holds ``dmotion_bench.recorders``,
``dmotion_bench.baselines`` and ``dmotion_bench.leaderboard``, and the imports and entry points that name them say so.
An editable installation is left as it is.
"""

from __future__ import annotations

import ast
import shutil
import tempfile
from pathlib import Path
from typing import Any

from hatchling.builders.hooks.plugin.interface import BuildHookInterface

CORE = "dmotion_bench"
MOVED = ("recorders", "baselines", "leaderboard")


class OnePackage(BuildHookInterface):
    """Moves the packages of ``MOVED`` into ``CORE`` in a wheel."""

    PLUGIN_NAME = "custom"

    _copies: Path | None = None

    def initialize(self, version: str, build_data: dict[str, Any]) -> None:
        """Add the moved modules to the wheel, and name them in its entry points.

        Args:
            version: ``"standard"`` or ``"editable"``.
            build_data: What the wheel's builder reads; ``force_include`` maps a file to its place in the wheel.

        Raises:
            ValueError: A module is imported in a way that cannot be moved.
        """
        if version != "standard":
            return
        self._copies = Path(tempfile.mkdtemp(prefix="dmbench-wheel-"))
        for package in MOVED:
            for path in sorted(Path(self.root, package).rglob("*")):
                if path.is_dir() or "__pycache__" in path.parts:
                    continue
                place = path.relative_to(self.root)
                copy = self._copies / place
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(path, copy)
                if path.suffix == ".py":
                    copy.write_text(moved(path.read_text(encoding="utf-8"), place.as_posix()), encoding="utf-8")
                build_data["force_include"][str(copy)] = f"{CORE}/{place.as_posix()}"
        for points in self.metadata.core.entry_points.values():
            for name, target in points.items():
                if target.partition(".")[0] in MOVED:
                    points[name] = f"{CORE}.{target}"

    def finalize(self, version: str, build_data: dict[str, Any], artifact_path: str) -> None:
        """Remove the copies."""
        if self._copies is not None:
            shutil.rmtree(self._copies)
            self._copies = None


def moved(source: str, place: str) -> str:
    """A module's text with the imports of moved packages pointing into ``CORE``; each line stays where it is.

    Args:
        source: The module's text.
        place: Its path, for the error.

    Raises:
        ValueError: An import binds the name of a moved package; only ``from baselines.x import y`` can be moved.
    """
    lines = source.splitlines(keepends=True)
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.Import) and any(one.name.partition(".")[0] in MOVED for one in node.names):
            raise ValueError(f"{place}, line {node.lineno}: write 'from ... import ...', which the wheel can move.")
        if isinstance(node, ast.ImportFrom) and not node.level and (node.module or "").partition(".")[0] in MOVED:
            line = lines[node.lineno - 1]
            before, rest = line[: node.col_offset], line[node.col_offset :]
            if not rest.startswith(f"from {node.module} import"):
                raise ValueError(f"{place}, line {node.lineno}: this import is not written in the usual way.")
            lines[node.lineno - 1] = f"{before}{rest.replace('from ', f'from {CORE}.', 1)}"
    return "".join(lines)
