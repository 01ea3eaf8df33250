"""The catalogue of deliberate faults fits the code; ``make faults`` shows that the tests notice each of them."""

from __future__ import annotations

import importlib.util
import sys
from pathlib import Path
from typing import Any

import pytest

ROOT = Path(__file__).resolve().parents[1]


def _faults() -> tuple[Any, ...]:
    spec = importlib.util.spec_from_file_location("fault_catalogue", ROOT / "tests" / "faults" / "catalogue.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return tuple(module.FAULTS)


FAULTS = _faults()


def test_there_are_at_least_twenty() -> None:
    assert len({fault.name for fault in FAULTS}) == len(FAULTS)
    assert len(FAULTS) >= 20


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.name)
def test_each_fault_can_be_made_in_exactly_one_place(fault: Any) -> None:
    assert (ROOT / fault.file).read_text().count(fault.right) == 1
    assert fault.wrong != fault.right
    assert all((ROOT / test).exists() for test in fault.tests)
