"""What a command of the measurement inherits."""

from __future__ import annotations

from pathlib import Path

import pytest

from dmotion_bench.benchmarks import scaling


def test_each_measurement_has_a_cache_of_its_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path / "shared"))
    monkeypatch.setattr(scaling, "_MAIN", "import os; print(os.environ.get('DMBENCH_CACHE'))")
    assert scaling._typed(tmp_path, []) == "None\n"
