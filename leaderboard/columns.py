"""The figures that the page shows, their headings, and the format of numbers."""

from __future__ import annotations

import re
from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass
from typing import Final

from dmotion_bench.wording import from_to, rounded
from leaderboard.comparison import GAIN_CAPTURED


@dataclass(frozen=True, kw_only=True)
class Column:
    """A figure as a column of a table.

    Attributes:
        figure: Its fixed name.
        heading: What it is called.
        unit: Of the number, or nothing.
        meaning: A sentence for those who ask.
        higher: Whether more is better.
    """

    figure: str
    heading: str
    unit: str = ""
    meaning: str
    higher: bool = False


POSITION_CHARGED: Final = "Position error, missing charged"
POSITION_FOUND: Final = "Position error, found objects"
"""What the two figures of the objects' places are called in every table and chart."""

DISTANCE_LEFT: Final = "distance to the goal / at the start"
"""What the axes of charts of control say."""

TRUE_MOTION: Final = Column(
    figure="mse_true_motion",
    heading="MSE with the true motion",
    meaning="Of frames drawn with the latent action of the true next frame: all that is known without actions.",
)
"""Shown where no MSE is known."""

_SINGLE: Final = (
    Column(
        figure="mse", heading="MSE", meaning="Mean squared error of the next frame, over pixel values from 0 to 255."
    ),
    Column(figure="mse_push", heading="MSE, pushes", meaning="The same over the steps at which an object is moved."),
    Column(figure="psnr", heading="PSNR", unit="dB", meaning="Mean of the frames' PSNRs.", higher=True),
    Column(figure="ssim", heading="SSIM", meaning="Structural similarity, 1 for identical frames.", higher=True),
    Column(
        figure="position_error_paper",
        heading=POSITION_CHARGED,
        unit="px",
        meaning="Distance of the centres of objects and coloured agents; a missing one is charged its own to (-1, -1).",
    ),
    Column(
        figure="position_error",
        heading=POSITION_FOUND,
        unit="px",
        meaning="Distance of the centres of objects and coloured agents, over those found in both frames.",
    ),
    Column(
        figure="miss_rate",
        heading="Missed",
        meaning="Share of the objects and coloured agents that the prediction does not show.",
    ),
)
UNWANTED: Final = {
    "agent_place": "agent's place",
    "camera": "camera",
    "background": "background",
    "movers": "movers",
}
"""What a latent action should not hold (``scoring/true_factors.py``), in words; a sentence puts "the" before them."""


def _gain_captured(sequences: int | None = None) -> Column:
    """The gain captured, where so many sequences are compared at each moment."""
    compared = "many" if sequences is None else f"{sequences:,}"
    return Column(
        figure=GAIN_CAPTURED,
        heading="Gain captured",
        meaning=f"Of what the best of {compared} action sequences truly brings, "
        "the share that the model's favourite brings.",
        higher=True,
    )


_AFTER: Final = (
    Column(
        figure="agent_iou",
        heading="Agent IoU",
        meaning="Overlap of the model's own map of the agent with the agent; only of models that have one.",
        higher=True,
    ),
    Column(
        figure="motion_within_over_between",
        heading="Motion within / between",
        meaning="Variance of the agent's motion within an action over that between actions; 0 is best.",
    ),
    Column(
        figure="probe_mlp[action]",
        heading="Probe, action",
        meaning="How well a small network reads the true action from the latent one: accuracy of names, else R².",
        higher=True,
    ),
    *(
        Column(
            figure=f"probe_mlp[{factor}]",
            heading=f"Probe, {words}",
            meaning=f"R² with which a small network reads the {words}, beyond what the action tells; should be 0.",
        )
        for factor, words in UNWANTED.items()
    ),
    *(
        Column(
            figure=f"state_probe[{place}]",
            heading=f"State, {words}",
            meaning=f"R² with which a linear probe reads the {words} from a model's state, in new layouts.",
            higher=True,
        )
        for place, words in (("agent_place", "agent's place"), ("object_place", "objects' places"))
    ),
    _gain_captured(),
    Column(
        figure="motion_probe_error",
        heading="Probe error",
        meaning="Squared error of a linear probe of the motion for the normalised action, if continuous; 0 is best.",
    ),
)
_CONTROL_AFTER: Final = (
    Column(
        figure="control_success",
        heading="Tasks solved",
        meaning="Share of the tasks that end with at most a fifth of the distance at the start.",
        higher=True,
    ),
    Column(figure="control_lost", heading="Objects lost", meaning="Objects that fall off the table, per task."),
)
HIGHER: Final = [one.heading for one in (*_SINGLE, *_AFTER, *_CONTROL_AFTER) if one.higher]
"""The headings of figures of which more is better."""
ROLLOUT_STEPS: Final = (5, 15)
CONTROL_STEPS: Final = (10, 40, 100)


def columns_for(figures: Collection[str], sequences: int | None = None) -> list[Column]:
    """The columns of a table of predictions that have at least one of these figures.

    Args:
        figures: By their fixed names.
        sequences: Action sequences that the gain captured compares at each moment, where that is known.
    """
    chosen = [column for column in _SINGLE if column.figure in figures]
    chosen += [TRUE_MOTION] if TRUE_MOTION.figure in figures and "mse" not in figures else []
    chosen += [column for column in _rollouts(figures) if column.figure in figures]
    after = [_gain_captured(sequences) if column.figure == GAIN_CAPTURED else column for column in _AFTER]
    return chosen + [column for column in after if column.figure in figures]


def control_steps(figures: Iterable[str]) -> list[int]:
    """After how many steps there is a distance of control, the fewest first."""
    return sorted({int(found[1]) for name in figures if (found := re.fullmatch(r"control_distance\[(\d+)\]", name))})


def control_columns(figures: Collection[str]) -> list[Column]:
    """The columns of a table of control; the first is the distance at the end, which ranks the rows."""
    steps = control_steps(figures)
    chosen = [
        Column(
            figure=f"control_distance[{step}]",
            heading=f"Distance, {step} steps",
            meaning=f"Of the objects to their goals after {step} steps, over that at the start; idle is 1.",
        )
        for step in reversed(steps)
        if step in CONTROL_STEPS or step == steps[-1]
    ]
    return chosen + [column for column in _CONTROL_AFTER if column.figure in figures]


def _rollouts(figures: Collection[str]) -> list[Column]:
    steps = [int(found[1]) for name in figures if (found := re.fullmatch(r"rollout_mse\[(\d+)\]", name))]
    wanted = sorted({step for step in ROLLOUT_STEPS if step in steps} | ({max(steps)} if steps else set()))
    return [
        Column(
            figure=f"rollout_mse[{step}]",
            heading=f"MSE, {step} ahead",
            meaning=f"Of the frame {step} steps ahead in a rollout that feeds on its own predictions.",
        )
        for step in wanted
    ]


def number(value: float | int | None) -> str:
    """A figure as it is rounded everywhere, with a true minus sign."""
    return rounded(value).replace("-", "\u2212")


def interval(low: float | None, high: float | None, *, sign: bool = False) -> str:
    """An interval as text; empty if there is none."""
    return from_to(low, high, number=signed if sign else number)


def count(value: float) -> str:
    """A count, or a value on an axis, without superfluous digits."""
    return f"{value:,.0f}" if abs(value) >= 1 and value == int(value) else f"{value:g}"


def signed(value: float) -> str:
    """A difference, with its sign."""
    text = number(value)
    return text if text == "0" or value < 0 else f"+{text}"


def named(what: str, names: Sequence[str]) -> str:
    """One thing or several by name: ``protocol a``, ``protocols a and b``."""
    if len(names) < 2:
        return f"{what} {''.join(names)}"
    return f"{what}s {', '.join(names[:-1])} and {names[-1]}"
