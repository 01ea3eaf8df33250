"""Models and planners of a notebook, known by the names that they are registered under."""

from __future__ import annotations

from dataclasses import dataclass, make_dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import dmotion_bench as dm
from dmotion_bench.errors import ModelContractBroken, UnknownName, UsageError
from dmotion_bench.planning.objectives.base import Memoryless, StepCost
from dmotion_bench.planning.solvers.base import Plan
from dmotion_bench.planning.solvers.prefix_tree import PrefixTree
from dmotion_bench.registry import model_class


@pytest.mark.slow
def test_a_model_of_a_notebook_is_trained_and_scored_by_its_name(
    workspace: Path, caplog: pytest.LogCaptureFixture
) -> None:
    kind = model_class("ed-cnn")
    dm.register_model("mine", type("Mine", (kind,), {"__doc__": "E-D CNN under another name."}))
    run = dm.train("mine", labels="all", settings={"epochs": 0.1}, threads=1)
    same = dm.train("ed-cnn", labels="all", settings={"epochs": 0.1}, threads=1)
    assert "mine" in dm.model_names()
    figures = [dm.score(one, "prediction").figures["mse"] for one in (run, same)]
    assert figures[0] == figures[1]
    wrong = type("Wrong", (kind,), {"predict": lambda self, previous, current, action: current[:, :1]})
    dm.register_model("wrong", wrong)
    with pytest.raises(ModelContractBroken, match=r"Wrong: predict\(previous, current, action\) gave the shape"):
        dm.train("wrong", labels="all", settings={"epochs": 0.1}, threads=1)
    odd = type("Odd", (kind,), {"predict": lambda self, previous, current, action: current + torch.rand(())})
    dm.register_model("odd", odd)
    assert dm.train("odd", labels="all", settings={"epochs": 0.1}, threads=1).result["labels_total"] > 0
    assert "predict differs from one call to the next" in caplog.text
    with pytest.raises(UsageError, match="registered by a package already"):
        dm.register_model("dmotion", kind)
    for name in ("", "../mine", "a/b", "a b", "-a", "a" * 101):
        with pytest.raises(UsageError, match="cannot be a name here"):
            dm.register_model(name, kind)
    with pytest.raises(UsageError, match="no class of models"):
        dm.register_model("other", object)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"model is <class .*; give a name.* once dm\.register_model was called"):
        dm.train(kind)  # type: ignore[arg-type]
    with pytest.raises(UsageError, match="has no 'recording'"):
        dm.register_environment("other", kind)  # type: ignore[arg-type]


@dataclass(frozen=True, kw_only=True)
class Always:
    """A solver that takes one action, and an objective of which every state costs as much."""

    number: int = 1

    def plan(self, dynamics: Any, evaluator: Any, context: Any) -> Plan:
        tree = PrefixTree(dynamics, evaluator, context.observation, 1)
        best = np.full((len(context.generators), 1, 1), self.number)
        costs = tree.costs(best).min(axis=2)
        return tree.plan(best, costs, [costs[:, 0]])

    def reset(self, spec: Any, first: Any, goals: Any) -> Any:
        return _Indifferent()


class _Indifferent(Memoryless):
    def step(self, dynamics: Any, state: Any, task: Any, action: Any, cost_state: Any) -> Any:
        return StepCost.of(torch.zeros(len(task))), ()


@pytest.mark.slow
def test_a_planner_of_a_notebook_plans_and_scores_by_its_name(workspace: Path) -> None:
    dm.register_solver("always", Always)
    dm.register_objective("indifferent", Always)
    planned = dm.plan("oracle", steps=2, planner="always", objective="indifferent", planner_settings={"number": 3})
    assert planned.actions == ["right", "right"]
    report = dm.score("tiny", "control", tasks=1, planner="always", objective="indifferent")
    assert report.settings["control_planner"] == "always"
    with pytest.raises(UsageError, match=r"planner is Always\(number=1\); give a name.*dm\.register_solver was called"):
        dm.plan("oracle", planner=Always())  # type: ignore[arg-type]
    with pytest.raises(UsageError, match=r"objective is <class .*; give a name.*dm\.register_objective was called"):
        dm.score("tiny", "control", objective=Always)  # type: ignore[arg-type]
    for register, many, method in (
        (dm.register_solver, "solvers", "plan"),
        (dm.register_objective, "objectives", "reset"),
    ):
        thawed = make_dataclass("Thawed", [("number", int, 1)], namespace={method: getattr(Always, method)})
        for wrong in (object, _Indifferent, Always(), dm.JobProgress, thawed):
            with pytest.raises(UsageError, match=f"is no class of {many}; give a frozen dataclass .* '{method}'"):
                register("other", wrong)  # type: ignore[arg-type]
        with pytest.raises(UsageError, match="cannot be a name here"):
            register("a b", Always)
    with pytest.raises(UsageError, match="registered by a package already"):
        dm.register_solver("cem", Always)
    with pytest.raises(UsageError, match="registered by a package already"):
        dm.register_objective("pixel", Always)
    with pytest.raises(UnknownName, match="where register_solver was called"):
        dm.plan("oracle", planner="xyzzy")
