"""Control in Rerun: the camera image, the goal, the predictions of the best candidates, and the distance.

Everything is on the timeline ``step``, the number of actions taken before.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import UInt8

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.planning.solvers.base import Plan
from dmotion_bench.specs import EnvSpec
from dmotion_bench.viewing.scene import picture_view

STEP = "step"
GAP = 2  # [px] between the pictures of a strip
SHOWN = 3  # of the best candidates are drawn
STEPS_PER_SECOND = 5.0
"""How fast a task is played; slowly enough to see what was imagined."""


def control_blueprint(spec: EnvSpec, horizon: int, pictures: bool) -> rrb.Blueprint:
    """The layout.

    Args:
        spec: Of the environment.
        horizon: Pictures in a future.
        pictures: Whether futures are drawn.
    """
    images = [picture_view(one, one, spec.width, spec.height) for one in ("camera", "goal")]
    width = horizon * (spec.width + GAP)
    strip = picture_view("imagined", "imagined: the best candidates, step by step", width, SHOWN * (spec.height + GAP))
    curves = rrb.Horizontal(
        rrb.TimeSeriesView(origin="distance", name="distance, 1 at the start"),
        rrb.BarChartView(origin="cost", name="lowest cost after each iteration"),
        rrb.TextDocumentView(origin="candidates", name="candidates"),
    )
    beside = rrb.Horizontal(rrb.Vertical(*images), strip, column_shares=[1, 2.4])
    return rrb.Blueprint(
        rrb.Vertical(beside if pictures else rrb.Horizontal(*images), curves, row_shares=[3, 1]),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=STEP, fps=STEPS_PER_SECOND),
        auto_layout=False,
        auto_views=False,
    )


def log_step(
    recording: rr.RecordingStream,
    spec: EnvSpec,
    step: int,
    camera: UInt8[np.ndarray, "h w 3"],
    distance: float,
    plan: Plan | None = None,
    futures: UInt8[np.ndarray, "m t h w 3"] | None = None,
) -> None:
    """One control step of one task.

    Args:
        recording: Where to.
        spec: Names the actions.
        step: Actions taken before.
        camera: What is seen.
        distance: Normalised.
        plan: What the solver came to for this task alone.
        futures: What the model makes of its best candidates.
    """
    recording.set_time(STEP, sequence=step)
    recording.log("camera", rr.Image(camera))
    recording.log("distance", rr.Scalars([distance]))
    if plan is not None and plan.frames:  # else an earlier plan, which is still shown, is carried on
        recording.log("cost", rr.BarChart(plan.progress[0]))
        recording.log(
            "candidates",
            rr.TextDocument(
                candidate_table(spec.actions, plan),
                media_type="text/markdown",
            ),
        )
    if futures is not None:
        recording.log("imagined", rr.Image(strip_of(futures)))


def log_goal(recording: rr.RecordingStream, goal: UInt8[np.ndarray, "h w 3"]) -> None:
    """Log the goal image, which does not change."""
    recording.log("goal", rr.Image(goal), static=True)


def strip_of(futures: UInt8[np.ndarray, "m t h w 3"]) -> UInt8[np.ndarray, "y x 3"]:
    """One image of all candidates: a row per candidate, a column per step, with white lines between them."""
    padded = np.pad(futures, ((0, 0), (0, 0), (0, GAP), (0, GAP), (0, 0)), constant_values=255)
    rows, steps, height, width, _ = padded.shape
    strip: UInt8[np.ndarray, "y x 3"] = padded.transpose(0, 2, 1, 3, 4).reshape(rows * height, steps * width, 3)
    return strip


def named(actions: ActionSpec | None, sequence: Sequence[Any]) -> str:
    """A sequence of actions in words: names, or the numbers of continuous ones in their units."""
    if isinstance(actions, Discrete):
        return " ".join(actions.names[action] for action in sequence)
    rows = actions.denormalise(np.array(sequence)).tolist() if isinstance(actions, Continuous) else sequence
    return " ".join(f"({', '.join(f'{number:.3g}' for number in row)})" for row in rows)


def candidate_table(actions: ActionSpec | None, plan: Plan) -> str:
    """The best candidates of a plan's first task, as Markdown; with the parts of their costs, if there are several."""
    parts = {name: values[0] for name, values in plan.parts.items()}
    shown = list(parts) if any(np.any(values) for name, values in parts.items() if name != "distance") else []
    lines = [f"| cost |{''.join(f' {name} |' for name in shown)} actions |", f"|---:|{'---:|' * len(shown)}---|"]
    for place, (cost, sequence) in enumerate(zip(plan.costs[0], plan.candidates[0].tolist(), strict=True)):
        if np.isfinite(cost):
            values = "".join(f" {parts[name][place]:.4g} |" for name in shown)
            lines.append(f"| {cost:.4g} |{values} {named(actions, sequence)} |")
    return "\n".join(lines)
