"""Workers that the executors start find the functions of the tests."""

from __future__ import annotations

import os
from pathlib import Path

import pytest


@pytest.fixture
def workers_find_the_tests_modules(monkeypatch: pytest.MonkeyPatch) -> None:
    found = [str(Path(__file__).parent.parent), os.environ.get("PYTHONPATH", "")]
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(found).rstrip(os.pathsep))
