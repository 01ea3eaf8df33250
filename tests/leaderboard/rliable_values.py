"""Makes rliable_values.json: what rliable says of some scores, for test_summary.py to compare with.

rliable 1.2 does not run with pandas 3, so it is not among the packages of the tests. To make the values again::

    python3.11 -m venv rliable-environment
    rliable-environment/bin/pip install rliable 'pandas<3'
    rliable-environment/bin/python tests/leaderboard/rliable_values.py

It needs neither dmbench nor its other packages: the scores of the published entries are computed here from the files.
"""

from __future__ import annotations

import itertools
import json
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).parent
ENTRIES = HERE.parents[1] / "docs" / "leaderboard" / "entries"
VALUES = HERE / "rliable_values.json"
WORLDS = {"grid_world": "cd450aae", "planar_push": "a0147257", "robot_push": "0753d884"}
"""The data sets of the summary, by the beginnings of their fingerprints."""
NAMES = ("ed-cnn", "dmotion", "lam-vae", "dmotion-no-stn", "clasp", "lapo", "wm-ae", "wm-vae", "jepa", "cswm")
SUPERVISED = ("ed-cnn", "wm-ae", "wm-vae", "jepa", "cswm")
"""Of these, models whose usual budget is all labels; the others' is one demonstration of each action."""
SHAPES = ((1, 2), (2, 2), (3, 2), (5, 4), (10, 7))
"""Trainings and worlds of the random scores."""
DRAWS = 8
"""Bootstraps of each published model."""


def random_scores() -> list[list[np.ndarray[Any, Any]]]:
    """For each shape the scores of two models, the second a little better; some are equal."""
    random = np.random.default_rng(20211)
    pairs = []
    for shape in SHAPES:
        first, second = random.normal(0.5, 0.2, shape), random.normal(0.6, 0.2, shape)
        pairs.append([first.round(2), second.round(2)])
    return pairs


def published_scores() -> dict[str, np.ndarray[Any, Any]]:
    """Of the models with default settings and their usual budget: a training a row, a world a column."""
    found: dict[str, list[list[float]]] = {name: [[] for _ in WORLDS] for name in NAMES}
    measured = [
        one for path in sorted(ENTRIES.glob("*.json")) if (one := json.loads(path.read_text()))["kind"] == "measured"
    ]
    for entry in sorted(measured, key=lambda one: one["seed"]):
        if entry["model"] not in NAMES:
            continue
        world = entry["dataset"]["environment"]
        unusual = any(word in entry["run"] for word in ("true", "guide_0", "warm_up_0", "frames_", "moments_"))
        plain = not unusual and entry["labels"]["asked"] == ("100%" if entry["model"] in SUPERVISED else "one-shot")
        if plain and entry["dataset"]["fingerprint"].startswith(WORLDS.get(world, "-")):
            copy_last = entry["reference"]["copy_last"]
            if isinstance(copy_last, str):
                copy_last = json.loads((ENTRIES / "references" / f"{copy_last}.json").read_text())
            score = 1 - entry["figures"]["mse"]["mean"] / copy_last["mse"]["mean"]
            found[entry["model"]][list(WORLDS).index(world)].append(score)
    counts = {name: min(map(len, scores)) for name, scores in found.items()}
    return {name: np.array([one[: counts[name]] for one in scores]).T for name, scores in found.items()}


def _values() -> dict[str, Any]:
    from rliable import library, metrics

    def iqm(scores: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.array([metrics.aggregate_iqm(scores)])

    def improvement(first: np.ndarray[Any, Any], second: np.ndarray[Any, Any]) -> np.ndarray[Any, Any]:
        return np.array([metrics.probability_of_improvement(first, second)])

    def interval(scores: Any, figure: Any, seed: int = 0) -> list[float]:
        np.random.seed(seed)  # noqa: NPY002 (rliable draws from numpy's global state)
        _, found = library.get_interval_estimates({"it": scores}, figure, reps=3_000)
        return [float(bound[0]) for bound in found["it"]]

    drawn = [
        {
            "shape": list(first.shape),
            "iqm": [float(metrics.aggregate_iqm(one)) for one in (first, second)],
            "interval": [interval(one, iqm) for one in (first, second)],
            "improvement": float(metrics.probability_of_improvement(second, first)),
            "improvement_interval": interval([second, first], improvement),
        }
        for first, second in random_scores()
    ]
    scores = published_scores()
    published = {name: float(metrics.aggregate_iqm(one)) for name, one in scores.items()}
    ranked = sorted(published, key=lambda name: -published[name])
    over_next = {
        one: float(metrics.probability_of_improvement(scores[one], scores[after]))
        for one, after in itertools.pairwise(ranked)
    }
    several = {name: one for name, one in scores.items() if len(one) > 1}
    # of three trainings a bootstrap has few different values, and its bounds change with what is drawn
    drawn_often = {name: [interval(one, iqm, seed) for seed in range(DRAWS)] for name, one in several.items()}
    intervals = {
        name: [[min(bound), max(bound)] for bound in zip(*bounds, strict=True)] for name, bounds in drawn_often.items()
    }
    return {
        "made_with": {name: version(name) for name in ("rliable", "arch", "scipy", "numpy", "pandas")},
        "random": drawn,
        "published": {
            "scores": {name: one.tolist() for name, one in scores.items()},
            "iqm": published,
            "interval": intervals,
            "over_next": over_next,
        },
    }


if __name__ == "__main__":
    VALUES.write_text(json.dumps(_values(), indent=1) + "\n")
    sys.stdout.write(f"{VALUES} is written.\n")
