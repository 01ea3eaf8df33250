"""docs/python.md: its blocks, run from top to bottom as a reader types them, in an empty workspace."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from walk import run_python, steps

PAGE = Path(__file__).parents[2] / "docs" / "python.md"


@pytest.mark.slow
def test_every_block_of_the_page_gives_what_it_shows(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.delenv("DMBENCH_WORKSPACE", raising=False)
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    blocks = list(steps(PAGE.read_text()))
    assert {one.kind for one in blocks} == {"python"}
    names: dict[str, Any] = {}
    examples = sum(run_python(one.text, names, PAGE.name) for one in blocks)
    assert examples > len(blocks) > 10
