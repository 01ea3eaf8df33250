"""Charts: a value is drawn where it belongs, and a series is never known by its colour alone."""

from __future__ import annotations

import itertools
import re
import xml.etree.ElementTree as ET

import pytest

from leaderboard.chart import (
    BOTTOM,
    COLORS,
    HEIGHT,
    LEFT,
    MARKERS,
    RIGHT,
    TOP,
    WIDTH,
    Axis,
    Guide,
    Point,
    Series,
    Style,
    line_chart,
    marker,
)


def _drawn(text: str) -> ET.Element:
    return ET.fromstring(text)  # well formed, or this raises


def _line(svg: ET.Element) -> list[tuple[float, float]]:
    (path,) = (one for one in svg.iter("path") if one.get("class", "").startswith("line "))
    return [(float(x), float(y)) for x, y in re.findall(r"[ML](\S+) ([^ML]+)", path.get("d", ""))]


def _ticks(svg: ET.Element, anchor: str) -> dict[str, float]:
    name = "x" if anchor == "middle" else "y"
    return {
        text.text or "": float(text.get(name, 0))
        for text in svg.iter("text")
        if text.get("text-anchor") == anchor and text.get("class") is None
    }


def test_a_logarithmic_axis_gives_each_factor_the_same_room() -> None:
    points = [Point(x=10.0**power, y=2.0**power) for power in range(4)]
    svg = _drawn(
        line_chart(
            "t", Axis(label="x", log=True), Axis(label="y", log=True), [Series(name="s", points=points, style=Style(0))]
        )
    )

    places = _line(svg)
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in itertools.pairwise(places)]

    assert all(step == pytest.approx(steps[0], abs=0.21) for step in steps)
    assert steps[0][0] > 0 > steps[0][1]  # up is less y
    ticks = _ticks(svg, "middle")
    assert ticks["10"] == pytest.approx(places[1][0], abs=0.1)
    assert ticks["1,000"] == pytest.approx(places[3][0], abs=0.1)


def test_a_linear_axis_and_its_ticks() -> None:
    points = [Point(x=0, y=0), Point(x=50, y=1), Point(x=100, y=4)]
    svg = _drawn(
        line_chart("t", Axis(label="x"), Axis(label="y", zero=True), [Series(name="s", points=points, style=Style(0))])
    )

    (x0, y0), (x1, y1), (x2, y2) = _line(svg)

    assert x1 - x0 == pytest.approx(x2 - x1, abs=0.11)
    assert (y0 - y2) == pytest.approx(4 * (y0 - y1), abs=0.3)
    ticks = _ticks(svg, "end")
    assert ticks["0"] == pytest.approx(y0 + 4, abs=0.1)
    assert ticks["4"] == pytest.approx(y2 + 4, abs=0.1)
    assert all(LEFT <= x <= WIDTH - RIGHT and TOP <= y <= HEIGHT - BOTTOM for x, y in _line(svg))


def test_intervals_and_guides_are_drawn_at_their_values() -> None:
    series = [Series(name="s", points=[Point(x=1, y=10, low=5, high=20), Point(x=2, y=10)], style=Style(0))]
    svg = _drawn(line_chart("t", Axis(label="x"), Axis(label="y", log=True), series, [Guide("idle", 10.0)]))

    (bar,) = (one for one in svg.iter("path") if one.get("class") == "bar")
    low, high = (float(value) for value in re.findall(r"M\S+ (\S+)V(\S+)", bar.get("d", ""))[0])
    (guide,) = (one for one in svg.iter("path") if one.get("class") == "guide line")
    at = float(re.findall(r"M\d+ (\S+)H", guide.get("d", ""))[0])
    line = _line(ET.fromstring(ET.tostring(next(one for one in svg.iter("g") if "series" in one.get("class", "")))))

    assert at == pytest.approx(line[0][1], abs=0.11)
    assert low - at == pytest.approx(at - high, abs=0.2)  # a factor of two either way


def test_labels_on_an_axis_do_not_touch() -> None:
    counts = [4.0, 5.0, 20.0, 1889.0, 1890.0, 18900.0]
    points = [Point(x=count, y=1) for count in counts]
    svg = _drawn(
        line_chart(
            "t",
            Axis(label="x", log=True, ticks=counts),
            Axis(label="y"),
            [Series(name="s", points=points, style=Style(0))],
        )
    )

    ticks = sorted(_ticks(svg, "middle").items(), key=lambda tick: tick[1])

    assert next(text for text, _ in ticks) == "4"
    assert all(b[1] - a[1] > 5.5 * (len(a[0]) + len(b[0])) / 2 for a, b in itertools.pairwise(ticks))


def test_where_labels_would_touch_the_tick_that_is_named_first_has_its_label() -> None:
    counts = [1024.0, 4096.0, 4.0, 989.0, 3990.0]
    points = [Point(x=count, y=1) for count in counts]
    axes = Axis(label="x", log=True, ticks=counts), Axis(label="y")
    svg = _drawn(line_chart("t", *axes, [Series(name="s", points=points, style=Style(0))]))

    assert set(_ticks(svg, "middle")) == {"4", "1,024", "4,096"}


def test_the_name_of_a_guide_stands_where_no_line_runs() -> None:
    def middle(*levels: float) -> float:
        points = [Point(x=float(x), y=y) for x, y in enumerate(levels)]
        lines = [Series(name="s", points=points, style=Style(0))]
        svg = _drawn(line_chart("t", Axis(label="x"), Axis(label="y"), lines, [Guide("all labels", 1.0)]))
        (name,) = (text for text in svg.iter("text") if text.get("class") == "name")
        return float(name.get("x", 0))

    assert middle(1, 1, 1, 5, 5, 5) > (LEFT + WIDTH - RIGHT) / 2 > middle(5, 5, 5, 1, 1, 1)


def test_a_ringed_point_keeps_its_marker_and_has_a_ring() -> None:
    points = [Point(x=1, y=1, ringed=True), Point(x=2, y=2)]
    svg = _drawn(line_chart("t", Axis(label="x"), Axis(label="y"), [Series(name="s", points=points, style=Style(0))]))
    classes = [path.get("class") for path in svg.iter("path")]
    assert (classes.count("marker"), classes.count("ring")) == (2, 1)


def test_what_a_logarithm_cannot_show_is_left_out_and_nothing_at_all_is_no_error() -> None:
    log = Axis(label="x", log=True)
    points = [
        Point(x=0, y=1),
        Point(x=1, y=0),
        Point(x=2, y=float("nan")),
        Point(x=3, y=5),
        Point(x=4, y=6),
        Point(x=5, y=5e-324),
    ]

    svg = _drawn(line_chart("t", log, log, [Series(name="s", points=points, style=Style(0))]))

    assert len(_line(svg)) == 2
    assert _drawn(line_chart("t", log, Axis(label="y"), [])).tag == "svg"


def test_neighbours_differ_in_colour_and_no_two_of_many_are_drawn_alike() -> None:
    looks = [(Style(index).color, marker(Style(index), 0, 0)) for index in range(COLORS * MARKERS)]

    assert len(set(looks)) == len(looks)
    assert all(a[0] != b[0] and a[1] != b[1] for a, b in itertools.pairwise(looks))


def test_lines_are_named_at_their_ends_and_no_name_stands_on_another() -> None:
    ends = {"a": 0.5, "b": 0.51, "c": 0.52, "d": 3.0}
    series = [
        Series(name=name, points=[Point(x=0, y=1), Point(x=9, y=y)], style=Style(-1), labelled=True)
        for name, y in ends.items()
    ]
    svg = _drawn(line_chart("t", Axis(label="x"), Axis(label="y", zero=True), series))

    heights = {text.text: float(text.get("y", 0)) for text in svg.iter("text") if text.get("class") == "name"}
    lines = [path.get("d", "") for path in svg.iter("path") if path.get("class") == "line solid"]
    at_end = dict(zip(ends, (float(line.split()[-1]) for line in lines), strict=True))

    assert heights["a"] == pytest.approx(at_end["a"] - 4, abs=1)
    assert heights["d"] == pytest.approx(at_end["d"] - 4, abs=0.1)
    assert all(a - b >= 12.9 for a, b in itertools.pairwise(sorted(heights.values(), reverse=True)))
    assert sorted(heights, key=lambda name: -heights[name]) == ["a", "b", "c", "d"]


def test_the_name_of_a_line_leaves_its_end_where_another_line_runs() -> None:
    def right_end(*levels: float) -> float:
        named = Series(name="script", points=[Point(x=0, y=3), Point(x=9, y=1)], style=Style(-1), labelled=True)
        other = Series(name="s", points=[Point(x=float(x), y=y) for x, y in enumerate(levels)], style=Style(0))
        svg = _drawn(line_chart("t", Axis(label="x"), Axis(label="y", zero=True), [named, other]))
        (name,) = (text for text in svg.iter("text") if text.get("class") == "name")
        return float(name.get("x", 0))

    assert right_end(*[0.1] * 10) == WIDTH - RIGHT
    assert right_end(*[0.1] * 6, *[1.1] * 4) < WIDTH - RIGHT


def test_names_are_text() -> None:
    series = [Series(name='</title><script>"', points=[Point(x=1, y=1)], style=Style(0))]

    svg = _drawn(line_chart("<b>", Axis(label="<x>"), Axis(label="&y"), series, [Guide("<g>", 1.0)]))

    assert [title.text for title in svg.iter("title")] == ["<b>", '</title><script>"']
    assert not list(svg.iter("script"))
