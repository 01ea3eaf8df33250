"""The page as text: nothing of an entry becomes markup, nothing is fetched, the same entries make the same bytes."""

from __future__ import annotations

import base64
import copy
import hashlib
import re
from collections import Counter
from collections.abc import Callable
from html.parser import HTMLParser
from typing import Any

import pytest

from dmotion_bench.scoring.references import published_results
from leaderboard.entry import Entry, published_entry
from leaderboard.markup import VOID
from leaderboard.page import make_page
from leaderboard.paper import label_count

from .conftest import controlled
from .test_markup import Reader

Changed = Callable[..., Entry]
HOSTILE = "</style></script><script>hacked()</script><img src=x onerror=hacked()>\"' onload=hacked() {{1}}"


class Nesting(HTMLParser):
    """Whether every element is closed where it should be."""

    def __init__(self, text: str) -> None:
        super().__init__()
        self.open: list[str] = []
        self.wrong: list[str] = []
        self.feed(text)
        self.close()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.open.append(tag)

    def handle_startendtag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag not in VOID:
            self.wrong.append(tag)

    def handle_endtag(self, tag: str) -> None:
        if not self.open or self.open.pop() != tag:
            self.wrong.append(tag)


@pytest.fixture
def entries(sound: Entry, changed: Changed) -> list[Entry]:
    published = [published_entry(row, label_count(row.environment, row.labels)) for row in published_results()]
    return [sound, changed(run="cswm-s0", model="cswm", weights="1" * 64), *published]


def test_the_page_is_whole_and_says_what_is_in_it(entries: list[Entry]) -> None:
    page = make_page(entries)
    nesting, read = Nesting(page), Reader(page)

    assert (nesting.open, nesting.wrong) == ([], [])
    said = " ".join(read.said)
    for wanted in (
        "dmotion",
        "Yuan et al. 2021",
        "one-shot",
        "14.3",
        "copy the last frame",
        "Grid World",
        "Robot Push",
    ):
        assert wanted in said
    for hash_ in (entries[0].content["weights"], entries[0].content["dataset"]["fingerprint"]):
        assert hash_ in said
    assert len(page) < 5_000_000


def test_nothing_is_fetched_and_every_link_leads_somewhere(entries: list[Entry]) -> None:
    tags = Reader(make_page(entries)).tags
    names = Counter(attributes["id"] for _, attributes in tags if "id" in attributes)
    files = {f"entries/{entry.slug}.json" for entry in entries} | {"schema.json"}

    assert set(names.values()) == {1}
    for tag, attributes in tags:
        assert tag not in ("link", "iframe", "object", "embed", "base", "form")
        assert not any(name.startswith("on") or name == "style" for name in attributes)
        source, leads = attributes.get("src"), attributes.get("href")
        assert source is None or source.startswith("data:image/webp;base64,")
        assert leads is None or leads in files or leads.removeprefix("#") in names
        labelled = attributes.get("aria-labelledby")
        assert labelled is None or labelled in names
        assert tag != "img" or attributes.get("alt")


def test_boards_of_two_data_sets_of_one_name_have_links_that_differ(sound: Entry, changed: Changed) -> None:
    other = changed(dataset=sound.content["dataset"] | {"fingerprint": "2" * 64})
    own = sound.content["dataset"]["fingerprint"][:8]
    links = {name: target for target, name in re.findall(r'href="#(board-\d+)">([^<]+)<', make_page([sound, other]))}
    assert sorted(name.rpartition(" ")[2] for name in links) == sorted([own, "2" * 8])
    assert len(set(links.values())) == 2


def test_the_policy_allows_the_page_s_own_style_and_script_alone(entries: list[Entry]) -> None:
    page = make_page(entries)
    (policy,) = (a["content"] or "" for t, a in Reader(page).tags if a.get("http-equiv") == "Content-Security-Policy")

    for tag, name in (("style", "style-src"), ("script", "script-src")):
        (content,) = re.findall(rf"<{tag}>(.*?)</{tag}>", page, re.DOTALL)
        digest = base64.b64encode(hashlib.sha256(content.encode()).digest()).decode()
        assert f"{name} 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'")
    assert "unsafe" not in policy


def _everywhere(value: Any, names: bool = False) -> Any:
    """A content in which every text that may be anything is hostile."""
    if isinstance(value, str):
        return value if re.fullmatch(r"[0-9a-f]{64}|[A-Za-z0-9+/=]{60,}", value) else HOSTILE
    if isinstance(value, list):
        return [_everywhere(one) for one in value]
    if isinstance(value, dict):
        return {
            (HOSTILE if names and index == 0 else name): _everywhere(one)
            for index, (name, one) in enumerate(value.items())
        }
    return value


def _hostile(sound: Entry) -> Entry:
    fixed = ("format", "kind", "protocol", "figures", "by_episode")
    content = {name: value if name in fixed else _everywhere(value) for name, value in sound.content.items()}
    for name in ("versions", "remarks", "training", "reference"):
        content[name] = (
            dict(sound.content[name]) if name == "reference" else _everywhere(sound.content[name], names=True)
        )
    content["reference"] = {HOSTILE: content["reference"]["copy_last"]}
    return Entry(copy.deepcopy(content))


def test_text_of_an_entry_never_becomes_markup(sound: Entry) -> None:
    hostile = _hostile(sound)
    row = dict(published_entry(published_results()[0], 4).content)
    printed = Entry(row | {"model": HOSTILE, "environment": HOSTILE, "source": HOSTILE, "note": HOSTILE})

    page = make_page([hostile, printed])
    nesting, read = Nesting(page), Reader(page)

    assert (nesting.open, nesting.wrong) == ([], [])
    assert Counter(tag for tag, _ in read.tags)["script"] == 1
    assert not any(name.startswith("on") for _, attributes in read.tags for name in attributes)
    assert all((a.get("src") or "data:").startswith("data:") for _, a in read.tags)
    assert "hacked()" in " ".join(read.said)
    assert "<script>hacked" not in page


@pytest.mark.slow
def test_the_same_entries_make_the_same_page(entries: list[Entry]) -> None:
    assert make_page(entries) == make_page(list(entries))


@pytest.mark.slow
def test_pictures_give_way_before_the_page_grows_too_large(
    entries: list[Entry], monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = make_page(entries)
    monkeypatch.setattr("leaderboard.gallery.BUDGET", 4_000)

    fewer = make_page(entries)
    monkeypatch.setattr("leaderboard.page.LARGEST", 1_000)
    none = make_page(entries)

    counts = [page.count("<img") for page in (whole, fewer, none)]
    assert counts[0] > counts[1] > counts[2] == 0
    assert "What the models predict" not in none


def test_control_has_a_table_and_a_chart_of_its_own(sound: Entry) -> None:
    page = make_page([controlled(sound, "far", 0.8), controlled(sound, "near", 0.3), sound])
    predictions, control = re.findall(r"<table class=\"standings\">.*?</table>", page, re.DOTALL)[:2]

    def names(table: str) -> list[str]:
        return re.findall(r"<tr[^>]*><th[^>]*><(?:a|span)[^>]*>([^<]*)", table)

    assert sorted(names(predictions)) == ["copy the last frame", "dmotion", "far", "near", "only the agent moves"]
    assert names(control) == ["true simulator as the model", "near", "far", "idle"]
    headings = re.findall(r"<th[^>]*scope=\"col\"[^>]*>([^<]*)", control)
    assert headings == [
        "Model",
        "Labels",
        *(f"Distance, {step} steps" for step in (50, 40, 10)),
        "Tasks solved",
        "Objects lost",
    ]
    assert "7 tasks: bring the objects" in page
    chart = re.search(r"<svg[^>]*aria-label=\"Control:.*?</svg>", page, re.DOTALL)
    assert chart is not None
    assert re.findall(r"class=\"name\"[^>]*>([^<]*)", chart[0]) == ["true simulator as the model", "idle"]


def test_without_control_there_is_no_table_of_it(sound: Entry) -> None:
    page = make_page([sound])
    assert "<h3>Control</h3>" not in page
    assert page.count('<table class="standings">') == 1


@pytest.mark.slow
def test_several_demonstrations_are_a_point_over_labels_and_no_line_over_the_rollout(
    sound: Entry, changed: Callable[..., Entry]
) -> None:
    several = {"asked": "5-shot", "given": {"demonstrations": 20}, "total": 20}
    five = changed(labels=several, weights="1" * 64, run="five")

    def charts(entries: list[Entry]) -> tuple[str, str]:
        page = make_page(entries)
        found = [
            re.search(rf"<svg[^>]*aria-label=\"{kind}:.*?</svg>", page, re.DOTALL)
            for kind in ("Label efficiency, MSE", "Error over the rollout")
        ]
        assert found[0] is not None
        assert found[1] is not None
        return found[0][0], found[1][0]

    labels, rollout = charts([sound, five])
    assert "5-shot" in labels
    assert "one-shot" in rollout
    assert "5-shot" not in rollout
    assert "5-shot" in charts([five])[1]
