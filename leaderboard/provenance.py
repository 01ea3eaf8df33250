"""The provenance of a row: how each of its entries was made, and every figure of the entry."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

from dmotion_bench.scoring.earlier_planning import present_planning
from leaderboard.board import Board
from leaderboard.columns import control_columns, count, interval, number
from leaderboard.entry import Entry
from leaderboard.markup import Markup, element, joined


def provenance(board: Board) -> Markup:
    """One folded section an entry of the board."""
    entries = board.entries
    return element(
        "section",
        element("h3", "Where the numbers come from"),
        element(
            "p",
            "Each entry is a JSON file beside this page. With its run and its data set at hand, ",
            element("code", "dmbench leaderboard check"),
            " scores it again and says whether its figures hold.",
            class_="note",
        ),
        joined(_measured(entry) if entry.is_measured else _published(entry) for entry in entries),
    )


def _measured(entry: Entry) -> Markup:
    content = entry.content
    labels, dataset, samples = content["labels"], content["dataset"], content["samples"]
    own, planning = dataset.get("trained_on"), present_planning(content.get("planning", {}))
    given = ", ".join(f"{purpose} {count}" for purpose, count in labels["given"].items())
    facts: dict[str, Any] = {
        "model": f"{entry.model}, {content['arch']} architecture, preset {content['preset']}, seed {content['seed']}",
        "labels": f"{labels['asked']}: {count(labels['total'])} handed out{f' ({given})' if given else ''}"
        + (f"; {entry.label_use}" if entry.label_use else ""),
        "data set": f"{dataset['name']} ({dataset['environment']})",
        "data set's SHA-256": dataset["fingerprint"],
        "trained on": _training(own) if own else "",
        "weights' SHA-256": content["weights"],
        "samples": f"{count(samples['rows'])} rows",
        "samples' SHA-256": samples["sha256"],
        "protocol": f"{content['protocol']}, scored by {content.get('code') or f'version {entry.scored_by}'}",
        "settings": _listed(content["settings"]),
        **{name: _listed(planning[name]) for name in ("solver", "objective") if name in planning},
        "training": _listed(content["training"]),
        "versions": _listed(content["versions"]),
    }
    return _folded(entry, facts, content["remarks"])


def _training(own: Mapping[str, str]) -> str:
    environment = f" ({own['environment']})" if "environment" in own else ""
    return f"{own['name']}{environment}, another data set; SHA-256 {own['fingerprint']}"


def _published(entry: Entry) -> Markup:
    given = entry.label_count
    facts = {
        "model": entry.model,
        "labels": entry.labels + ("" if given is None else f": {count(given)}"),
        "source": entry.content["source"],
        "note": entry.content["note"],
        "checked": "cannot be scored again here; the table was copied by hand",
    }
    return _folded(entry, facts, {})


def _folded(entry: Entry, facts: Mapping[str, str], remarks: Mapping[str, str]) -> Markup:
    pairs = [(name, text) for name, text in facts.items() if text] + list(remarks.items())
    told = joined(joined((element("dt", name), element("dd", text))) for name, text in pairs)
    return element(
        "details",
        element("summary", entry.name, None if entry.is_measured else " (as published)"),
        element("dl", told),
        element("p", element("a", "This entry as JSON", href=f"entries/{entry.slug}.json")),
        _figures(entry),
        class_="provenance",
        id=entry.slug,
    )


def _figures(entry: Entry) -> Markup:
    distances = {column.figure for column in control_columns(entry.figures)}  # a hundred more are in the entry
    head = element("tr", *(element("th", name, scope="col") for name in ("figure", "mean", "std", "95% interval", "n")))
    body = [
        element(
            "tr",
            element("th", name, scope="row"),
            element("td", number(figure["mean"])),
            element("td", number(figure["std"])),
            element("td", interval(figure["low"], figure["high"])),
            element("td", "" if figure["n"] is None else count(figure["n"])),
        )
        for name, figure in entry.figures.items()
        if not name.startswith("control_distance[") or name in distances
    ]
    table = element("table", element("thead", head), element("tbody", joined(body)), class_="figures")
    return element("div", table, class_="scroll", tabindex=0, role="region", aria_label=f"Every figure of {entry.name}")


def _listed(facts: Mapping[str, Any]) -> str:
    return ", ".join(f"{name.replace('_', ' ')} {_said(value)}" for name, value in facts.items())


def _said(value: Any) -> str:
    if isinstance(value, list):
        return " and ".join(str(one) for one in value)
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)


def count_figures(entries: Iterable[Entry]) -> int:
    """How many figures some entries hold together."""
    return sum(len(entry.figures) for entry in entries)
