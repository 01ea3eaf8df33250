"""The summary across worlds, as the first section of the page and as Markdown."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Collection, Sequence
from typing import Final

from dmotion_bench.registry import environment_class, environment_names
from leaderboard.board import Board
from leaderboard.columns import TRUE_MOTION
from leaderboard.markdown import WIDTH, plain, table
from leaderboard.markdown_numbers import TO
from leaderboard.markup import Markup, element, joined
from leaderboard.summary import Standing, Summary
from leaderboard.usual import RANKED_BY

TITLE: Final = "All worlds together"
SCORE: Final = (
    "A training's score in a world is 1 - MSE / MSE of copying the last frame, of the next frame on the test episodes: "
    "1 is perfect, 0 is copying the last frame, below 0 is worse than copying it. Trainings are counted in each world."
)
MEANING: Final = (
    "IQM is the interquartile mean, the mean of the middle half of a model's scores over worlds and trainings, all of "
    "them if there are fewer than four. With three worlds it may pass over a whole world, so the plain mean over the "
    "worlds and the worst world stand beside it. P(better) is the probability of improvement over the model below: "
    "that of a higher score of a training drawn from each, averaged over the worlds. IQM and P(better) are "
    "rliable's definitions (Agarwal et "
    "al. 2021). Each model has its usual label budget and its usual settings."
)
INTERVALS: Final = (
    "With an IQM stands its 95% interval over trainings, a bootstrap within each world; of fewer than five it "
    "is too narrow."
)
ALONE: Final = (
    "One training says nothing about others: there is no interval, and P(better) only tells in what share of the "
    "worlds this training was better."
)
NO_RANKING: Final = "The order is no ranking where a model has fewer than three trainings."


def summary_section(summary: Summary, anchors: Sequence[str]) -> Markup:
    """The section of the page.

    Args:
        summary: To be shown.
        anchors: Where the boards of its worlds are on the page.
    """
    cells = [element("th", head, scope="col") for head in ("Model", "IQM", "Mean", "Worst world")]
    for board, anchor in zip(summary.boards, anchors, strict=True):
        link = element("a", board.title, href=f"#{anchor}")
        cells.append(element("th", link, element("small", f" {board.dataset}"), scope="col"))
    cells += [element("th", head, scope="col") for head in ("P(better)", "Labels", "Trainings")]
    rows = [_row(one) for one in summary.standings]
    ranking = element(
        "table",
        element("caption", TITLE, id="summary-caption"),
        element("thead", element("tr", *cells)),
        element("tbody", joined(rows)),
        class_="ranking",
    )
    return element(
        "section",
        element("h2", TITLE),
        element("p", summary_shows(summary), class_="shows"),
        element("div", ranking, class_="scroll", tabindex=0, role="region", aria_labelledby="summary-caption"),
        joined(element("p", note, class_="note") for note in (*_explained(summary), *_absent(summary))),
        id="summary",
        class_="summary",
    )


def summary_lines(summary: Summary) -> list[str]:
    """The lines of the summary in a Markdown page."""
    worlds = [plain(board.title) for board in summary.boards]
    recorded = ", ".join(f"{plain(board.title)} {board.fingerprint[:8]}" for board in summary.boards)
    body = [
        [
            plain(one.model),
            _ordinary(_score(one.iqm) + (f" ({_between(one)})" if one.interval else "")),
            *(_ordinary(_score(mean)) for mean in (*_over_worlds(one), *one.worlds)),
            "" if one.over_next is None else f"{one.over_next:.2f}",
            f"{plain(one.labels)}: {_counts(one)}",
            f"{one.trainings}",
        ]
        for one in summary.standings
    ]
    lines = table(["Model", "IQM", "Mean", "Worst world", *worlds, "P(better)", "Labels", "Trainings"], body)
    notes = (f"Data sets: {recorded}.", *_explained(summary), *map(plain, _absent(summary)))
    said = [one for note in notes for one in (*textwrap.wrap(note, WIDTH, break_on_hyphens=False), "")]
    return ["", *lines, "", *said]


def _row(one: Standing) -> Markup:
    name = element("a", one.model, href=f"#{one.rows[0].entries[0].slug}")
    between = element("small", f"95%: {_between(one)}" if one.interval else "1 training" if one.trainings == 1 else "")
    cells = [
        element("th", name, scope="row"),
        element("td", _score(one.iqm), between),
        *(element("td", _score(mean)) for mean in (*_over_worlds(one), *one.worlds)),
        element("td", "" if one.over_next is None else f"{one.over_next:.2f}"),
        element("td", _counts(one), element("small", one.labels)),
        element("td", str(one.trainings)),
    ]
    return element("tr", *cells)


def summary_shows(summary: Summary) -> str:
    *others, last = (board.title for board in summary.boards)
    worlds = " and ".join([", ".join(others), last] if others else [last])
    return (
        f"How well each model predicts the next frame of {worlds} together, the best model first: "
        f"{len(summary.standings)} models, {_trainings(summary)}."
    )


def _trainings(summary: Summary) -> str:
    """How many trainings the models have in each world."""
    known = sorted({one.trainings for one in summary.standings})
    return f"{_extremes(known)} trainings of each in a world" if known[-1] > 1 else "one training in each world"


def _explained(summary: Summary) -> list[str]:
    """What the columns say, and how far the order of the models can be trusted."""
    fewest = min((one.trainings for one in summary.standings), default=0)
    doubts = [ALONE] * (fewest == 1) + [NO_RANKING] * (fewest < 3)
    return [SCORE, MEANING, " ".join([INTERVALS, *doubts])]


def _absent(summary: Summary) -> list[str]:
    """What is not in the table, and why."""
    told = []
    if summary.left_out:
        told.append(
            "Left out, as they lack a result with their usual labels and settings in one of these worlds: "
            f"{', '.join(summary.left_out)}."
        )
    if summary.too_small:
        told.append(
            f"Worlds with results of fewer than half as many models, which are not counted: "
            f"{', '.join(summary.too_small)}."
        )
    if summary.unusual:
        told.append(
            "Worlds in which no model was trained with its usual settings, which are not counted: "
            f"{', '.join(summary.unusual)}."
        )
    return told


def _over_worlds(one: Standing) -> tuple[float, float]:
    """The plain mean over the worlds, and the worst of them."""
    return sum(one.worlds) / len(one.worlds), min(one.worlds)


def _score(value: float) -> str:
    return f"{value:.4f}" if value >= 0 else f"\u2212{-value:.4f}"


def _ordinary(text: str) -> str:
    """With an ordinary minus sign."""
    return text.replace("\u2212", "-")


def _between(one: Standing) -> str:
    assert one.interval is not None, "asked for where there is one"
    return TO.join(map(_score, one.interval))


def _counts(one: Standing) -> str:
    """The labels that were handed out in the worlds, the fewest and the most."""
    known = [row.label_count for row in one.rows if row.label_count is not None]
    return _extremes(known) if known else "?"


def _extremes(counts: Collection[int]) -> str:
    """The lowest and the highest of some counts; the one that there is if all are the same."""
    return TO.join(dict.fromkeys(f"{count:,}" for count in (min(counts), max(counts))))


def shows(board: Board) -> str:
    """What a board shows, in one sentence."""
    kinds = {entry.actions for entry in board.measured}
    with_ = f"with {' and '.join(sorted(kinds))} actions" if kinds - {"discrete"} else ""
    shown = {name for row in board.rows for name in row.figures}
    planned = any(name.startswith("control_distance") for name in shown)
    then = ", and how near a planner that uses it brings the objects to their goals" if planned else ""
    predicted = f"how far each model's next frame is from the true one{then}"
    if RANKED_BY not in shown and TRUE_MOTION.figure in shown:
        predicted = "how near each model comes to the next frame when it is told the latent action of the true one"
    controlled = (
        "how near frozen planners bring the objects to their goals with each model, on tasks that nothing was chosen on"
    )
    where = ", ".join(part for part in (_scene(board.environment), with_) if part)
    told = f"{where}{': ' if where else ''}{predicted if board.measured else controlled}."
    return told[0].upper() + told[1:]


def _scene(environment: str) -> str:
    """What happens in an environment, as the first sentence of its class says, if it is installed."""
    if environment not in environment_names():
        return ""
    said = (environment_class(environment).__doc__ or "").strip().splitlines()[:1]
    return "".join(re.split(r"[;.]", line)[0] for line in said)
