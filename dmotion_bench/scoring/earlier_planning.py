"""What earlier reports say of planning, in the words of today.

Until solvers and objectives had fields for all their settings, a report named a ``planner`` by its class, a ``cost``,
and the constants of the cost's modules, such as ``edges.MARGIN``; and its settings named a ``control_cost``. Such
reports and entries are read still: what they planned with is what the fields' defaults say. Everything that reads them
asks here.
"""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Final

from dmotion_bench.planning.choices import (
    EARLIER_NAMES,
    SIMULATOR,
    make_objective,
    make_solver,
    planning_configuration,
    present_name,
)
from dmotion_bench.planning.objectives.true_cost import TrueCost

FIELDS: Final[Mapping[str, str]] = MappingProxyType(
    {
        "stickiness": "action_repeat_prob",
        "kept": "kept_elites",
        "haste": "step_discount",
        "tracking.CLEAR": "fully_seen",
        "tracking.PLAY": "box_margin_px",
        "following.REACH": "search_reach",
        "following.STILL": "still_px",
        "following.DOUBT": "least_gain",
        "following.TOUCH": "touch_distance",
        "following.LOST": "lost_distance",
        "following.LOOSE": "turned_size",
        "covering.NEAR": "ground_from",
        "covering.FAR": "ground_to",
        "covering.ALIKE": "ground_tolerance",
        "covering.BARE": "bare_share",
        "covering.SECOND": "second_ground_share",
        "table.SIDES": "table_sides",
        "table.PATCH": "table_patch_px",
        "edges.MARGIN": "edge_margin",
        "edges.OPEN": "edge_open_share",
        "edges.GONE": "gone_share",
        "edges.OUT": "outward_motion",
        "edges.HALF": "fall_below",
        "edges.SURE": "unsure_below",
        "edges.MOST": "may_fall_below",
        "edges.LIKELY": "fall_likely",
        "edges.UNLIKELY": "fall_unlikely",
        "edges.BELOW": "passing_below",
        "edges.BESIDE": "passing_beside",
        "edges.THIN": "passing_pixels",
        "exploring.SIDE": "history_side_px",
        "exploring.SAME": "same_image",
        "exploring.VAGUE": "prediction_error",
        "exploring.NEW": "new_image",
        "exploring.PLACID": "settled_scale",
        "exploring.AROUND": "around_std",
        "exploring.ELSEWHERE": "elsewhere_weight",
        "exploring.NEAR": "placed_within",
        "exploring.AWAY": "misplaced_from",
        "exploring.NEARNESS": "push_pose_bonus",
        "exploring.NOVELTY": "novelty_bonus",
        "exploring.STRAYING": "leave_penalty",
        "exploring.WEARINESS": "revisit_penalty",
        "approaching.BERTH": "clearance",
        "approaching.WORTH": "push_axis_share",
        "approaching.TOES": "tip_rows",
    }
)
"""The fields by the names of the constants that they were."""

NOT_SETTINGS: Final = ("class", "planner.SHOWN")
"""What else a planner's description held."""


CEM_FIELDS: Final = (
    "samples",
    "horizon",
    "iterations",
    "elites",
    "action_repeat_prob",
    "kept_elites",
    "step_discount",
)
SOLVERS: Final[Mapping[str, tuple[str, tuple[str, ...]]]] = MappingProxyType(
    {
        "cem": ("CrossEntropyPlanner", CEM_FIELDS),
        "icem": ("CrossEntropyPlanner", CEM_FIELDS),
        "exhaustive": ("ExhaustivePlanner", ("horizon",)),
    }
)
"""The solvers that there were: their class, and its fields by their present names."""

CONSTANTS: Final[Mapping[str, tuple[str, ...]]] = MappingProxyType(
    {
        "tabletop": ("tracking.", "following.", "covering.", "table.", "edges.", "exploring.", "approaching."),
        "tracked": ("tracking.", "following.LOST"),
        "centres": ("following.LOST",),
        "pixel": (),
        "feature": (),
        SIMULATOR: (),
    }
)
"""The objectives that there were, and which constants a report named of each."""


LATER: Final[Mapping[str, Mapping[str, Any]]] = MappingProxyType(
    {name: MappingProxyType({"cost_at": "best", "hold": 1, "replan_every": 1}) for name in ("cem", "icem")}
)
"""Fields of solvers that reports of before lack, and what solvers did then."""


def present_planning(said: Mapping[str, Any]) -> dict[str, Any]:
    """A report's ``planning`` as it would be written today; what is written so already stays as it is."""
    planner, cost = dict(said.get("planner", {})), dict(said.get("cost", {}))
    solver, objective = _solver_name(planner), present_name(str(cost.pop("name", "")))
    if solver is None or objective not in CONSTANTS:
        named = said.get("solver")
        if not isinstance(named, Mapping):
            return dict(said)
        return dict(said) | {"solver": {**LATER.get(str(named.get("name")), {}), **named}}
    settings = TrueCost() if objective == SIMULATOR else make_objective(objective)
    defaults = planning_configuration(solver, make_solver(solver), objective, settings)
    others = {name: value for name, value in said.items() if name not in ("planner", "cost")}
    return others | {
        "solver": defaults["solver"] | _renamed(planner),
        "objective": defaults["objective"] | _renamed(cost),
    }


def present_settings(said: Mapping[str, Any]) -> dict[str, Any]:
    """A report's ``settings`` with the names of today: ``control_cost`` became ``control_objective``."""
    if "control_cost" not in said:
        return dict(said)
    others = {name: value for name, value in said.items() if name != "control_cost"}
    cost = said["control_cost"]
    return others | {
        "control_objective": present_name(cost) if isinstance(cost, str) else cost,
        "control_planner_set": [],
        "control_objective_set": [],
    }


def without_later(said: Mapping[str, Any]) -> dict[str, Any] | None:
    """A present ``planning_configuration`` as it was before some fields were there; None where it needs them."""
    solver = dict(said["solver"])
    later = LATER.get(str(solver["name"]), {})
    if not later or any(solver[name] != value for name, value in later.items()):
        return None
    return dict(said) | {"solver": {name: value for name, value in solver.items() if name not in later}}


def earlier_planning(said: Mapping[str, Any]) -> dict[str, Any] | None:
    """What a report said of a present ``planning_configuration``; None of what it could not say."""
    solver, objective = dict(said["solver"]), dict(said["objective"])
    constants = CONSTANTS.get(objective["name"])
    known = SOLVERS.get(str(solver["name"]))
    if constants is None or known is None:
        return None
    kind, fields = known
    before = {new: old for old, new in FIELDS.items()}
    named = {old: objective[FIELDS[old]] for old in FIELDS if old.startswith(constants)}
    named |= {name: value for name, value in objective.items() if name.startswith("positions.")}
    return {
        "planner": {"class": kind, **{before.get(name, name): solver[name] for name in fields}, "planner.SHOWN": 5},
        "cost": {"name": earlier_name(objective["name"]), **named},
    }


def earlier_name(objective: str) -> str:
    """The name that an objective had in earlier reports."""
    return {now: old for old, now in EARLIER_NAMES.items()}.get(objective, objective)


def _solver_name(planner: Mapping[str, Any]) -> str | None:
    """The name of a planner that a report described; None for one that there was not."""
    if planner.get("class") == "ExhaustivePlanner":
        return "exhaustive"
    if planner.get("class") != "CrossEntropyPlanner":
        return None
    return "icem" if planner.get("kept") or planner.get("stickiness") else "cem"


def _renamed(fields: Mapping[str, Any]) -> dict[str, Any]:
    return {FIELDS.get(name, name): value for name, value in fields.items() if name not in NOT_SETTINGS}
