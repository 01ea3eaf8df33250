"""``docs/protocol.md``: its example prints a figure of the report."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from pathlib import Path

import pytest

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings

DOC = (Path(__file__).parents[2] / "docs/protocol.md").read_text()


def test_the_example_recomputes_the_reports_mse(
    make_run: Callable[..., Run], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run = make_run(tmp_path / "run", offset=0.1)
    score_run(run.path, settings=ScoreSettings(horizon=3, resamples=100))
    (example,) = re.findall(r"```python\n(.*?)```", DOC, re.DOTALL)

    exec(example.replace("runs/dmotion-grid_world-small-s0", str(run.path)), {})

    report = json.loads((run.path / "report/report.json").read_text())
    assert float(capsys.readouterr().out) == pytest.approx(report["figures"]["mse"]["mean"], rel=1e-9)


def test_every_figure_of_a_report_is_explained(make_run: Callable[..., Run], tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", offset=0.1)
    score_run(run.path, settings=ScoreSettings(horizon=3, resamples=100))
    report = json.loads((run.path / "report/report.json").read_text())
    told = {name.partition("[")[0] for name in re.findall(r"`(\w+(?:\[\w\])?)`", DOC)}

    for figure in report["figures"]:
        assert figure.partition("[")[0].removesuffix("_push").removesuffix("_objects") in told, figure
