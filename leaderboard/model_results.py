"""What the entries hold of one model: its rows of all boards as Markdown, and two charts as files.

The charts are files of their own, which a page shows as pictures. So their colours cannot follow the page's: they have
the light ones of ``page.css``, on paper.
"""

from __future__ import annotations

import itertools
import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from importlib import resources
from typing import Final, TypeVar

from dmotion_bench.planning.columns import COLUMNS, HEADLINE
from leaderboard.board import REFERENCE_WORDS, Board
from leaderboard.board_tables import (
    budget,
    budget_words,
    each_trainings,
    known,
    left,
    solved,
    trainings,
    tuned,
    tuned_words,
)
from leaderboard.chart import HEIGHT, WIDTH, Axis, Guide, Point, Series, Style, line_chart, marker
from leaderboard.column_table import ColumnRow, Outcome
from leaderboard.columns import POSITION_CHARGED
from leaderboard.control import FIGURES as CONTROLLED
from leaderboard.markdown import plain, table
from leaderboard.markdown_numbers import figure, mean
from leaderboard.markup import Markup, element, joined
from leaderboard.row import EACH_MEANING, Row, each
from leaderboard.usual import RANKED_BY
from leaderboard.value import Value

CURVES: Final = "curves"
"""The folder of the charts, beside the page."""
USUAL: Final = ("one-shot", "100%")
NOTHING: Final = "The leaderboard holds no result of this model yet."
SHOWN: Final = (
    "The charts show every step ahead and every control step. Of each data set they have the variant with the least "
    "error, with the usual label budget and, dashed, with others."
)
OF_HEADLINE: Final = (
    f"That of control is by the frozen planner *{HEADLINE.title}*, with the variant that leaves the least distance."
)
FROZEN: Final = (
    "Control by [frozen planners](../protocol.md#control-by-frozen-planners), on test tasks that nothing was tuned on: "
    "the objects' distance to their goals after the last step over that before, with its 95% interval over tasks and "
    "trainings; doing nothing is 1. Solved: the share of tasks that end with a fifth of the distance or less."
)
CURVE: Final = "Its error by the number of labels is in the boards' tables of labels needed."
MORE_SHOTS: Final = re.compile(r"\d+-shot")
_STEP: Final = re.compile(r"(\w+)\[(\d+)\]")
_LINE_HEIGHT: Final = 18
_LEGEND_LEFT, _LETTER = 52, 7
"""Pixels: where a legend's words begin, and the most that a letter of them takes on average."""
_STYLED: Final = re.compile(r"^\.(?:chart|axis|grid|line|dashed|dotted|marker|guide|c-?\d)\b.*$", re.MULTILINE)
Place = tuple[Board, Row]
_R = TypeVar("_R")


def model_lines(model: str, boards: Sequence[Board]) -> list[str]:
    """The lines of a model's results in a Markdown page; a sentence where there are none."""
    predicted = [place for place in _places(model, boards) if RANKED_BY in place[1].figures]
    frozen = _frozen(model, boards)
    if not predicted and not frozen:
        return ["", NOTHING, ""]
    lines = ["", *_predictions(predicted, boards)] if predicted else []
    if any(model == name for board in boards for name, _ in board.label_curves):
        lines += ["", CURVE]
    if frozen:
        lines += ["", *frozen]
    controlled = [place for place in predicted if _last(place[1]) is not None]
    if controlled:
        lines += ["", *_control(controlled, boards, "Control by other planners" if frozen else "Control")]
    if pictures := _pictures(model, boards):
        lines += ["", *_wrapped(f"{SHOWN} {OF_HEADLINE}" if _by_headline(model, boards) else SHOWN)]
    for kind, words in pictures.items():
        lines += ["", f"![{words}]({CURVES}/{model}-{kind}.svg)"]
    return [*lines, ""]


def model_charts(model: str, boards: Sequence[Board]) -> dict[str, str]:
    """The charts of a model, as the text of SVG files, by the files' names."""
    drawn = {"rollout": _rollout, "control": _controlled}
    return {
        f"{model}-{kind}.svg": drawn[kind](model, boards, words) for kind, words in _pictures(model, boards).items()
    }


def _pictures(model: str, boards: Sequence[Board]) -> dict[str, str]:
    """Which charts there are of a model, and what each shows."""
    said = {
        "rollout": f"{model}: error by steps ahead, over that of copying",
        "control": f"{model}: distance to the goals by control step"
        + (f", frozen planner {HEADLINE.title}" if _by_headline(model, boards) else ""),
    }
    able = {"rollout": _drawn(model, boards, "rollout_mse"), "control": _drawn_of_control(model, boards)}
    return {kind: words for kind, words in said.items() if able[kind]}


def _places(model: str, boards: Sequence[Board]) -> list[Place]:
    """The measured rows of a model with their boards, without the points of label curves."""
    rows = ((board, row) for board in boards for row in board.rows_beside_curves)
    return [(board, row) for board, row in rows if row.kind == "measured" and row.model == model]


def _predictions(places: Sequence[Place], boards: Sequence[Board]) -> list[str]:
    columns: dict[str, Callable[[Board, Row], str]] = {
        "Data set": lambda board, row: plain(_dataset(board, boards)),
        "Variant": lambda board, row: plain(row.variant),
        "Labels": lambda board, row: budget(row),
        "Trainings": lambda board, row: trainings(row, RANKED_BY).partition(":")[0],
        "MSE": lambda board, row: known(row, RANKED_BY, partial(figure, strong=row.ties)),
        "copying": lambda board, row: mean(board.reference("copy_last").get(RANKED_BY)),
        "paper": lambda board, row: mean(_published(board, row).get(RANKED_BY)),
        "15 ahead": lambda board, row: known(row, "rollout_mse[15]", mean),
        f"{POSITION_CHARGED} [px]": lambda board, row: known(row, "position_error_paper", figure),
    }
    note = (
        "Error of the predicted next frame on the test episodes, with its 95% interval over them. Of several trainings "
        "it is the mean, with the interval over trainings, too. Bold: the best on its data set, or tied with the best, "
        "as trained here."
    )
    if any(each(row.labels) for _, row in places):
        note = f"{note} {EACH_MEANING}"
    return _table(columns, places, note)


def _control(places: Sequence[Place], boards: Sequence[Board], what: str) -> list[str]:
    columns: dict[str, Callable[[Board, Row], str]] = {
        "Data set": lambda board, row: plain(_dataset(board, boards)),
        "Variant": lambda board, row: plain(row.variant),
        "Labels": lambda board, row: budget(row),
        "Tasks": lambda board, row: f"{row.figures[_last(row) or ''].samples or ''}",
        "Distance left": lambda board, row: known(
            row, _last(row) or "", partial(figure, strong=_last(row) in row.leads)
        ),
        "idle": lambda board, row: mean(board.reference("idle").get(_last(row) or "")),
        "true simulator": lambda board, row: mean(board.reference("oracle").get(_last(row) or "")),
        "paper": lambda board, row: mean(_published(board, row).get(_last(row) or "")),
        "Tuned here": lambda board, row: tuned(board, row, _last(row) or ""),
    }
    note = (
        f"{what}: the objects' distance to their goals after the last step, over that before. "
        "*Tuned here*: whether the planner was tuned on the very tasks of the row; its figure is then too good."
    )
    return _table(columns, places, note)


def _frozen(model: str, boards: Sequence[Board]) -> list[str]:
    """The table of a model's control by frozen planners; nothing where there is none."""
    tables = [(board, board.control) for board in boards if board.control is not None]
    places = [(board, row) for board, table in tables for row in table.rows if row.entries and row.name == model]
    names = [name for name in COLUMNS if any(name in row.cells for _, row in places)]
    if not places:
        return []
    columns: dict[str, Callable[[Board, ColumnRow], str]] = {
        "Data set": lambda board, row: plain(_dataset(board, boards)),
        "Variant": lambda board, row: plain(row.small),
        "Labels": lambda board, row: budget_words(row.label_count, row.labels),
        "Trainings": lambda board, row: each_trainings(row, names),
        "Tasks": lambda board, row: " / ".join(sorted({str(cell.tasks) for cell in row.cells.values()}, key=int)),
    }
    for name in names:
        columns[f"{COLUMNS[name].title}: left"] = partial(_of_column, name, left)
        columns[f"{COLUMNS[name].title}: solved"] = partial(_of_column, name, solved)
    return _table(columns, places, FROZEN)


def _of_column(name: str, words: Callable[[Outcome | None], str], board: Board, row: ColumnRow) -> str:
    return words(row.cells.get(name))


def _table(columns: dict[str, Callable[[Board, _R], str]], places: Sequence[tuple[Board, _R]], note: str) -> list[str]:
    """A note and a table without the columns that say nothing."""
    cells = {head: [cell(board, row) for board, row in places] for head, cell in columns.items()}
    heads = [head for head, column in cells.items() if any(column)]
    rows = [[cells[head][place] for head in heads] for place in range(len(places))]
    return [*_wrapped(note), "", *table(heads, rows, words=2 if "Variant" in heads else 1)]


def _wrapped(text: str) -> list[str]:
    lines = [""]
    for word in text.split(" "):
        longer = f"{lines[-1]} {word}".strip(" ")
        if len(longer) <= 120:
            lines[-1] = longer
        else:
            lines.append(word)
    return lines


def _dataset(board: Board, boards: Sequence[Board]) -> str:
    """The name of a board's data set; the beginning of its hash where another board has the same name.

    Behind it stands which other version made the board's figures.
    """
    alike = {one.fingerprint for one in boards if one.dataset == board.dataset}
    told = f"{board.dataset} ({board.fingerprint[:8]})" if len(alike) > 1 else board.dataset
    return f"{told}, {board.made_by}" if board.made_by else told


def _published(board: Board, row: Row) -> dict[str, Value]:
    found = (
        one for one in board.rows if one.kind == "published" and (one.model, one.labels) == (row.model, row.labels)
    )
    return next((dict(one.figures) for one in found), {})


def _last(row: Row) -> str | None:
    """The name of the distance after the last control step; None of a row without control."""
    found = _steps(row, "control_distance") if any(name.startswith(CONTROLLED) for name in row.figures) else {}
    return f"control_distance[{max(found)}]" if found else None


def _steps(row: Row, base: str) -> dict[int, float]:
    return _of_steps(row.figures, base)


def _of_steps(figures: Mapping[str, Value], base: str) -> dict[int, float]:
    places = ((_STEP.fullmatch(name), value.mean) for name, value in figures.items())
    return dict(sorted((int(found[2]), value) for found, value in places if found and found[1] == base))


def _drawn(model: str, boards: Sequence[Board], base: str) -> list[Place]:
    """Of each board and label budget the row with the least error; what one demonstration does, more need not show."""
    best: dict[tuple[tuple[str, ...], str], Place] = {}
    for board, row in _places(model, boards):
        key = (board.key, row.labels)
        if len(_steps(row, base)) < 2 or RANKED_BY not in row.figures or row.planned_otherwise:
            continue
        if key not in best or row.figures[RANKED_BY].mean < best[key][1].figures[RANKED_BY].mean:
            best[key] = (board, row)
    return _one_of_shots(best)


def _drawn_of_control(model: str, boards: Sequence[Board]) -> list[Place]:
    """The rows of control by the headline's frozen planner; of a model without these, by the boards' planners."""
    return _by_headline(model, boards) or _drawn(model, boards, "control_distance")


def _by_headline(model: str, boards: Sequence[Board]) -> list[Place]:
    """Of each data set and label budget the model's first row of the headline's column, where the best are first."""
    best: dict[tuple[tuple[str, ...], str], Place] = {}
    for board, row in _places(model, [one for board in boards if (one := board.by_headline) is not None]):
        if len(_steps(row, "control_distance")) > 1:
            best.setdefault((board.key, row.labels), (board, row))
    return _one_of_shots(best)


def _one_of_shots(best: Mapping[tuple[tuple[str, ...], str], Place]) -> list[Place]:
    """Rows by board and budget, without those of several demonstrations where there is one of one."""
    one_shot = {board for board, asked in best if asked == "one-shot"}
    return [place for (board, asked), place in best.items() if not (board in one_shot and MORE_SHOTS.fullmatch(asked))]


def _rollout(model: str, boards: Sequence[Board], words: str) -> str:
    series = []
    for place in (places := _drawn(model, boards, "rollout_mse")):
        copied = place[0].reference("copy_last")
        own = _steps(place[1], "rollout_mse")
        known = {step: copied[f"rollout_mse[{step}]"].mean for step in own if f"rollout_mse[{step}]" in copied}
        points = [Point(x=float(step), y=own[step] / known[step]) for step in own if known.get(step)]
        series.append(_series(place, places, boards, points))
    ticks = sorted({point.x for one in series for point in one.points})
    axes = Axis(label="steps ahead", ticks=ticks), Axis(label="MSE / that of copying", log=True)
    return _file(line_chart(words, *axes, series, [Guide(REFERENCE_WORDS["copy_last"], 1.0)], sized=True), series)


def _controlled(model: str, boards: Sequence[Board], words: str) -> str:
    series = []
    for place in (places := _drawn_of_control(model, boards)):
        points = [Point(x=float(step), y=value) for step, value in _steps(place[1], "control_distance").items()]
        start = [] if points[0].x == 0 else [Point(x=0.0, y=1.0)]
        line = _series(place, places, boards, start + points)
        series.append(replace(line, name=line.name + tuned_words(*place, _last(place[1]) or "")))
    for name in ("idle", "oracle"):
        curves = [(board, _of_steps(board.reference(name), "control_distance")) for board, _ in places]
        first, steps = next(((board, own) for board, own in curves if own), curves[0])
        points = [Point(x=0.0, y=1.0), *(Point(x=float(step), y=value) for step, value in steps.items())]
        if steps:
            alike = all(own == steps for _, own in curves)
            named = REFERENCE_WORDS[name] + ("" if alike else f", {_dataset(first, boards)}")
            line = Series(name=named, points=points, style=Style(-1), dash="dotted", marked=frozenset(), labelled=True)
            series.append(line)
    axes = Axis(label="control step"), Axis(label="distance to the goal / at the start", zero=True)
    return _file(line_chart(words, *axes, series, sized=True), series)


def _series(place: Place, places: Sequence[Place], boards: Sequence[Board], points: Sequence[Point]) -> Series:
    """A line of a row: its colour is its board's, and it is dashed unless its labels are the usual ones.

    Where a board has a model with one label for each action and with all labels, the former are the usual ones.
    """
    board, row = place
    mine = {one.labels for other, one in places if other.fingerprint == board.fingerprint}
    usual = next((one for one in USUAL if one in mine), None)
    order = list(dict.fromkeys(one.fingerprint for one, _ in places))
    variant = f" ({row.variant})" if row.variant else ""
    steps = sorted(point.x for point in points)
    every = 10 if steps[-1] >= 20 else 1
    return Series(
        name=f"{_dataset(board, boards)}{variant}, {row.labels if '-' in row.labels else f'labels {row.labels}'}",
        points=points,
        style=Style(order.index(board.fingerprint)),
        dash="solid" if row.labels == usual else "dashed",
        marked=frozenset(step for step in steps if step % every == 0 or step == steps[0]),
    )


def _file(chart: Markup, series: Sequence[Series]) -> str:
    """A chart with its legend as the text of an SVG file; what is named in the chart is not in the legend."""
    series = [one for one in series if not one.labelled]
    css = resources.files(__package__).joinpath("page.css").read_text()
    colors = css.partition("{")[2].partition("}")[0]
    style = f":root {{{colors}}}\n" + "\n".join(_STYLED.findall(css))
    words = [textwrap.wrap(one.name, (WIDTH - _LEGEND_LEFT) // _LETTER, break_on_hyphens=False) for one in series]
    above = [0, *itertools.accumulate(map(len, words))]
    height = HEIGHT + 8 + _LINE_HEIGHT * above[-1]
    legend = [
        _legend(one, lines, HEIGHT + 14 + _LINE_HEIGHT * before)
        for one, lines, before in zip(series, words, above, strict=False)
    ]
    picture = element(
        "svg",
        element("style", Markup(style)),
        element("rect", width="100%", height="100%", fill="var(--paper)"),
        chart,
        element("g", joined(legend), class_="chart"),
        xmlns="http://www.w3.org/2000/svg",
        viewBox=f"0 0 {WIDTH} {height}",
        width=WIDTH,
        height=height,
    )
    return f"{picture}\n"


def _legend(one: Series, lines: Sequence[str], y: float) -> Markup:
    line = element("path", d=f"M12 {y:g}H44", class_=f"line {one.dash}")
    text = [
        element("text", words, x=_LEGEND_LEFT, y=f"{y + 4 + _LINE_HEIGHT * place:g}")
        for place, words in enumerate(lines)
    ]
    return element("g", line, marker(one.style, 28, y), *text, class_=one.style.color)
