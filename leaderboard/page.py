"""The page: one HTML file that needs no server, no network and no script to be read.

Its content security policy allows its own style, its own script (by their hashes) and pictures that stand in it;
nothing else is fetched or run, even if something slipped through ``markup.py``.
"""

from __future__ import annotations

import base64
import hashlib
import inspect
import json
from collections import Counter
from collections.abc import Collection, Sequence
from importlib import resources
from typing import Final

from dmotion_bench.registry import environment_versions, model_class, model_names
from leaderboard.board import Board, make_boards
from leaderboard.chart_figure import Styles
from leaderboard.columns import HIGHER, count
from leaderboard.curves import assign_styles, charts, legend
from leaderboard.entry import Entry
from leaderboard.gallery import BUDGET, fitting_steps, gallery
from leaderboard.label_charts import label_notes
from leaderboard.markup import Markup, element, escaped, joined
from leaderboard.paper import ADDRESS as PAPER
from leaderboard.paper import address
from leaderboard.provenance import count_figures, provenance
from leaderboard.row import EACH_MEANING
from leaderboard.standings import PUBLISHED, agreement_note, column_standings, control_standings, standings
from leaderboard.summary import Summary, summarise
from leaderboard.summary_section import TITLE, shows, summary_section

LARGEST: Final = 5_000_000
"""Bytes of the page."""

WORDS: Final = {
    "label": "an action that a model is told; without labels it sees video alone",
    "one-shot": "one demonstration of each action",
    "latent action": "the numbers by which a model of video describes what was done between two frames",
    "rollout": "several predictions in a row, each made from the ones before",
    "gain captured": "of what the best of many action sequences brings, the share that the model's favourite brings",
    "control": "a planner chooses actions by a model's predictions, to bring objects to where a picture has them",
    "frozen planner": "one with fixed settings, which were chosen on other tasks than those of the table",
    "copying": "predicting that nothing changes; a model with a higher error than that is of no use",
}
"""What the page says of its own words, as it may stand alone."""


def make_page(entries: Sequence[Entry]) -> str:
    """The page of some entries; the same entries make the same bytes."""
    boards = make_boards(entries)
    summary = summarise(boards)
    counts, taken = fitting_steps(boards, BUDGET)
    while True:
        page = _page(entries, boards, summary, counts)
        beyond = len(page.encode()) - LARGEST
        if beyond <= 0 or not any(counts):
            return page
        counts, taken = fitting_steps(boards, taken - beyond)


def _page(entries: Sequence[Entry], boards: Sequence[Board], summary: Summary | None, steps: Sequence[int]) -> str:
    style, script = _asset("page.css"), _asset("page.js")
    policy = f"default-src 'none'; img-src data:; style-src {_hash(style)}; script-src {_hash(script)}; base-uri 'none'"
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=policy),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", "dmbench leaderboard"),
        element("style", Markup(style)),
    )
    styles = assign_styles(boards)
    sections = [_section(boards, place, styles, steps[place]) for place in range(len(boards))]
    body = element(
        "body",
        _header(entries, boards, summary),
        element("main", _summary(summary, boards), joined(sections)),
        _footer(entries),
        element("script", Markup(script)),
    )
    return f"<!DOCTYPE html>\n{element('html', head, body, lang='en')}\n"


def _asset(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text()


def _hash(text: str) -> str:
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def _summary(summary: Summary | None, boards: Sequence[Board]) -> Markup | None:
    if summary is None:
        return None
    places = {board: place for place, board in enumerate(map(id, boards))}
    return summary_section(summary, [_anchor(places[id(board)]) for board in summary.boards])


def _header(entries: Sequence[Entry], boards: Sequence[Board], summary: Summary | None) -> Markup:
    measured = [entry for entry in entries if entry.is_measured]
    names = [f"{board.title}{f', {board.dataset}' if board.dataset else ''}" for board in boards]
    alike = Counter(names)
    links = [
        element(
            "li",
            element("a", name if alike[name] == 1 else f"{name} {board.fingerprint[:8]}", href=f"#{_anchor(place)}"),
        )
        for place, (name, board) in enumerate(zip(names, boards, strict=True))
    ]
    if summary is not None:
        links.insert(0, element("li", element("a", TITLE, href="#summary")))
    return element(
        "header",
        element("h1", "dmbench leaderboard"),
        element(
            "p",
            "Forward models of robot video, learned with few action labels or none, and scored on episodes that they "
            "have not seen. The benchmark follows ",
            element("a", "the DMotion paper", href=PAPER),
            ". ",
            f"{_counted(len(measured), 'result', 'results')} measured here, ",
            f"{_counted(len(entries) - len(measured), 'row', 'rows')} of published tables beside them.",
            class_="lead",
        ),
        element("nav", element("ul", *links), aria_label="Environments") if len(boards) > 1 else None,
        element(
            "details",
            element("summary", "How to read this"),
            element(
                "ul",
                element("li", f"Lower is better, except for {', '.join(HIGHER)}."),
                element(
                    "li",
                    "Small print under a number: \u201c95%\u201d is the interval of the mean (a bootstrap), over test "
                    "episodes and, where a row has several trainings, over these; \u201cseeds\u201d are the lowest and "
                    "the highest of several trainings. In a published row it is what the paper's table has after "
                    "\u00b1. A bar in a chart is the 95% interval, where it is known.",
                ),
                element(
                    "li",
                    "\u201cMSE above the best\u201d is the paired difference on the same test episodes. Of the MSE and "
                    "of control after the last step, the best row is bold, and so are the rows that are statistically "
                    "tied with it: the interval of their difference reaches zero. A row with a single training is "
                    "compared as it was trained, which says nothing about its other seeds.",
                ),
                element(
                    "li",
                    "\u201cLabels\u201d counts every action label that a model was handed, for training, validation "
                    f"and alignment. {EACH_MEANING}",
                ),
                element("li", "A model's name leads to where its numbers come from."),
            ),
            element("dl", joined(joined([element("dt", word), element("dd", said)]) for word, said in WORDS.items())),
        ),
        _models({row.model for board in boards for row in board.rows if row.kind == "measured"}),
    )


def _models(names: Collection[str]) -> Markup | None:
    """What each model is, as its module and its class begin to say of themselves; of those that are installed."""
    told = []
    for name in (name for name in model_names() if name in names):
        kind = model_class(name)
        said = (inspect.getdoc(one) for one in (inspect.getmodule(kind), kind) if one is not None)
        begun = [" ".join(text.partition("\n\n")[0].split()) for text in said if text]
        told.append(joined([element("dt", name), element("dd", " ".join(begun))]))
    return element("details", element("summary", "The models"), element("dl", joined(told))) if told else None


def _counted(count: int, one: str, many: str) -> str:
    return f"{count} {one if count == 1 else many}"


def _anchor(place: int) -> str:
    return f"board-{place + 1}"


def _section(boards: Sequence[Board], place: int, styles: Styles, steps: int) -> Markup:
    board = boards[place]
    drawn = charts(board, styles)
    notes = [element("p", note, class_="note") for note in [label_notes(board, boards)] if note]
    return element(
        "section",
        element("h2", board.title, element("small", board.dataset) if board.dataset else None),
        element("p", shows(board), class_="shows") if board.measured or board.control else None,
        element("p", *_described(board), class_="note"),
        standings(board, _anchor(place)) if board.rows else None,
        agreement_note(board),
        joined(element("p", note, class_="note") for note in _on_version(board)),
        _published(board, _anchor(place)),
        column_standings(board.control, _anchor(place)) if board.control is not None else None,
        control_standings(board, _anchor(place)),
        joined([element("h3", "Curves"), legend(board, styles), *notes, drawn]) if drawn is not None else None,
        gallery(board, steps),
        provenance(board),
        id=_anchor(place),
        class_="board",
    )


def _described(board: Board) -> list[Markup]:
    if not board.fingerprint:
        return [escaped("Published results alone; nothing has been measured here yet.")]
    steps = f"{count(board.triplets)} steps of the {board.split} episodes; data set " if board.triplets else "Data set "
    told = [escaped(steps)]
    told.append(element("code", board.fingerprint[:12], title=board.fingerprint))
    told.append(escaped("."))
    if board.recording:
        told += [escaped(" It is recorded by "), element("code", board.recording), escaped(".")]
    if board.protocol == "paper":
        told.append(
            element("strong", " Split as in the paper: most test frames were seen in training, so these figures leak.")
        )
    return told


def _published(board: Board, anchor: str) -> Markup | None:
    """Where the published rows of a board were printed; their names lead here."""
    published = [row.entries[0].content for row in board.rows if row.kind == "published"]
    sources = dict.fromkeys((str(one["source"]), str(one["note"])) for one in published)
    if not sources:
        return None
    told = [
        joined(
            [
                "As published: ",
                element("a", source, href=where) if (where := address(source)) else source,
                f". {note} ",
            ]
        )
        for source, note in sources
    ]
    return element("p", *told, "Copied by hand; not scored again here.", class_="note", id=f"{anchor}-{PUBLISHED}")


def _on_version(board: Board) -> list[str]:
    """A note on a board whose environment has a newer version than the board's data set."""
    versions = environment_versions(board.environment)
    newest = max(versions, default=board.version)
    if not board.fingerprint or board.version >= newest:
        return []
    return [
        f"Everything measured here is of version {board.version} of {board.environment} "
        f"({versions.get(board.version, 'not known here')}). dmbench now records version {newest} "
        f"({versions[newest]}). Each version has boards of its own."
    ]


def _footer(entries: Sequence[Entry]) -> Markup:
    digest = hashlib.sha256("".join(sorted(json.dumps(entry.content) for entry in entries)).encode()).hexdigest()
    return element(
        "footer",
        element(
            "p",
            f"{count(count_figures(entries))} figures in {_counted(len(entries), 'entry', 'entries')}. ",
            "Made of ",
            element("code", digest[:12], title=digest),
            " by dmbench leaderboard build; the format of an entry is in ",
            element("a", "schema.json", href="schema.json"),
            ".",
        ),
    )
