"""Diagrams: pages hold them as Mermaid, which the repository's readers see drawn; the site shows a picture made of it.

A picture is named by the hash of its text, so a diagram that was changed has none and the site is not built. Pictures
are drawn anew by Mermaid (https://mermaid.js.org, MIT) in Chromium::

    npm pack mermaid@11 && tar xzf mermaid-11.*.tgz
    python docs/site/diagrams.py package/dist/mermaid.min.js
"""

from __future__ import annotations

import hashlib
import json
import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Final
from xml.etree import ElementTree

DOCS: Final = Path(__file__).parent.parent
FOLDER: Final = "assets/diagrams"
BLOCK: Final = re.compile(r"^```mermaid\n(.*?)^```$", re.MULTILINE | re.DOTALL)

_PAGE: Final = """<!doctype html><meta charset="utf-8"><body><div id="out"></div><script src="{script}"></script>
<script>
mermaid.initialize({{startOnLoad: false, theme: "neutral", fontFamily: "Helvetica, Arial, sans-serif",
  htmlLabels: false, flowchart: {{htmlLabels: false, useMaxWidth: false, rankSpacing: 32, nodeSpacing: 32}}}});
mermaid.render("diagram", {text}).then(drawn => {{ document.getElementById("out").innerHTML = drawn.svg; }});
</script></body>"""


def picture_of(text: str) -> str:
    """The address of a diagram's picture in the site."""
    return f"{FOLDER}/{hashlib.sha256(text.encode()).hexdigest()[:16]}.svg"


def with_pictures(markdown: str, up: str) -> str:
    """A page with a picture in the place of each diagram.

    Args:
        markdown: The page.
        up: From the page's folder to that of the site, such as ``../``.
    """

    def show(found: re.Match[str]) -> str:
        before = re.findall(r"^#+ (.+)$", markdown[: found.start()], re.MULTILINE)
        return f"![Diagram: {before[-1] if before else 'see the text'}]({up}{picture_of(found[1])}){{ .diagram }}"

    return BLOCK.sub(show, markdown)


def draw(text: str, script: Path, chromium: str = "chromium") -> str:
    """A diagram as SVG."""
    with tempfile.TemporaryDirectory() as folder:
        page = Path(folder) / "page.html"
        page.write_text(_PAGE.format(script=script.resolve().as_uri(), text=json.dumps(text)))
        options = ("--headless", "--no-sandbox", "--disable-gpu", "--virtual-time-budget=20000", "--dump-dom")
        shown = subprocess.run([chromium, *options, page.as_uri()], check=True, capture_output=True, text=True).stdout
    found = re.search(r"<svg.*</svg>", shown, re.DOTALL)
    if found is None:
        raise SystemExit(f"Mermaid drew nothing of:\n{text}")
    picture = found[0].replace("&nbsp;", " ")
    ElementTree.fromstring(picture)  # what a browser wrote as HTML must be XML, too
    return picture


def main(script: Path) -> None:
    """Draw every diagram that has no picture, and delete pictures of diagrams that are gone."""
    wanted = {picture_of(text): text for page in sorted(DOCS.rglob("*.md")) for text in BLOCK.findall(page.read_text())}
    (DOCS / FOLDER).mkdir(parents=True, exist_ok=True)
    for old in (DOCS / FOLDER).glob("*.svg"):
        if f"{FOLDER}/{old.name}" not in wanted:
            old.unlink()
    for address, text in wanted.items():
        if not (DOCS / address).exists():
            (DOCS / address).write_text(draw(text, script) + "\n")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
