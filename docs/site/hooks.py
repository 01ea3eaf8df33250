"""What mkdocs is told beside ``mkdocs.yml``: pages of linked files, the top's Markdown, navigation by pattern.

::

    diagrams.py     pictures in the place of Mermaid
    docstrings.py   docstrings as mkdocstrings reads them
    hooks.py        this: the events of mkdocs
    links.py        where a link of a page leads on the site
    notebooks.py    a notebook as a page
    source_page.py  the page of a file that other pages link to
"""

from __future__ import annotations

import posixpath
import re
import subprocess
from pathlib import Path
from typing import Any, Final

from diagrams import BLOCK, picture_of, with_pictures
from links import DOCS, Links, with_targets
from mkdocs.config.defaults import MkDocsConfig
from mkdocs.exceptions import PluginError
from mkdocs.structure.files import File, Files, InclusionLevel
from mkdocs.structure.pages import Page
from notebooks import as_markdown
from source_page import folder_html, source_html

ROOT: Final = Path(__file__).parents[2]
ABOUT: Final = ("README.md", "CONTRIBUTING.md", "DECISIONS.md", "CHANGELOG.md", "SECURITY.md")
"""Markdown files at the top that are pages of the site."""

LINKS: Final = Links(ROOT)
SOURCES: Final = "source/"
LINE: Final = re.compile(r'<span class="line" id="(L\d+)">')


def slug(heading: str, separator: str = "-") -> str:
    """The anchor of a heading, as GitHub makes it."""
    return re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", separator)


def on_config(config: MkDocsConfig) -> MkDocsConfig:
    """Anchors as in the repository; navigation entries with a ``*`` become the pages that they match."""
    config.mdx_configs.setdefault("toc", {})["slugify"] = slug
    config.nav = _expanded(config.nav)
    return config


def _expanded(entries: list[Any]) -> list[Any]:
    found: list[Any] = []
    for entry in entries:
        if isinstance(entry, str) and "*" in entry:
            pages = sorted((ROOT / DOCS).glob(entry), key=lambda page: (page.parent, page.stem))
            found += [_address(page) for page in pages if page.name != "README.md"]
        elif isinstance(entry, dict):
            ((title, value),) = entry.items()
            value = _expanded(value) if isinstance(value, list) else value
            found += [{title: value}] if value else []  # nothing matches yet: no empty section
        else:
            found.append(entry)
    return found


def _address(page: Path) -> str:
    address = page.relative_to(ROOT / DOCS).as_posix()
    return f"{address}.md" if page.suffix == ".ipynb" else address


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add a page for each of the top's Markdown files, for each notebook, and for each file that a page links to."""
    pages = {name: (ROOT / name).read_text() for name in ABOUT}
    for name, text in pages.items():
        files.append(File.generated(config, LINKS.page_of(name), content=text))
    for notebook in sorted((ROOT / DOCS).rglob("*.ipynb")):
        files.append(File.generated(config, _address(notebook), content=as_markdown(notebook)))
    pages |= {f"{DOCS}{file.src_uri}": file.content_string for file in files.documentation_pages() if _ours(file)}
    for path in sorted(LINKS.leaving(pages)):
        front = "---\nsearch:\n  exclude: true\nhide: [toc]\n---\n"
        page = File.generated(
            config, LINKS.page_of(path), content=f"{front}# {path}\n", inclusion=InclusionLevel.NOT_IN_NAV
        )
        files.append(page)
    return files


def _ours(file: File) -> bool:
    return not file.src_uri.startswith((SOURCES, "project/"))


def _path_of(page: Page) -> str:
    """The path in the repository of what a page shows."""
    address = page.file.src_uri
    if address.startswith("project/"):
        return next(name for name in ABOUT if LINKS.page_of(name) == address)
    return f"{DOCS}{address}"


def on_page_markdown(markdown: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """Links as they lead on the site, and pictures in the place of diagrams."""
    if page.file.src_uri.startswith(SOURCES):
        return markdown
    for text in BLOCK.findall(markdown):
        if files.get_file_from_path(picture_of(text)) is None:
            raise PluginError(
                f"{page.file.src_uri}: a diagram was changed and has no picture; docs/site/diagrams.py draws it anew."
            )
    up = posixpath.relpath(".", posixpath.dirname(page.file.src_uri) or ".")
    path = _path_of(page)
    return with_pictures(with_targets(markdown, lambda target: LINKS.on_the_site(path, target)), f"{up}/")


def on_page_content(html: str, page: Page, config: MkDocsConfig, files: Files) -> str:
    """The lines of a file under its name."""
    address = page.file.src_uri
    if not address.startswith(SOURCES):
        return html
    path = address.removeprefix(SOURCES).removesuffix("/index.md")
    folder = ROOT / path
    if not folder.is_dir():
        shown = source_html(ROOT / path.removesuffix(".md"))
        page.present_anchor_ids = (page.present_anchor_ids or set()) | set(LINE.findall(shown))  # links may lead there
        return html + shown
    names = _tracked(folder)
    pages = {name: files.get_file_from_path(LINKS.page_of(f"{path}/{name}")) for name in names}
    known = {name: found.url_relative_to(page.file) for name, found in pages.items() if found is not None}
    return html + folder_html(folder, names, known)


def _tracked(folder: Path) -> list[str]:
    """The files of a folder that belong to the repository, or all where there is no git."""
    listed = subprocess.run(["git", "ls-files", "."], cwd=folder, capture_output=True, text=True, check=False)
    if listed.returncode == 0 and listed.stdout:
        return sorted(listed.stdout.splitlines())
    found = (path for path in folder.rglob("*") if path.is_file() and "__pycache__" not in path.parts)
    return sorted(path.relative_to(folder).as_posix() for path in found)
