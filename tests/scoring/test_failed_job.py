"""A scoring job that fails says why in the sentence that a command would give."""

from __future__ import annotations

import errno
from pathlib import Path

import pytest

from dmotion_bench.scoring import side_by_side
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.side_by_side import ScoreJob, score_job


def test_what_the_operating_system_refuses_is_a_sentence(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def denied(*_given: object, **_how: object) -> None:
        raise PermissionError(errno.EACCES, "Permission denied", "report.json")

    monkeypatch.setattr(side_by_side, "score_run", denied)
    job = ScoreJob(
        run=tmp_path, metrics=None, settings=ScoreSettings(), renew=True, data=None, batch_size=1, device="cpu"
    )
    assert score_job(job).error == "may not write or read 'report.json': Permission denied."
