"""The provenance of a board's results: how each entry was made, and the command that checks it.

The JSON file of an entry has everything. So the page says once what most entries of a board have in common, and of
each entry what differs.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Final

from dmotion_bench.scoring.earlier_planning import present_planning
from leaderboard.board import Board
from leaderboard.columns import count
from leaderboard.entry import Entry
from leaderboard.markup import Markup, element, joined

Facts = Mapping[str, Mapping[str, str]]
"""By what they are about, by their names; a fact without a name stands alone."""
WITHOUT: Final = "without"
_SHARED: Final = ("settings", "solver", "objective", "training", "versions")
"""Of these an entry may lack a part that most have; anything else it has or lacks as a whole."""


def provenance(board: Board) -> Markup | None:
    """What the measured entries of a board have in common, and a folded section for each; None where there are none."""
    entries = [entry for entry in board.entries if entry.is_measured]
    if not entries:
        return None
    known = [facts_of(entry) for entry in entries]
    usual = usual_facts(known)
    sections = [_folded(entry, different(facts, usual)) for entry, facts in zip(entries, known, strict=True)]
    return element(
        "section",
        element("h3", "Where the numbers come from"),
        element(
            "p",
            "Each entry is a JSON file beside this page, with every figure and how it was made. Building the page "
            "checked none of them. The command of an entry scores it again and says whether its figures hold. It "
            "needs the run and the data set, in the "
            "workspace or fetched with ",
            element("code", "--from PLACE"),
            ". The samples that the figures are made of are part of the run: ",
            element("code", "dmbench share pull entries/NAME.json --from PLACE"),
            " fetches it, with its data set, from where the author published both, and holds every file against its "
            "hash.",
            class_="note",
        ),
        _list(usual, element("summary", "What these entries have in common, where an entry does not say otherwise"))
        if usual
        else None,
        joined(sections),
    )


def facts_of(entry: Entry) -> Facts:
    """How a measured entry was made, in words; what was not set is left away."""
    content = entry.content
    labels, dataset = content["labels"], content["dataset"]
    own, planning = dataset.get("trained_on"), present_planning(content.get("planning", {}))
    given = ", ".join(f"{purpose} {count}" for purpose, count in labels["given"].items())
    facts: dict[str, Mapping[str, Any]] = {
        "model": {"": f"{entry.model}, {content['arch']} architecture, preset {content['preset']}"},
        "seed": {"": content["seed"]},
        "labels": {
            "": f"{labels['asked']}: {count(labels['total'])} handed out{f' ({given})' if given else ''}"
            + (f"; {entry.label_use}" if entry.label_use else "")
        },
        "data set": {"": f"{dataset['name']} ({dataset['environment']})"},
        "data set's SHA-256": {"": dataset["fingerprint"]},
        "trained on": {"": _training(own) if own else None},
        "weights' SHA-256": {"": content["weights"]},
        "protocol": {"": f"{content['protocol']}, scored by {content.get('code') or f'version {entry.scored_by}'}"},
        "settings": content["settings"],
        **{name: planning[name] for name in ("solver", "objective") if name in planning},
        "training": content["training"],
        "versions": content["versions"],
    }
    remarks = {name.replace("_", " "): {"": text} for name, text in content["remarks"].items()}
    facts |= {name: text for name, text in remarks.items() if name not in facts}
    told = {
        about: {name.replace("_", " "): _said(value) for name, value in ones.items() if value not in (None, "", [], {})}
        for about, ones in facts.items()
    }
    return {about: ones for about, ones in told.items() if ones}


def usual_facts(known: Sequence[Facts]) -> Facts:
    """What more than half of some entries have alike; nothing of a single entry."""
    usual: dict[str, dict[str, str]] = {}
    for about in dict.fromkeys(about for facts in known for about in facts):
        for name in sorted({name for facts in known for name in facts.get(about, {})}):
            values = Counter(facts[about][name] for facts in known if name in facts.get(about, {}))
            ((value, having),) = values.most_common(1)
            if len(known) > 1 and 2 * having > len(known):
                usual.setdefault(about, {})[name] = value
    return usual


def different(facts: Facts, usual: Facts) -> Facts:
    """The facts that are not the usual ones, and the names of the usual settings and remarks that an entry lacks."""
    own = {
        about: {name: value for name, value in ones.items() if usual.get(about, {}).get(name) != value}
        for about, ones in facts.items()
    }
    lacking = [name for about in _SHARED for name in usual.get(about, {}) if name and name not in facts.get(about, {})]
    lacking += [about for about in usual if about not in _SHARED and about not in facts]
    return {about: ones for about, ones in own.items() if ones} | (
        {WITHOUT: {"": ", ".join(lacking)}} if lacking else {}
    )


def _training(own: Mapping[str, str]) -> str:
    environment = f" ({own['environment']})" if "environment" in own else ""
    return f"{own['name']}{environment}, another data set; SHA-256 {own['fingerprint']}"


def _folded(entry: Entry, facts: Facts) -> Markup:
    file = f"entries/{entry.slug}.json"
    command = element("code", "dmbench leaderboard check ", element("a", file, href=file))
    return _list(facts, element("summary", entry.name), element("p", command), anchor=entry.slug)


def _list(facts: Facts, *before: Markup, anchor: str | None = None) -> Markup:
    told = joined(
        joined(
            (
                element("dt", about),
                element("dd", ", ".join(f"{name} {value}".strip() for name, value in ones.items())),
            )
        )
        for about, ones in facts.items()
    )
    return element("details", *before, element("dl", told), class_="provenance", id=anchor)


def _said(value: Any) -> str:
    if isinstance(value, list):
        return " and ".join(str(one) for one in value)
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}"
    return str(value)


def count_figures(entries: Iterable[Entry]) -> int:
    """How many figures some entries hold together."""
    return sum(len(entry.figures) for entry in entries)
