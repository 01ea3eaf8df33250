"""Scoring comes to the figures that it came to when its version was named (``golden/scoring.py``)."""

from __future__ import annotations

import pytest
from golden.scoring import ADVICE, RECIPES, WITHOUT_ACTIONS, figures, record, stored

from dmotion_bench.scoring.figures import SHARES, base_of
from dmotion_bench.scoring.report import SCORING_VERSION
from dmotion_bench.storage.dataset import Dataset

ROUNDING = 1e-6
"""Relative, and a tenth of it absolute; processors add the numbers of a picture up in different orders."""


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Dataset]:
    return record(tmp_path_factory.mktemp("golden"))


def test_the_golden_file_is_of_this_version() -> None:
    assert stored()["scoring_version"] == SCORING_VERSION, f"golden/scoring.json is of another version. {ADVICE}"


@pytest.mark.slow
@pytest.mark.parametrize("name", [*RECIPES, WITHOUT_ACTIONS])
def test_every_figure_is_that_of_the_version(recorded: dict[str, Dataset], name: str) -> None:
    wanted, found = stored()["figures"][name], figures(name, recorded[name])

    assert found.pop("fingerprint") == wanted.pop("fingerprint"), (
        "the recorded data are others, which scoring cannot be"
    )
    assert {who: list(own) for who, own in found.items()} == {who: list(own) for who, own in wanted.items()}
    for who, own in wanted.items():
        for figure, parts in own.items():
            said = dict(found[who][figure])
            if parts["std"] == 0 and parts["low"] == parts["high"] is not None and base_of(figure) in SHARES:
                assert said["low"] <= said["mean"] <= said["high"]  # has had a width since
                assert said["low"] < said["high"]
                said |= {"low": parts["low"], "high": parts["high"]}
            near = {
                part: one if one is None else pytest.approx(one, rel=ROUNDING, abs=ROUNDING / 10)
                for part, one in parts.items()
            }
            assert said == near, f"{figure} of {who} has changed. {ADVICE}"
