"""The decisions in ``docs/decisions``: their form, and ``DECISIONS.md``, which lists them.

``python tests/test_decisions.py`` writes the list anew after a decision was added or superseded.
"""

from __future__ import annotations

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "decisions"
NUMBERED = sorted(FOLDER.glob("[0-9][0-9][0-9]-*.md"))
SECTIONS = ["Status", "Context", "Decision", "Rejected", "Evidence"]
MOST_WORDS = 200
STATUS = re.compile(r"(Accepted|Superseded by \[(\d{3})\]\(\d{3}-[\w-]+\.md\)), \d{4}-\d{2}-\d{2}\.(?: |$)")
INTRODUCTION = """# Decisions

Each choice that might surprise a reader has a page of at most 200 words in [docs/decisions](docs/decisions): what the
situation was, what was decided, what was rejected, and the measurement behind it. Longer measurements are in
[docs/experiments](docs/experiments/README.md). Terms are explained in the [glossary](docs/glossary.md).

To record a decision, add a page with the next number and write this list anew with `python tests/test_decisions.py`.
A decision that no longer holds keeps its page; its status names the decision that superseded it.

"""


def _section(page: Path, name: str) -> str:
    return page.read_text().partition(f"\n## {name}\n")[2].partition("\n## ")[0].strip()


def _status(page: Path) -> re.Match[str]:
    found = STATUS.match(_section(page, "Status").replace("\n", " "))
    assert found, f"{page.name}: the status is 'Accepted, DATE.' or 'Superseded by [NNN](NNN-title.md), DATE.'"
    return found


def _index() -> str:
    """What ``DECISIONS.md`` has to hold."""
    lines, links = [], []
    for page in NUMBERED:
        number, newer = page.name[:3], _status(page)[2]
        title = page.read_text().partition("\n")[0].removeprefix(f"# {number} ")
        lines.append(f"- [{number}] {title} ({f'superseded by {newer}' if newer else 'accepted'})")
        links.append(f"[{number}]: {page.relative_to(ROOT).as_posix()}")
    return INTRODUCTION + "\n".join([*lines, "", *links]) + "\n"


def test_the_list_of_decisions_is_that_of_their_pages() -> None:
    assert (ROOT / "DECISIONS.md").read_text() == _index(), "run 'python tests/test_decisions.py'"


def test_decisions_are_numbered_without_a_gap() -> None:
    assert [page.name[:3] for page in NUMBERED] == [f"{number:03}" for number in range(1, len(NUMBERED) + 1)]


@pytest.mark.parametrize("page", NUMBERED, ids=lambda page: page.stem)
def test_a_decision_has_its_sections_in_at_most_200_words(page: Path) -> None:
    text = page.read_text()

    assert text.startswith(f"# {page.name[:3]} ")
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == SECTIONS
    assert all(_section(page, name) for name in SECTIONS)
    assert len(text.split()) <= MOST_WORDS


@pytest.mark.parametrize("page", NUMBERED, ids=lambda page: page.stem)
def test_a_superseded_decision_and_its_successor_name_each_other(page: Path) -> None:
    newer = _status(page)[2]
    successors = [other for other in NUMBERED if other.name.startswith(f"{newer}-")] if newer else []
    older = re.findall(r"Supersedes \[(\d{3})\]", _section(page, "Status").replace("\n", " "))
    predecessors = [other for other in NUMBERED if other.name[:3] in older]

    assert bool(newer) == bool(successors)
    assert all(f"Supersedes [{page.name[:3]}]({page.name})" in _section(other, "Status") for other in successors)
    assert len(predecessors) == len(older)
    assert all(_status(other)[2] == page.name[:3] for other in predecessors)


if __name__ == "__main__":
    (ROOT / "DECISIONS.md").write_text(_index())
