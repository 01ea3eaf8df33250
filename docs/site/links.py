"""Where a link of a page leads on the site.

Pages link to each other and to files of the repository by relative paths, so that they can be read in the repository.
On the site a page of ``docs/`` stays where it is, a Markdown file at the top becomes a page of ``project/``, and any
other file or folder becomes a page of ``source/``.
"""

from __future__ import annotations

import posixpath
import re
from collections.abc import Callable
from pathlib import Path
from typing import Final

DOCS: Final = "docs/"
UNPUBLISHED: Final = "docs/site"
"""What builds the site is no part of it, and so has a page as other sources have."""

INDEXES: Final = {"docs/decisions": "DECISIONS.md"}
"""Folders that a page lists better than their files' names would."""

_CODE: Final = re.compile(r"(^(?P<fence>`{3,})[^\n]*\n.*?^(?P=fence)[ \t]*$|`[^`\n]+`)", re.MULTILINE | re.DOTALL)
_TARGET: Final = re.compile(r"(?P<before>\]\(|^\[[^\]]+\]: )(?P<target>[^)\s]+)", re.MULTILINE)
_ELSEWHERE: Final = re.compile(r"[a-z]+:|#|//")


def with_targets(markdown: str, change: Callable[[str], str]) -> str:
    """A page with every target of a link or picture changed; code is left alone."""
    parts = _CODE.split(markdown)
    step = _CODE.groups + 1  # text, then the groups of a piece of code, in turn
    for place in range(0, len(parts), step):
        parts[place] = _TARGET.sub(lambda found: found["before"] + change(found["target"]), parts[place])
        if place + 2 < len(parts):
            parts[place + 2] = ""  # the fence, which the piece of code holds already
    return "".join(part or "" for part in parts)


class Links:
    """The places of a repository's files on the site.

    Args:
        root: The folder of the repository.
    """

    def __init__(self, root: Path) -> None:
        self._root = root.resolve()

    def page_of(self, path: str) -> str:
        """The source address in the site of a file or folder of the repository, such as ``source/a/b.py.md``."""
        path = INDEXES.get(path, path)
        here = self._root / path
        published = path.startswith(DOCS) and not f"{path}/".startswith(f"{UNPUBLISHED}/")
        if here.is_dir():
            if published and (here / "README.md").is_file():
                return f"{path}/README.md".removeprefix(DOCS)
            return f"source/{path}/index.md"
        if published:
            return path.removeprefix(DOCS) + (".md" if path.endswith(".ipynb") else "")
        if path.endswith(".md") and "/" not in path:
            return f"project/{path.lower()}" if path != "README.md" else "project/about.md"
        return f"source/{path}.md"

    def repository_path(self, path: str, target: str) -> str | None:
        """The file or folder of the repository that a link of ``path`` leads to; None if it leads elsewhere."""
        if _ELSEWHERE.match(target):
            return None
        joined = posixpath.normpath(posixpath.join(posixpath.dirname(path), target.partition("#")[0]))
        return joined if not joined.startswith("../") and (self._root / joined).exists() else None

    def on_the_site(self, path: str, target: str) -> str:
        """What a link of the file ``path`` has to say on the site."""
        found = self.repository_path(path, target)
        if found is None:
            return target
        address = posixpath.relpath(self.page_of(found), posixpath.dirname(self.page_of(path)) or ".")
        _, mark, anchor = target.partition("#")
        return address + mark + anchor

    def leaving(self, pages: dict[str, str]) -> set[str]:
        """Files and folders outside ``docs/`` and beside the top's Markdown that these pages (path: text) link to."""
        found = set[str]()
        for path, text in pages.items():

            def note(target: str, path: str = path) -> str:
                if (there := self.repository_path(path, target)) and self.page_of(there).startswith("source/"):
                    found.add(there)
                return target

            with_targets(text, note)
        return found
