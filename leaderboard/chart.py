"""Line charts as SVG, written by hand: no plotting library, no script, and they print.

A series is known by its colour and its marker and, where it needs to be, its dash, never by colour alone. Colours
are Okabe and Ito's for the colour-blind (2008, without the yellow that paper swallows); they are set in
``page.css``, so that they suit light and dark.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Final

from leaderboard.columns import count
from leaderboard.markup import Markup, element, joined

COLORS: Final = 7
"""Classes ``c0`` ... of the style sheet."""

MARKERS: Final = 8
RADIUS: Final = 4.2
RING: Final = 7.2
WIDTH, HEIGHT = 460, 330
LEFT, RIGHT, TOP, BOTTOM = 56, 14, 12, 46
NAME_HEIGHT: Final = 13
TEXT_WIDTH: Final = 6.4
"""Of a letter of a name, about."""

PLACES: Final = 9
"""Along a line at which its name may stand."""


SMALLEST: Final = 1e-12
"""What a logarithmic axis can show; errors below it are none."""


@dataclass(frozen=True)
class Style:
    """How a series looks.

    Args:
        index: Of the series among all that stand on a page; below zero for a line that is grey.
        hue: Number of its colour; by the index where none is given.
        shape: Number of its marker's shape; likewise.
    """

    index: int
    hue: int | None = None
    shape: int | None = None

    @property
    def color(self) -> str:
        """A class of the style sheet."""
        return f"c{(self.index if self.hue is None else self.hue) % COLORS}" if self.index >= 0 else "c-1"

    @property
    def marker(self) -> int:
        """Number of the marker's shape."""
        return (self.index if self.shape is None else self.shape) % MARKERS


@dataclass(frozen=True, kw_only=True)
class Point:
    """A value with its interval; a ringed one is of another kind than its neighbours, as the legend says."""

    x: float
    y: float
    low: float | None = None
    high: float | None = None
    ringed: bool = False


@dataclass(frozen=True, kw_only=True)
class Series:
    """Points that belong together.

    Attributes:
        name: Said by the browser where the pointer rests.
        points: Left to right.
        style: Colour and marker.
        dash: ``"solid"``, ``"dashed"`` or ``"dotted"``.
        hollow: Whether the markers are drawn empty.
        marked: Which points have a marker; all by default.
        labelled: Whether its name stands beside it: at its end, or where fewer lines run.
    """

    name: str
    points: Sequence[Point]
    style: Style
    dash: str = "solid"
    hollow: bool = False
    marked: frozenset[float] | None = None
    labelled: bool = False


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One axis.

    Attributes:
        label: What it says.
        log: Logarithmic.
        ticks: Where it is labelled, chosen by the range where none are given. Where two labels would touch, the tick
            that stands first in this list has its label.
        zero: Whether a linear axis begins at zero.
    """

    label: str
    log: bool = False
    ticks: Sequence[float] = ()
    zero: bool = False


@dataclass(frozen=True)
class Guide:
    """A horizontal line to measure by."""

    name: str
    y: float


@dataclass(frozen=True)
class _Scale:
    """From values to pixels."""

    low: float
    high: float
    start: float
    stop: float
    log: bool

    def __call__(self, value: float) -> float:
        low, high = (math.log(self.low), math.log(self.high)) if self.log else (self.low, self.high)
        place = math.log(max(value, self.low)) if self.log else value
        return self.start + (place - low) / (high - low) * (self.stop - self.start)


def line_chart(
    title: str, x: Axis, y: Axis, series: Sequence[Series], guides: Sequence[Guide] = (), *, sized: bool = False
) -> Markup:
    """A chart of some series; what a logarithmic axis cannot show is left out.

    Args:
        title: What a screen reader says of it.
        x, y: The axes.
        series: Drawn in their order.
        guides: Horizontal lines to measure by.
        sized: Whether it has a size of its own, as within another picture; on a page it is as wide as its column.
    """
    series = [_drawable(one, x, y) for one in series]
    guides = [guide for guide in guides if not (y.log and guide.y < SMALLEST)]
    across = _scale(x, [point.x for one in series for point in one.points], LEFT, WIDTH - RIGHT)
    heights = [value for one in series for point in one.points for value in (point.y, point.low, point.high)]
    heights += [guide.y for guide in guides]
    up = _scale(y, [value for value in heights if value is not None], HEIGHT - BOTTOM, TOP)
    return element(
        "svg",
        element("title", title),
        joined(_grid(x, across, vertical=True)),
        joined(_grid(y, up, vertical=False)),
        joined(_guide(guide, up) for guide in guides),
        joined(_series(one, across, up) for one in series if one.points),
        joined(_names(guides, up, lambda name, height: _free_place(name, height, series, across, up))),
        joined(_line_names(series, across, up)),
        viewBox=f"0 0 {WIDTH} {HEIGHT}",
        width=WIDTH if sized else None,
        height=HEIGHT if sized else None,
        role="img",
        aria_label=title,
        class_="chart",
    )


def marker(style: Style, x: float, y: float, *, hollow: bool = False) -> Markup:
    """The marker of a series at a place."""
    return element("path", d=_marker_path(style.marker, x, y), class_="marker hollow" if hollow else "marker")


def _ring(x: float, y: float) -> Markup:
    return element("path", d=_marker_path(0, x, y, RING), class_="ring")


def key(style: Style, *, ringed: bool = False) -> Markup:
    """A piece of a series for a legend; of ringed points the ring alone."""
    drawn = [element("path", d="M1 8H33", class_="line solid"), marker(style, 17, 8)]
    return element(
        "svg",
        *([_ring(17, 8)] if ringed else drawn),
        viewBox="0 0 34 16",
        class_=f"key {style.color}",
        aria_hidden="true",
    )


def _drawable(one: Series, x: Axis, y: Axis) -> Series:
    points = [
        point
        for point in one.points
        if math.isfinite(point.y) and not ((y.log and point.y < SMALLEST) or (x.log and point.x < SMALLEST))
    ]
    return replace(one, points=points)


def _scale(axis: Axis, values: Sequence[float], start: float, stop: float) -> _Scale:
    usable = [value for value in [*values, *axis.ticks] if math.isfinite(value) and not (axis.log and value < SMALLEST)]
    low, high = (min(usable), max(usable)) if usable else (1.0, 10.0)
    if axis.log:
        room = max((high / low) ** 0.06, 1.15)
        return _Scale(low / room, high * room, start, stop, log=True)
    if axis.zero:
        low = min(low, 0.0)
    span = (high - low) or abs(high) or 1.0
    return _Scale(low - (0 if axis.zero and low == 0 else 0.06 * span), high + 0.06 * span, start, stop, log=False)


def _ticks(axis: Axis, scale: _Scale) -> list[float]:
    if axis.ticks:
        return list(axis.ticks)
    if scale.log:
        first, last = math.floor(math.log10(scale.low)), math.ceil(math.log10(scale.high))
        for steps in ((1.0, 2.0, 5.0), (1.0, 3.0), (1.0,)):
            ticks = [step * 10.0**power for power in range(first, last + 1) for step in steps]
            ticks = [tick for tick in ticks if scale.low <= tick <= scale.high]
            if len(ticks) <= 7:
                break
        return ticks
    rough = (scale.high - scale.low) / 5
    size = 10.0 ** math.floor(math.log10(rough))
    step = next(size * factor for factor in (1, 2, 2.5, 5, 10) if size * factor >= rough)
    return [step * place for place in range(math.ceil(scale.low / step), math.floor(scale.high / step) + 1)]


def _grid(axis: Axis, scale: _Scale, *, vertical: bool) -> Iterator[Markup]:
    floor, wall = HEIGHT - BOTTOM, WIDTH - RIGHT
    labelled: list[tuple[float, int]] = []
    for tick in _ticks(axis, scale):
        place, text = round(scale(tick), 1), count(tick)
        if vertical:
            yield element("path", d=f"M{place:g} {floor}v5", class_="axis")
            if all(abs(place - other) > 3.5 * (len(text) + size) for other, size in labelled):  # none may touch
                yield element("text", text, x=place, y=floor + 18, text_anchor="middle")
                labelled.append((place, len(text)))
        else:
            yield element("path", d=f"M{LEFT} {place:g}H{wall}", class_="grid")
            yield element("text", text, x=LEFT - 8, y=place + 4, text_anchor="end")
    if vertical:
        yield element("path", d=f"M{LEFT} {floor}H{wall}", class_="axis")
        yield element("text", axis.label, x=(LEFT + wall) / 2, y=HEIGHT - 6, text_anchor="middle", class_="label")
    else:
        middle = (TOP + floor) / 2
        turned = f"rotate(-90 13 {middle:g})"
        yield element("text", axis.label, x=13, y=middle, text_anchor="middle", transform=turned, class_="label")


def _guide(guide: Guide, up: _Scale) -> Markup:
    return element("path", d=f"M{LEFT} {up(guide.y):.1f}H{WIDTH - RIGHT}", class_="guide line")


def _free_place(name: str, height: float, series: Sequence[Series], across: _Scale, up: _Scale) -> float:
    """Where a name has the fewest lines behind it: the middle of the text, in pixels; of equal places the leftmost."""
    half = TEXT_WIDTH * len(name) / 2

    def covered(middle: float) -> int:
        return _crossed(series, middle - half, middle + half, height, across, up)

    first, last = LEFT + half + 4, WIDTH - RIGHT - half - 4
    steps = range(PLACES) if last > first else range(1)
    return min((first + (last - first) * step / (PLACES - 1) for step in steps), key=covered)


def _crossed(series: Sequence[Series], left: float, right: float, foot: float, across: _Scale, up: _Scale) -> int:
    """How many series run through the box of a text."""
    spans = (_heights(one, left, right, across, up) for one in series)
    return sum(bool(span) and min(span) <= foot + RADIUS and max(span) >= foot - NAME_HEIGHT for span in spans)


def _heights(one: Series, left: float, right: float, across: _Scale, up: _Scale) -> list[float]:
    """The heights at which a series enters, bends and leaves within a stretch, in pixels."""
    places = [(across(point.x), up(point.y)) for point in one.points]
    heights = []
    for (x0, y0), (x1, y1) in zip(places, places[1:] or places, strict=False):
        begin, end = max(left, min(x0, x1)), min(right, max(x0, x1))
        if begin <= end:
            ends = ((begin, 0), (end, 1))
            heights += [y0 + (y1 - y0) * ((x - x0) / (x1 - x0) if x1 != x0 else share) for x, share in ends]
    return heights


def _names(named: Sequence[Guide], up: _Scale, middle: Callable[[str, float], float]) -> Iterator[Markup]:
    """What guides are called, each name above its line, or higher where another name stands there.

    Args:
        named: The guides.
        up: Their heights.
        middle: Where the middle of a name is, by the name and the foot of its text.
    """
    free = math.inf
    for guide in sorted(named, key=lambda one: one.y):
        foot = min(up(guide.y) - 4, free)
        free = foot - NAME_HEIGHT
        yield _name(guide.name, middle(guide.name, foot), foot, "middle")


def _line_names(series: Sequence[Series], across: _Scale, up: _Scale) -> Iterator[Markup]:
    """What labelled lines are called: at their ends as guides are, or beside the line where fewer others run."""
    free = math.inf
    for one in sorted((one for one in series if one.labelled and one.points), key=lambda one: one.points[-1].y):
        wide = TEXT_WIDTH * len(one.name)
        others = [other for other in series if other is not one]
        places = list(_along(one, wide, across, up))
        at_end = places[0] = (places[0][0], min(places[0][1], free))
        right, foot = min(places, key=lambda at: _crossed(others, at[0] - wide, at[0], at[1], across, up))
        if (right, foot) == at_end:
            free = foot - NAME_HEIGHT
        yield _name(one.name, right, foot, "end")


def _along(one: Series, wide: float, across: _Scale, up: _Scale) -> Iterator[tuple[float, float]]:
    """Where a text of a width may stand: its right end and its foot in pixels, above a line and then below it."""
    last = float(WIDTH - RIGHT)
    first = min(LEFT + wide, last)
    rights = [last + (first - last) * step / (PLACES - 1) for step in range(PLACES)]
    heights = [_heights(one, right - wide, right, across, up) or [up(one.points[-1].y)] for right in rights]
    yield from ((right, min(own) - 4) for right, own in zip(rights, heights, strict=True))
    below = ((right, max(own) + NAME_HEIGHT) for right, own in zip(rights, heights, strict=True))
    yield from ((right, foot) for right, foot in below if foot < HEIGHT - BOTTOM)


def _name(text: str, x: float, foot: float, anchor: str) -> Markup:
    return element("text", text, x=round(x, 1), y=round(foot, 1), text_anchor=anchor, class_="name")


def _series(one: Series, across: _Scale, up: _Scale) -> Markup:
    places = [(round(across(point.x), 1), round(up(point.y), 1)) for point in one.points]
    drawn: list[Markup | None] = [element("title", one.name)]
    for point, (x, _) in zip(one.points, places, strict=True):
        if point.low is not None and point.high is not None and one.marked is None:
            drawn.append(element("path", d=f"M{x:g} {up(point.low):.1f}V{up(point.high):.1f}", class_="bar"))
    if len(places) > 1:
        drawn.append(element("path", d="M" + "L".join(f"{x:g} {y:g}" for x, y in places), class_=f"line {one.dash}"))
    drawn += [
        marker(one.style, x, y, hollow=one.hollow)
        for point, (x, y) in zip(one.points, places, strict=True)
        if one.marked is None or point.x in one.marked
    ]
    drawn += [_ring(x, y) for point, (x, y) in zip(one.points, places, strict=True) if point.ringed]
    return element("g", *drawn, class_=f"series {one.style.color}", data_model=one.style.index)


def _marker_path(shape: int, x: float, y: float, r: float = RADIUS) -> str:
    if shape == 0:
        return f"M{x - r:.4g} {y:.4g}a{r} {r} 0 1 0 {2 * r} 0a{r} {r} 0 1 0 {-2 * r} 0z"
    corners = {
        1: _around(4, math.pi / 4, r * 1.2),
        2: _around(3, -math.pi / 2, r * 1.35),
        3: _around(4, -math.pi / 2, r * 1.35),
        4: _around(3, math.pi / 2, r * 1.35),
        5: _around(5, -math.pi / 2, r * 1.2),
        6: [(-r, -r), (r, -r), (-r, r), (r, r)],
        7: _star(r * 1.5),
    }[shape]
    return "M" + "L".join(f"{x + dx:.1f} {y + dy:.1f}" for dx, dy in corners) + "z"


def _around(count: int, turn: float, radius: float) -> list[tuple[float, float]]:
    angles = [turn + 2 * math.pi * place / count for place in range(count)]
    return [(radius * math.cos(angle), radius * math.sin(angle)) for angle in angles]


def _star(radius: float) -> list[tuple[float, float]]:
    outer, inner = _around(4, -math.pi / 2, radius), _around(4, -math.pi / 4, radius * 0.42)
    return [place for pair in zip(outer, inner, strict=True) for place in pair]
