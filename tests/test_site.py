"""The documentation site: it is built without network and without a warning, and no link of it is dead."""

from __future__ import annotations

import importlib.util
import json
import os
import posixpath
import re
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass, field
from html.parser import HTMLParser
from pathlib import Path
from types import ModuleType
from typing import Any
from urllib.parse import unquote, urlsplit
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).parent.parent
DOCS = ROOT / "docs"
WITHOUT_NETWORK = """
import socket

def refuse(*asked, **more):
    raise OSError(f"the site was to be built without network: {asked}")

socket.socket.connect = socket.create_connection = socket.getaddrinfo = refuse
"""
LOADED = {
    ("script", "src"),
    ("img", "src"),
    ("iframe", "src"),
    ("source", "src"),
    ("source", "srcset"),
    ("use", "href"),
}
"""Elements and attributes that make a browser fetch something; of ``link``, what is no mere reference."""
REFERENCES = {"next", "prev", "canonical", "alternate", "edit"}


def _module(name: str) -> ModuleType:
    """One of the site's own modules, which belong to no package."""
    spec = importlib.util.spec_from_file_location(f"site_{name}", DOCS / "site" / f"{name}.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@dataclass
class _Page(HTMLParser):
    """What a page links to, what it loads, and its anchors."""

    links: list[str] = field(default_factory=list)
    loads: list[str] = field(default_factory=list)
    anchors: set[str] = field(default_factory=set)
    lines: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        super().__init__(convert_charrefs=True)

    def handle_starttag(self, tag: str, given: list[tuple[str, str | None]]) -> None:
        attributes = {name: value or "" for name, value in given}
        self.anchors |= {attributes[name] for name in ("id", "name") if name in attributes}
        if tag == "a" and "href" in attributes:
            self.links.append(attributes["href"])
        if tag == "link" and not REFERENCES & set(attributes.get("rel", "").split()):
            self.loads.append(attributes.get("href", ""))
        self.loads += [value for name, value in attributes.items() if (tag, name) in LOADED]
        if attributes.get("class") == "line":
            self.lines.append("")

    def handle_data(self, data: str) -> None:
        if self.lines:
            self.lines[-1] += data


def _parsed(file: Path) -> _Page:
    page = _Page()
    page.feed(file.read_text())
    return page


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The site, built by mkdocs in a process that can reach nobody."""
    folder = tmp_path_factory.mktemp("site")
    (folder / "lonely").mkdir()
    (folder / "lonely" / "sitecustomize.py").write_text(WITHOUT_NETWORK)
    environment = os.environ | {"PYTHONPATH": str(folder / "lonely"), "NO_MKDOCS_2_WARNING": "1"}
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(folder / "site")]
    done = subprocess.run(command, cwd=ROOT, env=environment, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    assert "WARNING" not in done.stderr
    return folder / "site"


@pytest.fixture(scope="module")
def pages(site: Path) -> dict[str, _Page]:
    """Every page by its address."""
    return {file.relative_to(site).as_posix(): _parsed(file) for file in sorted(site.rglob("*.html"))}


@pytest.mark.slow
def test_no_link_of_the_site_is_dead(site: Path, pages: dict[str, _Page]) -> None:
    assert len(pages) > 150
    dead = []
    for address, page in pages.items():
        for link in page.links:
            parts = urlsplit(link)
            if parts.scheme in ("http", "https", "mailto"):
                continue
            path = unquote(parts.path)
            joined = path.lstrip("/") if path.startswith("/") else posixpath.join(posixpath.dirname(address), path)
            target = posixpath.normpath(joined) if path else address
            target = posixpath.join(target, "index.html") if (site / target).is_dir() else target
            known = pages.get(target)
            if not (site / target).is_file():
                dead.append(f"{address}: {link}")
            elif parts.fragment and known is not None and unquote(parts.fragment) not in known.anchors:
                dead.append(f"{address}: {link} (no such anchor)")
    assert not dead, "\n".join(sorted(set(dead)))


@pytest.mark.slow
def test_the_site_loads_nothing_from_elsewhere(site: Path, pages: dict[str, _Page]) -> None:
    loaded = {f"{address}: {url}" for address, page in pages.items() for url in page.loads if re.match(r"\w+:|//", url)}
    assert not {one for one in loaded if ": data:" not in one}
    assert any("search" in url or "bundle" in url for url in pages["index.html"].loads)
    for sheet in site.rglob("*.css"):
        assert not re.search(r"(@import|url\()\s*[\"']?(https?:)?//", sheet.read_text()), sheet
    for picture in site.rglob("*.svg"):
        assert not re.search(r"(href|src)=\"https?:", picture.read_text()), picture


@pytest.mark.slow
def test_a_linked_file_is_a_page_with_its_lines(pages: dict[str, _Page]) -> None:
    page = pages["source/dmotion_bench/environment.py.html"]
    lines = (ROOT / "dmotion_bench" / "environment.py").read_text().splitlines()
    assert [line.rstrip("\n") for line in page.lines[: len(lines) - 1]] == lines[:-1]
    assert {f"L{number}" for number in range(1, len(lines) + 1)} <= page.anchors
    assert f"L{len(lines) + 1}" not in page.anchors
    assert "about.html" in pages["project/contributing.html"].links
    assert "source/dmotion_bench/environment.py.html" in pages["architecture.html"].links


@pytest.mark.slow
def test_the_search_knows_the_pages_and_not_the_sources(site: Path) -> None:
    index = json.loads((site / "search" / "search_index.js").read_text().removeprefix("var __index = "))
    places = {entry["location"].partition("#")[0] for entry in index["docs"]}
    assert {"index.html", "tutorials/first_model.html", "api/functions.html", "project/decisions.html"} <= places
    assert not {place for place in places if place.startswith("source/")}


@pytest.mark.slow
def test_signatures_show_axes_as_they_are_written(site: Path) -> None:
    text = re.sub(r"<[^>]+>", "", (site / "api" / "model.html").read_text())
    assert "previous: Float[Tensor, &quot;b c h w&quot;]" in text.replace('"', "&quot;")
    assert "episode: Int[Tensor, &quot;b&quot;] | None" in text.replace('"', "&quot;")


def test_every_page_is_in_the_navigation_once() -> None:
    config = yaml.load((ROOT / "mkdocs.yml").read_text(), Loader=yaml.BaseLoader)
    there = {page.relative_to(DOCS).as_posix() for page in DOCS.rglob("*.md")}
    named = list(_entries(config["nav"]))
    single = [entry for entry in named if "*" not in entry]
    assert len(set(single)) == len(single)
    assert set(single) - there == {entry for entry in single if entry.startswith("project/")}
    patterns = [entry for entry in named if "*" in entry]
    found = {page.relative_to(DOCS).as_posix() for pattern in patterns for page in DOCS.glob(pattern)}
    assert there <= found | set(single)


def _entries(nav: Any) -> Iterator[str]:
    if isinstance(nav, str):
        yield nav
    for entry in nav.values() if isinstance(nav, dict) else nav if isinstance(nav, list) else ():
        yield from _entries(entry)


def test_links_lead_to_pages_of_the_site() -> None:
    links = _module("links")
    places = links.Links(ROOT)
    lead = {
        ("docs/format.md", "protocol.md#control"): "protocol.md#control",
        ("docs/format.md", "../README.md"): "project/about.md",
        ("docs/format.md", "../dmotion_bench/errors.py#L41"): "source/dmotion_bench/errors.py.md#L41",
        ("docs/decisions/a.md", "../../tests/fuzz"): "../source/tests/fuzz/index.md",
        ("docs/api/index.md", "../decisions"): "../project/decisions.md",
        ("README.md", "docs/experiments"): "../experiments/README.md",
        ("CONTRIBUTING.md", "docs/site/diagrams.py"): "../source/docs/site/diagrams.py.md",
        ("README.md", "LICENSE"): "../source/LICENSE.md",
        ("docs/baselines.md", "notebooks/look_at_data_and_model.ipynb"): "notebooks/look_at_data_and_model.ipynb.md",
        ("README.md", "https://arxiv.org/abs/2103.04301"): "https://arxiv.org/abs/2103.04301",
        ("README.md", "#results"): "#results",
        ("README.md", "../outside.md"): "../outside.md",
    }
    assert {given: places.on_the_site(*given) for given in lead} == lead


def test_links_in_code_stay_as_they_are() -> None:
    text = "[a](b.py) `[c](d.py)`\n\n```\n[e](f.py)\n```\n\n[`g`](h.py)\n\n[1]: i.py\n"
    changed = _module("links").with_targets(text, str.upper)
    assert changed == "[a](B.PY) `[c](d.py)`\n\n```\n[e](f.py)\n```\n\n[`g`](H.PY)\n\n[1]: I.PY\n"


def test_every_diagram_has_a_picture_of_itself() -> None:
    diagrams = _module("diagrams")
    texts = [text for page in DOCS.rglob("*.md") for text in diagrams.BLOCK.findall(page.read_text())]
    assert texts
    for text in texts:
        picture = ElementTree.fromstring((DOCS / diagrams.picture_of(text)).read_text())
        drawn = re.sub(r"\s+", "", "".join(picture.itertext()))
        labels = re.findall(r"\"([^\"]+)\"", text)
        assert labels
        assert all(re.sub(r"\s+", "", part) in drawn for label in labels for part in label.split("<br/>"))


def test_docstrings_are_read_without_our_habits() -> None:
    given = (
        "Title::\n\n    code\n\nArgs:\n    a, b: Two\n        numbers.\n    c: One.\n\nRaises:\n    X, Y: Wrong.\n\n"
        "Example:\n    >>> 1\n    1\n"
    )
    assert _module("docstrings").readable(given) == (
        "Title:\n\n    code\n\nArgs:\n    a: Two\n        numbers.\n    b: Two\n        numbers.\n    c: One.\n\n"
        "Raises:\n    X: Wrong.\n    Y: Wrong.\n\nExamples:\n    >>> 1\n    1\n"
    )


def test_a_notebook_is_a_page(tmp_path: Path) -> None:
    cells = [
        {"cell_type": "markdown", "source": ["# Title\n", "text"]},
        {
            "cell_type": "code",
            "source": "1 + 1",
            "outputs": [
                {"data": {"text/plain": ["2"]}},
                {"data": {"image/png": "aGk=\n"}},
                {"data": {"text/markdown": ["| a |\n", "| --- |"], "text/plain": "<Markdown>"}},
                {"text": "said\n"},
            ],
        },
    ]
    (tmp_path / "one.ipynb").write_text(json.dumps({"cells": cells}))
    page = _module("notebooks").as_markdown(tmp_path / "one.ipynb")
    assert page.split("\n\n") == [
        "# Title\ntext",
        "````python\n1 + 1\n````",
        "````text\n2\n````",
        "![What the code above shows](data:image/png;base64,aGk=)",
        "| a |\n| --- |",
        "````text\nsaid\n````\n",
    ]
