"""The tables of ``docs/worlds.md``, made of ``docs/worlds.json``: ``python -m tests.worlds.page`` writes them."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any, Final

from recorders.gymnasium_env.worlds import WORLDS

DOCS: Final = Path(__file__).resolve().parents[2] / "docs"
PAGE, FIGURES = DOCS / "worlds.md", DOCS / "worlds.json"
_TABLE: Final = re.compile(r"<!-- worlds -->\n.*?<!-- /worlds -->", re.DOTALL)
_MODELS: Final = re.compile(r"<!-- models -->\n.*?<!-- /models -->", re.DOTALL)
_HEAD: Final = (
    ("world", "tier", "actions", "frames per CPU second", "bytes per frame", "`tiny` [CPU s]", "repeats", "install"),
    ("---", "---", "---", "---:", "---:", "---:", "---", "---"),
)
_MODELS_HEAD: Final = (
    ("world", "copy last", "DMotion", "labels", "DMotion, true motion", "E-D CNN", "labels"),
    ("---", "---:", "---:", "---:", "---:", "---:", "---:"),
)


def figures() -> dict[str, Any]:
    """What was measured, by environment: dmbench's own first."""
    found: dict[str, Any] = json.loads(FIGURES.read_text())
    known = [f"gym:{name}" for name in WORLDS]
    return {name: found[name] for name in [*(name for name in found if name not in known), *known] if name in found}


def _link(title: str) -> str:
    anchor = re.sub(r"[^\w\- ]", "", title.lower()).replace(" ", "-")
    return f"[{title}](#{anchor})"


def _markdown(rows: Iterable[Iterable[str]]) -> str:
    return "\n".join(f"| {' | '.join(row)} |" for row in rows)


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
                _link(title),
                found["tier"],
                actions,
                f"{rate:,.0f}",
                f"{size:,.0f}",
                f"{spent}",
                repeats,
                install,
            )
        )
    return _markdown(rows)


def models_table(page: str) -> str:
    """What models reach where they were trained, in Markdown."""
    rows = [*_MODELS_HEAD]
    headings = titles(page)
    for name, found in figures().items():
        if "models" not in found:
            continue
        for setting in sorted({setting for model in found["models"].values() for setting in model}):
            dmotion, supervised = (found["models"][model].get(setting) for model in ("dmotion", "ed-cnn"))
            known = [one for one in (dmotion, supervised) if one is not None]
            assert len({one["fingerprint"] for one in known}) == 1, name
            plain = setting == "gate_floor=0"
            rows.append(
                (
                    _link(headings[name]) if plain else f"with `{setting}`",
                    _number(known[0]["copy_last"]["mse"]),
                    _figure(dmotion, "mse"),
                    _labels(dmotion),
                    _figure(dmotion, "mse_true_motion"),
                    _figure(supervised, "mse"),
                    _labels(supervised),
                )
            )
    return _markdown(rows)


def _number(value: float) -> str:
    return f"{value:.1f}" if value >= 10 else f"{value:.2f}"


def _figure(run: dict[str, Any] | None, name: str) -> str:
    if run is None:
        return "-"
    figure = run["figures"][name]
    return f"{_number(figure['mean'])} ({_number(figure['low'])} to {_number(figure['high'])})"


def _labels(run: dict[str, Any] | None) -> str:
    return "-" if run is None else f"{run['labels']:,}"


def with_table(page: str) -> str:
    """The page with the tables as they are to be."""
    page = _TABLE.sub(f"<!-- worlds -->\n{table(page)}\n<!-- /worlds -->", page)
    return _MODELS.sub(f"<!-- models -->\n{models_table(page)}\n<!-- /models -->", page)


if __name__ == "__main__":
    PAGE.write_text(with_table(PAGE.read_text()))
