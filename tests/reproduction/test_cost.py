"""What a table costs: amounts of work over speeds, which are measured once or read from a file."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from small_tables import CONTROL, FEW, TABLE, Known

from dmotion_bench.errors import UsageError
from dmotion_bench.reproduction.cost import cost_of
from dmotion_bench.reproduction.plan import Plan
from dmotion_bench.reproduction.settled import _has_figures
from dmotion_bench.reproduction.speeds import Speeds
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.workspace import Workspace


def test_hours_are_amounts_over_speeds(tmp_path: Path) -> None:
    lines = {(line.kind, line.what): line for line in cost_of(Plan(TABLE, "own", Workspace(tmp_path)), Known()).lines}
    triplets = 0.81 * 12 * (7 - 2)
    assert lines["record", "grid_world"].core_hours == pytest.approx(12 * 7 / 100 / 3600)
    assert lines["train", "lapo"].core_hours == pytest.approx(triplets / 50 / 3600)
    assert lines["train", "ed-cnn"].core_hours == pytest.approx(2 * triplets / 20 / 3600)
    tested = 0.1 * 12 * (7 - 2)
    scored = tested * (3 / (3 * 50) + 2 / (3 * 20))
    assert lines["score", "prediction"].core_hours == pytest.approx(scored / 3600)

    cost = cost_of(Plan(CONTROL, "own", Workspace(tmp_path)), Known())
    assert any("with the planner of the column 'generic-risk'" in said for said in cost.assumptions)
    lines = {(line.kind, line.what): line for line in cost.lines}
    steps = 2 * 4  # tasks, and steps of each
    assert lines["oracle", "first"].core_hours == pytest.approx(steps / 4 / 3600)
    planned = 3 * 2 / 1000  # of the actions that the timed planner tries
    assert lines["score", "first"].core_hours == pytest.approx((steps * planned / 0.5 + steps / 100) / 3600)
    assert lines["score", "first"].jobs == 2  # a group of tasks, and the run


def test_a_column_of_which_nothing_is_made_is_told(tmp_path: Path) -> None:
    """At preset tiny the data sets hold no control tasks, as ``dmbench reproduce paper --preset tiny`` finds."""
    idle = replace(CONTROL, worlds=tuple(replace(world, tasks=0) for world in CONTROL.worlds))
    told = cost_of(Plan(idle, "own", Workspace(tmp_path)), Known()).assumptions
    assert [said.split(":")[0] for said in told if "left out" in said] == ["The column 'first' is left out"]
    assert not any(
        "left out" in said for said in cost_of(Plan(CONTROL, "own", Workspace(tmp_path)), Known()).assumptions
    )


def test_what_cannot_be_measured_is_told_and_not_in_the_sum(tmp_path: Path) -> None:
    class Lame(Known):
        def triplets_per_s(self, model: str, arch: str | None) -> float:
            raise UsageError(f"{model} has no speed.")

    cost = cost_of(Plan(TABLE, "own", Workspace(tmp_path)), Lame())
    assert any("train lapo: lapo has no speed" in said for said in cost.unknown)
    assert cost.core_hours == pytest.approx((12 * 7 / 100 + 5 * 2.0) / 3600)  # recording, and five entries


@pytest.mark.parametrize("settings", [None, [1], {"metrics": 5}, {"metrics": [[]]}])
def test_an_entry_that_somebody_changed_does_not_stand(settings: object, tmp_path: Path) -> None:
    (scoring, *_) = Plan(TABLE, "own", Workspace(tmp_path)).scorings
    assert not _has_figures({"settings": settings}, scoring)


def test_speeds_are_measured_once_or_read_from_a_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    measured: list[str] = []
    monkeypatch.setattr(Speeds, "_training", lambda self, model, arch: measured.append(model) or 7.0)
    speeds = Speeds(device=torch.device("cpu"))
    assert [speeds.triplets_per_s("lapo", None) for _ in range(2)] == [7.0, 7.0]
    result = {"name": "train[lapo-compact]", "unit": "triplets/s", "rounds": [90, 100, 110], "limits": []}
    result |= {"limit_name": "", "setting": ""}
    recorded = result | {"name": "record[grid_world]", "unit": "frames/s"}
    (tmp_path / "bench.json").write_text(json.dumps({"processor": "P", "threads": 4, "results": [result, recorded]}))
    stored = Speeds(device=torch.device("cpu"), stored=tmp_path / "bench.json")
    assert stored.triplets_per_s("lapo", None) == 25.0  # of one core
    assert stored.triplets_per_s("clasp", None) == 7.0
    assert measured == ["lapo", "clasp"]
    assert "P, 4 threads" in stored.told
    recording = Plan(TABLE, "own", Workspace(tmp_path)).recordings[0]
    assert stored.episodes(recording).frames_per_s == 100.0  # which was measured on one process
    (tmp_path / "bench.json").write_text(json.dumps({"processor": "P", "threads": 0, "results": [result]}))
    with pytest.raises(UsageError, match="it says that 0 threads computed"):
        Speeds(device=torch.device("cpu"), stored=tmp_path / "bench.json")
    with pytest.raises(UsageError, match="make such a file with 'dmbench bench --json > FILE'"):
        Speeds(device=torch.device("cpu"), stored=tmp_path / "none.json")


def test_timing_the_oracle_leaves_nothing_in_the_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DMBENCH_CACHE", str(tmp_path / "cache"))
    (recording,) = Plan(CONTROL, "own", Workspace(tmp_path)).recordings
    scoring = ControlScoring(objective="centres", planner_set=FEW)
    assert Speeds(device=torch.device("cpu")).oracle_steps_per_s(recording, scoring) > 0
    assert not list(tmp_path.rglob("*.json"))
