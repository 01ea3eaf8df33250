"""Rerun views of a model that a user drives with the keyboard, beside the simulator."""

from __future__ import annotations

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from jaxtyping import UInt8

from dmotion_bench.specs import EnvSpec
from dmotion_bench.viewing.scene import picture_view

STEP = "step"


def drive_blueprint(spec: EnvSpec, simulator: bool) -> rrb.Blueprint:
    """The layout; ``simulator`` says whether the truth is known."""
    views = [picture_view("imagined", "imagined", spec.width, spec.height)]
    if simulator:
        views.append(picture_view("simulator", "simulator", spec.width, spec.height))
    return rrb.Blueprint(
        rrb.Horizontal(*views),
        rrb.BlueprintPanel(state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.TimePanel(state="collapsed", timeline=STEP),
        auto_layout=False,
        auto_views=False,
    )


def log_drive(
    recording: rr.RecordingStream,
    moment: int,
    imagined: UInt8[np.ndarray, "h w 3"],
    simulator: UInt8[np.ndarray, "h w 3"] | None,
) -> None:
    """Log the predicted frame after a key press, and the simulator's frame if it is known."""
    recording.set_time(STEP, sequence=moment)
    recording.log("imagined", rr.Image(imagined))
    if simulator is not None:
        recording.log("simulator", rr.Image(simulator))
