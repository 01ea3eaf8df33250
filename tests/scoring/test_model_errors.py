"""What a model raises while it is scored."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from known_model import Known

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings

QUICK = ScoreSettings(horizon=3, resamples=100)


class Falling(Known):
    """Predicts until it cannot."""

    def predict(self, previous: Any, current: Any, action: Any) -> Any:
        raise ValueError("nothing to see.")


@pytest.mark.slow
def test_what_somebody_elses_model_raises_names_its_line(
    make_run: Callable[..., Run], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run", model="falling")
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Falling)
    said = (
        r"Falling\.predict raised ValueError in line \d+ of test_model_errors\.py: nothing to see\. The contract is in"
    )
    with pytest.raises(ModelContractBroken, match=said):
        score_run(run.path, settings=QUICK)
    monkeypatch.setattr("dmotion_bench.scoring.score.score_rollouts", lambda *_, **__: [][0])
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Known)
    with pytest.raises(IndexError):  # not the model's
        score_run(run.path, settings=QUICK)
    monkeypatch.setattr("dmotion_bench.scoring.score.is_built_in", lambda *_: True)
    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Falling)
    with pytest.raises(ValueError, match="nothing to see"):  # ours
        score_run(run.path, settings=QUICK)
