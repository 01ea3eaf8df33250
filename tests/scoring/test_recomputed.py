"""A report's intervals, computed once more from its samples by other means: a loop over draws, quantiles by hand."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy import stats

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.statistics import FEWEST_EPISODES

DRAWS = 100


def _interval(values: list[float], episodes: list[int]) -> tuple[float, float]:
    """Expanded percentiles over episodes drawn anew (Hesterberg 2015, section 4.4)."""
    names = sorted(set(episodes))
    count = len(names)
    generator = np.random.default_rng([0, count])
    means = []
    for drawn in generator.multinomial(count, [1 / count] * count, size=DRAWS):
        pooled = [
            value
            for name, times in zip(names, drawn.tolist(), strict=True)
            for _ in range(times)
            for value, episode in zip(values, episodes, strict=True)
            if episode == name
        ]
        means.append(sum(pooled) / len(pooled))
    tail = stats.norm.cdf(-math.sqrt(count / (count - 1)) * stats.t.ppf(0.975, count - 1))
    means.sort()
    ends = []
    for share in (tail, 1 - tail):
        place = share * (len(means) - 1)
        below = math.floor(place)
        above = min(below + 1, len(means) - 1)
        ends.append(means[below] + (place - below) * (means[above] - means[below]))
    return ends[0], ends[1]


def test_intervals_follow_from_the_samples(make_run: Callable[..., Run], tmp_path: Path) -> None:
    run = make_run(tmp_path / "run", offset=0.1)
    score_run(run.path, settings=ScoreSettings(horizon=3, resamples=DRAWS))
    report = json.loads((run.path / "report/report.json").read_text())
    rows = pq.read_table(run.path / "report/samples.parquet").to_pylist()

    for predictor, figures in {"model": report["figures"], "copy_last": report["reference"]["copy_last"]}.items():
        for figure, said in figures.items():
            base, _, ahead = figure.removeprefix("rollout_").rstrip("]").partition("[")
            name = base.removesuffix("_push")
            mine = [
                row
                for row in rows
                if row["predictor"] == predictor
                and row["metric"] == ("rollout" if ahead else "prediction")
                and (not ahead or row["ahead"] == int(ahead))
                and (name == base or row["pushed"])
                and row[name] is not None
            ]
            if said["low"] is None:
                assert len({row["episode"] for row in mine}) < FEWEST_EPISODES, figure
                continue
            found = _interval([row[name] for row in mine], [row["episode"] for row in mine])
            assert (said["low"], said["high"]) == pytest.approx(found, rel=1e-6, abs=1e-9), figure
