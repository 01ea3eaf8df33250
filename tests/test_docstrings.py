"""Docstrings that list something: the list holds what there is."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from dmotion_bench import errors

ROOT = Path(__file__).parent.parent
SOURCES = sorted(
    path for name in ("dmotion_bench", "recorders", "baselines", "leaderboard") for path in (ROOT / name).rglob("*.py")
)
MODULE = re.compile(r"^    (\w+\.py)  ", re.MULTILINE)
LISTING = [path for path in SOURCES if path.name == "__init__.py" and MODULE.search(path.read_text())]


@pytest.mark.parametrize("package", LISTING, ids=lambda path: path.parent.name)
def test_a_package_lists_each_of_its_modules_once(package: Path) -> None:
    listed = MODULE.findall(package.read_text())
    there = [path.name for path in package.parent.glob("*.py") if path.name != "__init__.py"]
    assert sorted(listed) == sorted(there)


def test_packages_with_lists_are_found() -> None:
    assert {"planning", "scoring", "viewing"} <= {path.parent.name for path in LISTING}


def test_the_drawn_tree_of_errors_is_that_of_the_classes() -> None:
    drawn = re.findall(r"^    ([│├└─ ]*)(\w+)", errors.__doc__ or "", re.M)
    parents: dict[str, str | None] = {}
    branch: list[str] = []
    for lines, name in drawn:
        depth = len(lines) // 4
        parents[name] = branch[depth - 1] if depth else None
        branch[depth:] = [name]
    classes = {one.__name__: one for one in vars(errors).values() if isinstance(one, type)}
    own = {name: one for name, one in classes.items() if issubclass(one, errors.DmbenchError)}
    assert parents == {
        name: None if one is errors.DmbenchError else one.__bases__[0].__name__ for name, one in own.items()
    }


def test_errors_are_defined_in_one_module() -> None:
    kinds = "|".join(
        name for name, one in vars(errors).items() if isinstance(one, type) and issubclass(one, errors.DmbenchError)
    )
    elsewhere = re.compile(rf"^class \w+\((?:.*\W)?(?:{kinds})\b.*\):", re.MULTILINE)
    assert elsewhere.search(Path(errors.__file__).read_text())
    for path in SOURCES:
        assert path == Path(errors.__file__) or not elsewhere.search(path.read_text()), path
