"""The table of ``docs/worlds.md``, made of ``docs/worlds.json``: ``python -m tests.worlds.page`` writes it."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any, Final

from recorders.gymnasium_env.worlds import WORLDS

DOCS: Final = Path(__file__).resolve().parents[2] / "docs"
PAGE, FIGURES = DOCS / "worlds.md", DOCS / "worlds.json"
_TABLE: Final = re.compile(r"<!-- worlds -->\n.*?<!-- /worlds -->", re.DOTALL)
_HEAD: Final = (
    ("world", "tier", "actions", "frames per CPU second", "bytes per frame", "`tiny` [CPU s]", "repeats", "install"),
    ("---", "---", "---", "---:", "---:", "---:", "---", "---"),
)


def figures() -> dict[str, Any]:
    """What was measured, by environment: dmbench's own first."""
    found: dict[str, Any] = json.loads(FIGURES.read_text())
    known = [f"gym:{name}" for name in WORLDS]
    return {name: found[name] for name in [*(name for name in found if name not in known), *known] if name in found}


def titles(page: str) -> dict[str, str]:
    """The heading of each world's card, by the environment that the card's first command records."""
    return {
        name: title
        for title, name in re.findall(
            r"^## ([^\n]+)\n(?:(?!^## ).)*?^dmbench record (\S+)", page, re.MULTILINE | re.DOTALL
        )
    }


def table(page: str) -> str:
    """The table, in Markdown; each world leads to its card."""
    rows = [*_HEAD]
    headings = titles(page)
    for name, found in figures().items():
        title, extra = headings[name], WORLDS[name[4:]].extra if name.startswith("gym:") else ""
        anchor = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
        discrete = " to " not in found["actions"]
        count = found["actions"].count(", ") + 1
        actions = f"{count} to choose from" if discrete else "1 number" if count == 1 else f"{count} numbers"
        assert found["repeats"] is not False, name
        assert found["same_for_1_and_4_workers"], name
        rate, size, spent = found["frames_per_cpu_s"], found["bytes_per_frame"], found["tiny"]["cpu_s"]
        repeats = "exact" if found["repeats"] is None else "yes"
        install = f"`{extra}`" if extra else "-"
        rows.append(
            (
                f"[{title}](#{anchor})",
                found["tier"],
                actions,
                f"{rate:,.0f}",
                f"{size:,.0f}",
                f"{spent}",
                repeats,
                install,
            )
        )
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


def with_table(page: str) -> str:
    """The page with the table as it is to be."""
    return _TABLE.sub(f"<!-- worlds -->\n{table(page)}\n<!-- /worlds -->", page)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
