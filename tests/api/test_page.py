"""docs/python.md: its blocks, run from top to bottom as a reader types them, in an empty workspace."""

from __future__ import annotations

import doctest
import re
from pathlib import Path

import pytest

from dmotion_bench import registry

PAGE = Path(__file__).parents[2] / "docs" / "python.md"
BLOCKS = re.compile(r"^```(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def test_every_block_of_the_page_gives_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DMBENCH_WORKSPACE", raising=False)
    monkeypatch.setattr(registry, "_ADDED", {})
    blocks = BLOCKS.findall(PAGE.read_text())
    assert {kind for kind, _ in blocks} == {"pycon"}
    code = "\n".join(text for _, text in blocks)
    example = doctest.DocTestParser().get_doctest(code, {}, PAGE.name, str(PAGE), 0)
    assert len(example.examples) > len(blocks) > 10
    said: list[str] = []
    runner = doctest.DocTestRunner(optionflags=doctest.FAIL_FAST | doctest.ELLIPSIS)
    runner.run(example, out=said.append)
    assert runner.summarize(verbose=False).failed == 0, "".join(said)
