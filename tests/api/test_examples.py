"""The examples in the docstrings of the Python API, run as they stand."""

from __future__ import annotations

import doctest
import importlib
import pkgutil
from collections.abc import Iterator
from pathlib import Path

import pytest

import dmotion_bench as dm
from dmotion_bench import api, registry

LEAST = 12


def _examples() -> Iterator[doctest.DocTest]:
    modules = [
        registry,
        *(importlib.import_module(f"{api.__name__}.{one.name}") for one in pkgutil.iter_modules(api.__path__)),
    ]
    for module in modules:
        for found in doctest.DocTestFinder().find(module, extraglobs={"dm": dm}):
            if found.examples:
                yield found


EXAMPLES = list(_examples())


def test_there_are_examples() -> None:
    assert len(EXAMPLES) >= LEAST


@pytest.mark.slow
@pytest.mark.parametrize("example", EXAMPLES, ids=lambda example: example.name.removeprefix("dmotion_bench."))
def test_an_example_gives_what_it_says(example: doctest.DocTest, workspace: Path) -> None:
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    runner.run(example, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
