"""The page in a real browser: it reads, sorts and unfolds, by mouse and by keyboard, on a desk and on a phone."""

from __future__ import annotations

import itertools
import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from browser import CHROMIUM, Browser, browsing
from PIL import Image

from dmotion_bench.scoring.references import published_results
from leaderboard.entry import Entry, published_entry
from leaderboard.page import make_page
from leaderboard.paper import label_count

from .conftest import controlled
from .test_page import _hostile

pytestmark = pytest.mark.skipif(CHROMIUM is None, reason="no Chromium is installed (apt install chromium)")

DESK, PHONE = (1280, 900), (390, 844)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with browsing(tmp_path_factory.mktemp("profile")) as browser:
        yield browser


@pytest.fixture(scope="module")
def page(sound: Entry, tmp_path_factory: pytest.TempPathFactory) -> Path:
    published = [published_entry(row, label_count(row.environment, row.labels)) for row in published_results()]
    others = [controlled(sound, "cswm", 0.8), controlled(sound, "lapo", 0.3)]
    path = tmp_path_factory.mktemp("page") / "index.html"
    path.write_text(make_page([sound, *others, *published]))
    return path


def _show(browser: Browser, page: Path, size: tuple[int, int], *, dark: bool = False, fragment: str = "") -> None:
    browser.requests.clear()
    browser.complaints.clear()
    browser.show(page, width=size[0], height=size[1], dark=dark, fragment=fragment)


@pytest.mark.slow
@pytest.mark.parametrize("size", [DESK, PHONE])
def test_it_asks_for_nothing_complains_of_nothing_and_fits(
    browser: Browser, page: Path, size: tuple[int, int], tmp_path: Path
) -> None:
    _show(browser, page, size)
    browser.picture(tmp_path / "page.png")

    assert {address.split("#")[0] for address in browser.requests} <= {page.resolve().as_uri(), "about:blank"}
    assert browser.complaints == []
    assert browser.ask("document.documentElement.scrollWidth") <= size[0]  # wide tables scroll in their frames
    assert browser.ask("[...document.images].every(one => one.naturalWidth > 0 || one.loading === 'lazy')")
    assert len(np.unique(np.asarray(Image.open(tmp_path / "page.png").convert("RGB")).reshape(-1, 3), axis=0)) > 50


def _column(browser: Browser, heading: str) -> list[float]:
    """The values of a column from top to bottom; infinite where there is none."""
    return [
        float("inf") if value is None else float(value)
        for value in json.loads(
            browser.ask(
                f"""JSON.stringify((() => {{
                  const table = document.querySelector("table.standings");
                  const head = [...table.tHead.rows[0].cells].findIndex(one => one.innerText.startsWith({heading!r}));
                  return [...table.tBodies[0].rows].map(row => row.cells[head].dataset.value ?? null);
                }})())"""
            )
        )
    ]


def _sorted_by(browser: Browser) -> list[list[str]]:
    found: list[list[str]] = json.loads(
        browser.ask(
            """JSON.stringify([...document.querySelector("table.standings").querySelectorAll("[aria-sort]")]
            .map(one => [one.innerText.trim(), one.getAttribute("aria-sort")]))"""
        )
    )
    return found


def test_headings_sort_by_mouse_and_by_keyboard(browser: Browser, page: Path) -> None:
    _show(browser, page, DESK)
    button = 'document.querySelector("table.standings").tHead.rows[0].cells[1].querySelector("button")'

    assert _sorted_by(browser) == [["MSE", "ascending"]]
    first = _column(browser, "MSE")
    assert first == sorted(first)

    browser.ask(f"{button}.click()")
    counts = _column(browser, "Labels")
    assert counts == sorted(counts)
    assert _sorted_by(browser) == [["Labels", "ascending"]]

    browser.ask(f"{button}.focus()")
    browser.press("Enter", 13)
    counts = list(_column(browser, "Labels"))
    known = [count for count in counts if np.isfinite(count)]
    assert known == sorted(known, reverse=True)
    assert counts[: len(known)] == known  # what has no value stays last
    assert _sorted_by(browser) == [["Labels", "descending"]]


def test_the_table_of_control_sorts_and_its_chart_names_lines_inside_it(browser: Browser, page: Path) -> None:
    _show(browser, page, PHONE)
    table = 'document.querySelectorAll("table.standings")[1]'
    ends = f"""JSON.stringify([...{table}.tBodies[0].rows].map(row => Number(row.cells[2].dataset.value)))"""
    assert json.loads(browser.ask(ends)) == pytest.approx([0.1, 0.3, 0.8, 1.0])  # the oracle, two models, idle
    browser.ask(f'{table}.tHead.rows[0].cells[2].querySelector("button").click()')
    assert json.loads(browser.ask(ends)) == pytest.approx([1.0, 0.8, 0.3, 0.1])
    inside = """[...document.querySelectorAll(".chart .name")].every(name => {
      const own = name.getBoundingClientRect(), chart = name.closest("svg").getBoundingClientRect();
      return own.left >= chart.left && own.right <= chart.right && own.top >= chart.top && own.bottom <= chart.bottom;
    })"""
    assert browser.ask('document.querySelectorAll(".chart .name").length') >= 4
    assert browser.ask(inside)


def test_every_control_can_be_reached_by_tab(browser: Browser, page: Path) -> None:
    _show(browser, page, DESK)
    reached = []
    for _ in range(12):
        browser.press("Tab", 9)
        reached.append(browser.ask("document.activeElement.tagName + ' ' + document.activeElement.innerText.trim()"))

    assert any(name.startswith("SUMMARY") for name in reached)
    assert "BUTTON MSE" in reached
    assert browser.ask("getComputedStyle(document.activeElement).outlineStyle") != "none"


def test_a_name_leads_to_where_its_numbers_come_from(browser: Browser, page: Path) -> None:
    _show(browser, page, DESK)
    name = browser.ask("document.querySelector('tr.measured a').hash")

    assert not browser.ask(f"document.querySelector({name!r}).open")
    browser.ask("document.querySelector('tr.measured a').click()")
    browser.ask("new Promise(done => setTimeout(done, 50))")
    assert browser.ask(f"document.querySelector({name!r}).open")
    _show(browser, page, DESK, fragment=name)
    assert browser.ask(f"document.querySelector({name!r}).open")


def test_the_legend_brings_a_model_forward(browser: Browser, page: Path) -> None:
    _show(browser, page, DESK)
    browser.ask("document.querySelector('.legend button').click()")

    chosen, faded = (
        browser.ask(f"getComputedStyle(document.querySelector('.charts .series{which}')).opacity")
        for which in (".chosen", ":not(.chosen)")
    )
    assert browser.ask("document.querySelector('.legend button').getAttribute('aria-pressed')") == "true"
    browser.ask("new Promise(done => setTimeout(done, 250))")
    chosen, faded = (
        float(browser.ask(f"getComputedStyle(document.querySelector('.charts .series{which}')).opacity"))
        for which in (".chosen", ":not(.chosen)")
    )
    assert (chosen, faded < 0.2) == (1, True)


def _luminance(color: str) -> float:
    """Relative luminance of a CSS colour (WCAG 2.2)."""
    parts = np.array([float(one) for one in color[color.index("(") + 1 : -1].split(",")[:3]]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    return float(linear @ [0.2126, 0.7152, 0.0722])


def _contrast(one: str, other: str) -> float:
    low, high = sorted((_luminance(one), _luminance(other)))
    return (high + 0.05) / (low + 0.05)


@pytest.mark.parametrize("dark", [False, True])
def test_text_and_lines_stand_out_from_the_paper(browser: Browser, page: Path, dark: bool) -> None:
    _show(browser, page, DESK, dark=dark)
    paper = browser.ask("getComputedStyle(document.body).backgroundColor")
    texts = ("body", ".note", "a", "tr.published td", "thead th button", "small", "dt", "figcaption")
    for place in texts:
        assert _contrast(browser.ask(f"getComputedStyle(document.querySelector({place!r})).color"), paper) >= 4.5, place
    labels = browser.ask("getComputedStyle(document.querySelector('.chart text')).fill")
    assert _contrast(labels, paper) >= 4.5
    colors = json.loads(
        browser.ask(
            """JSON.stringify([...Array(7).keys()].map(n => { const one = document.createElement("i");
            one.className = "c" + n; document.body.append(one); return getComputedStyle(one).color; }))"""
        )
    )
    assert all(_contrast(color, paper) >= 3 for color in colors)
    assert len(set(colors)) == 7
    assert (_luminance(paper) < 0.1) is dark


# How the colour-blind see sRGB: Viénot, Brettel and Mollon 1999, on linear values.
DEUTERAN = np.array([[0.29275, 0.70725, 0.0], [0.29275, 0.70725, 0.0], [-0.02234, 0.02234, 1.0]])
PROTAN = np.array([[0.11238, 0.88762, 0.0], [0.11238, 0.88762, 0.0], [0.00401, -0.00401, 1.0]])


def test_neighbouring_colours_differ_for_the_colour_blind(browser: Browser, page: Path) -> None:
    _show(browser, page, DESK)
    colors = json.loads(
        browser.ask(
            """JSON.stringify([...Array(7).keys()].map(n => { const one = document.createElement("i");
            one.className = "c" + n; document.body.append(one); return getComputedStyle(one).color; }))"""
        )
    )
    parts = np.array([[float(x) for x in one[4:-1].split(",")] for one in colors]) / 255
    linear = np.where(parts <= 0.04045, parts / 12.92, ((parts + 0.055) / 1.055) ** 2.4)
    for matrix in (DEUTERAN, PROTAN):
        seen = np.clip(linear @ matrix.T, 0, 1)
        coded = np.where(seen <= 0.0031308, seen * 12.92, 1.055 * seen ** (1 / 2.4) - 0.055)
        apart = [np.linalg.norm(a - b) for a, b in itertools.pairwise(coded)]
        assert min(apart) > 0.1, apart


def test_printed_the_tables_fit_a_sheet(browser: Browser, page: Path) -> None:
    sheet = 1032  # A4 on its side, without its margins [px at 96 an inch]
    _show(browser, page, (sheet, 700), dark=True)
    browser.call("Emulation.setEmulatedMedia", media="print")
    try:
        assert browser.ask("document.documentElement.scrollWidth") <= sheet
        assert browser.ask("getComputedStyle(document.body).backgroundColor") == "rgb(255, 255, 255)"
        assert browser.ask("getComputedStyle(document.querySelector('tr.measured td')).color") == "rgb(0, 0, 0)"
        assert browser.call("Page.printToPDF", preferCSSPageSize=True)["data"].startswith("JVBERi")  # %PDF
    finally:
        browser.call("Emulation.setEmulatedMedia", media="")


def test_a_hostile_entry_runs_nothing(browser: Browser, sound: Entry, tmp_path: Path) -> None:
    path = tmp_path / "hostile.html"
    path.write_text(make_page([_hostile(sound)]))

    _show(browser, path, PHONE)

    assert browser.ask("typeof hacked") == "undefined"
    assert browser.complaints == []
    assert browser.ask("document.scripts.length") == 1
    assert browser.ask("document.documentElement.scrollWidth") <= PHONE[0]


@pytest.mark.slow
def test_the_policy_stops_a_script_that_slipped_through(browser: Browser, page: Path, tmp_path: Path) -> None:
    path = tmp_path / "slipped.html"
    path.write_text(page.read_text().replace("<main>", "<main><script>window.hacked = 1</script>", 1))

    _show(browser, path, DESK)

    assert browser.ask("window.hacked") is None
    assert any("Content Security Policy" in one for one in browser.complaints)


@pytest.mark.slow
def test_without_scripts_it_still_reads(browser: Browser, page: Path) -> None:
    browser.call("Emulation.setScriptExecutionDisabled", value=True)
    try:
        _show(browser, page, PHONE)
        text = browser.ask("document.body.innerText")
        buttons = browser.ask("document.querySelectorAll('table.standings button').length")
    finally:
        browser.call("Emulation.setScriptExecutionDisabled", value=False)

    assert "as published" in text
    assert buttons == 0  # nothing that would do nothing
