"""The pages of the models: each model has one, and its links to lines lead to where the symbol they name is defined.

A link such as ``[`DMotion.losses`](../../baselines/dmotion.py#L41)`` names a class, a function, a method or a constant
of the file, or, if the file defines nothing of that name, a text that stands in one line of it alone.
``python tests/test_model_pages.py`` writes the numbers of the lines anew after the code was changed.
"""

from __future__ import annotations

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FOLDER = ROOT / "docs" / "models"
PAGES = sorted(FOLDER.glob("*.md"))
WITH_LINES = [*PAGES, ROOT / "docs" / "baselines.md"]
SECTIONS = ["How to run it", "Implementation details", "Deviations from the paper", "Results"]
LINK = re.compile(r"\[`([^`\n]+)`\]\(([^)\s#]+\.py)#L(\d+)\)")
TO_A_LINE = re.compile(r"\]\([^)\s]+\.py#L\d+\)")


def line_of(symbol: str, source: str) -> int:
    """The number of the line in which a symbol is defined, or in which alone a text stands.

    Args:
        symbol: Such as ``Class.method`` or ``CONSTANT``, or a piece of text.
        source: Of the file.

    Raises:
        LookupError: There is no such line, or there are several.
    """
    found = _defined(symbol.split("."), ast.parse(source).body)
    found = found or [number for number, line in enumerate(source.splitlines(), start=1) if symbol in line]
    if len(found) != 1:
        raise LookupError(f"{symbol!r} is in {'no line' if not found else f'the lines {found}'}")
    return found[0]


def _defined(names: list[str], body: list[ast.stmt]) -> list[int]:
    """The lines in which a name is defined among some statements; of several names each within the one before."""
    found: list[int] = []
    for statement in body:
        if names[0] not in _names(statement):
            continue
        if len(names) == 1:
            found.append(statement.lineno)
        elif isinstance(statement, ast.ClassDef):
            found += _defined(names[1:], statement.body)
    return found


def _names(statement: ast.stmt) -> set[str]:
    if isinstance(statement, ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
        return {statement.name}
    targets = statement.targets if isinstance(statement, ast.Assign) else ()
    targets = [statement.target] if isinstance(statement, ast.AnnAssign) else targets
    return {target.id for target in targets if isinstance(target, ast.Name)}


def with_lines(page: Path) -> str:
    """The text of a page with the numbers of the lines as they are.

    Raises:
        LookupError: A symbol is not there any more.
    """

    def written(link: re.Match[str]) -> str:
        source = (page.parent / link[2]).read_text()
        try:
            return f"[`{link[1]}`]({link[2]}#L{line_of(link[1], source)})"
        except LookupError as error:
            raise LookupError(f"{page.name}: {error} of {link[2]}") from None

    return LINK.sub(written, page.read_text())


@pytest.mark.parametrize("page", WITH_LINES, ids=lambda page: page.stem)
def test_a_link_to_a_line_leads_to_what_it_names(page: Path) -> None:
    text = page.read_text()
    assert len(LINK.findall(text)) == len(TO_A_LINE.findall(text)), "a link to a line names its symbol in backticks"
    for symbol, path, number in LINK.findall(text):
        line = (page.parent / path).read_text().splitlines()[int(number) - 1]
        assert symbol.rpartition(".")[2] in line, f"{symbol}: run 'python tests/test_model_pages.py'"
    assert text == with_lines(page), "run 'python tests/test_model_pages.py'"


def test_every_model_has_a_page_and_the_overview_names_it() -> None:
    from dmotion_bench.registry import model_names

    assert sorted(page.stem for page in PAGES) == sorted(model_names())
    overview = (ROOT / "docs" / "baselines.md").read_text()
    assert [name for name in model_names() if f"](models/{name}.md)" not in overview] == []


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_says_what_to_type_what_differs_and_what_was_measured(page: Path) -> None:
    text = page.read_text()
    assert re.findall(r"^## (.+)$", text, re.MULTILINE) == SECTIONS
    assert f"<!-- results:model:{page.stem} -->" in text.partition("## Results")[2]
    assert f"\ndmbench train {page.stem} " in text
    assert len(LINK.findall(text.partition("## Implementation details")[2].partition("\n## ")[0])) >= 3
    beginning = text.partition("\n## ")[0]
    assert "https://arxiv.org/abs/" in beginning
    assert len(re.findall(r"\n\n(?=\S)", beginning)) == 2


SOURCE = '''"""Text."""
SIZE = 3
class A:
    size: int = 4

    def run(self):
        return "one of a kind"

class B:
    @property
    def run(self):
        return SIZE
'''


@pytest.mark.parametrize(
    ("symbol", "line"), [("SIZE", 2), ("A", 3), ("A.size", 4), ("A.run", 6), ("one of a kind", 7), ("B.run", 11)]
)
def test_a_symbol_is_found_where_it_is_defined(symbol: str, line: int) -> None:
    assert line_of(symbol, SOURCE) == line


@pytest.mark.parametrize(("symbol", "where"), [("C.run", "no line"), ("return", r"the lines \[7, 12\]")])
def test_a_symbol_that_is_nowhere_or_in_two_places_is_told(symbol: str, where: str) -> None:
    with pytest.raises(LookupError, match=where):
        line_of(symbol, SOURCE)


if __name__ == "__main__":
    for changed in WITH_LINES:
        changed.write_text(with_lines(changed))
