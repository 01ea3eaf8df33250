"""The paper's table as we hold it: values copied by hand from tables I and II, and the door it comes through."""

from __future__ import annotations

import tomllib
from importlib import import_module
from pathlib import Path

from leaderboard.paper import RESULTS

ROOT = Path(__file__).parents[2]


def test_values_from_the_paper() -> None:
    rows = {(row.model, row.labels, row.environment): row.figures for row in RESULTS}

    dmotion, robot = (rows["dmotion", "one-shot", name] for name in ("grid_world", "robot_push"))
    assert (dmotion["mse"].mean, dmotion["mse"].std) == (14.3, 99.8)
    assert (dmotion["position_error_paper"].mean, dmotion["position_error_paper"].std) == (0.480, 7.62)
    assert (robot["mse"].mean, robot["position_error_paper"].mean) == (86.78, 0.38)
    assert robot["control_distance[100]"].mean == 0.417
    assert rows["cswm", "100%", "robot_push"]["mse"].std == 99.32
    assert rows["wm-vae", "10%", "grid_world"]["mse"].mean == 960
    assert rows["ed-cnn", "10%", "robot_push"]["control_distance[100]"].mean == 1.022


def test_eleven_rows_an_environment_and_six_of_control() -> None:
    places = [(row.model, row.labels, row.environment) for row in RESULTS]

    assert len(places) == len(set(places)) == 22
    assert sum("control_distance[100]" in row.figures for row in RESULTS) == 6
    assert all({"mse", "position_error_paper"} <= set(row.figures) and row.source and row.note for row in RESULTS)


def test_the_entry_point_leads_here() -> None:
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    module, _, attribute = project["entry-points"]["dmbench.references"]["paper"].partition(":")

    assert getattr(import_module(module), attribute) == RESULTS
