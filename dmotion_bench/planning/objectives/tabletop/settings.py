"""Every number of the table-top objective, in one place.

They were tuned on the first 20 tasks of two Robot Push data sets (``leaderboard/planners.json``). Lengths named as
shares are shares of the frame's width. ``docs/protocol.md`` says what each part is for.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.settings import only_for
from dmotion_bench.planning.objectives.tracked import Tracked
from dmotion_bench.values import require_bounds


@dataclass(frozen=True, kw_only=True)
class TabletopSettings:
    """The settings of the table-top objective and of its parts.

    Attributes:
        fully_seen: The share of an object's usual pixels from which on it counts as fully seen.
        box_margin_px: A visible part may lie this far outside the bounding box [px]: predicted edges are not sharp.
        search_reach: An object is looked for this far beyond its bounding box; a share of the width.
        still_px: What is predicted to move less than this since the last real image has not moved [px].
        least_gain: A change of the cost below this, as a distance, is not believed; a share of the width.
        touch_distance: Objects that are predicted to move this far in all and bring nothing thereby cost as much as a
            change that is not believed: what is predicted of a first touch is too little; a share of the width.
        lost_distance: What a missing object costs, as a distance; a share of the width. One that may be lost costs its
            risk times as much, on top of its own distance.
        turned_size: An object that is seen in one piece may be this many times as long and wide: it may have turned.
        ground_from, ground_to: The ground's colour is looked for between so far and so far beyond an object's
            bounding box; shares of the width.
        ground_tolerance: A pixel whose three colours differ by less than this from the ground's is ground, of 255.
        bare_share: From this share of bare ground in its place on, an object that is gone has fallen.
        second_ground_share: An object at the table's edge has two grounds: what is unlike the first around it, if it
            is this share of all.
        table_sides: The table is a polygon of so many sides around all visible ground, each of its own direction.
        table_patch_px: Ground is where most pixels of a square of so many a side have its colour.
        edge_margin: An object whose centre is nearer to the edge than this is watched; a share of the width.
        edge_open_share: So much of its usual pixels must be seen of it; of one that the agent hides already any step
            may hide the rest.
        gone_share: Next to nothing is left of an object: less than this share of the pixels that are seen of it now.
        outward_motion: An object is carried out if what is seen of it moves by more than this towards the edge; a
            share of the width.
        fall_below: An object that is carried out is likely to fall if less than this share of its pixels is left,
        may_fall_below: and may fall if less than this share is left.
        unsure_below: One that is not carried out may fall if less than this share is left.
        fall_likely, fall_unlikely: The shares of such steps that make an object fall [measured; of the second kind it
            is 1/23 before anybody chooses among them].
        passing_below: What passes before an object shows so far below its bounding box, from and to,
        passing_beside: and at most so far beside it; shares of the width.
        passing_pixels: In some row there it has at least so many pixels.
        history_side_px: Past images are compared at this many pixels a side.
        same_image: Images that differ by less look the same, as a mean squared difference in [0, 1] units; a step of
            the robot's arm makes 3e-4 or more.
        same_action: Continuous actions, in [-1, 1], that are nearer to each other than this are the same.
        prediction_error: What is predicted differs by this much from what is then seen, on a good day.
        new_image: A difference that is new for sure.
        settled_scale: Both are so much smaller where nothing is misplaced: then the whole image counts alike.
        around_std: Around an object means within this standard deviation of it; a share of the width.
        elsewhere_weight: What all other places count, where those around an object count 1.
        placed_within: For an object nearer to its goal than this nothing is risked,
        misplaced_from: and from here on it counts in full; shares of the width.
        push_pose_bonus: To be where a push can begin, and not a frame's width away, weighs this share of
            ``least_gain``.
        novelty_bonus: What is new weighs at most this share of it.
        leave_penalty: And so does leaving what has just been seen, where nothing is misplaced.
        revisit_penalty: Each time that an action was tried before where everything looked the same weighs this share.
        clearance: A push begins so far beyond an object's bounding box; a share of the width.
        push_axis_share: Along the image's other axis an object is pushed, too, if it has to go this share of the
            longer way there.
        tip_rows: The tool's tip is looked for in so many rows.
    """

    fully_seen: float = Tracked.fully_seen
    box_margin_px: float = Tracked.box_margin_px
    search_reach: float = 6 / 128
    still_px: float = 1.0
    least_gain: float = 4 / 128
    touch_distance: float = 4 / 128
    lost_distance: float = Tracked.lost_distance
    turned_size: float = 1.5
    ground_from: float = 2 / 128
    ground_to: float = 6 / 128
    ground_tolerance: float = 30.0
    bare_share: float = 0.4
    second_ground_share: float = 0.3
    table_sides: int = 64
    table_patch_px: int = 5
    edge_margin: float = 11 / 128
    edge_open_share: float = 0.3
    gone_share: float = 0.15
    outward_motion: float = 0.5 / 128
    fall_below: float = 0.5
    may_fall_below: float = 0.9
    unsure_below: float = 0.7
    fall_likely: float = 2 / 3
    fall_unlikely: float = 1 / 16
    passing_below: tuple[float, ...] = (3 / 128, 16 / 128)
    passing_beside: float = 3 / 128
    passing_pixels: int = 2
    history_side_px: int = 16
    same_image: float = 2e-4
    same_action: float = only_for(0.25, Continuous)
    prediction_error: float = 2e-3
    new_image: float = 1e-2
    settled_scale: float = 0.2
    around_std: float = 0.12
    elsewhere_weight: float = 0.03
    placed_within: float = 5 / 128
    misplaced_from: float = 20 / 128
    push_pose_bonus: float = 0.6
    novelty_bonus: float = 0.15
    leave_penalty: float = 0.35
    revisit_penalty: float = 0.3
    clearance: float = 4 / 128
    push_axis_share: float = 0.5
    tip_rows: int = 3

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            numbers = value if isinstance(value, tuple) else (value,)
            if any(number < 0 or not math.isfinite(number) for number in numbers):
                raise InvalidSetting(f"{field.name} is {value}; it cannot be below zero.")
        require_bounds(
            self,
            from_one=("table_sides", "table_patch_px", "passing_pixels", "history_side_px", "tip_rows"),
            above_zero=("misplaced_from", "new_image", "settled_scale", "around_std", "touch_distance"),
        )
        if self.table_patch_px % 2 == 0:
            raise InvalidSetting(
                f"table_patch_px is {self.table_patch_px}; a patch has a pixel in its middle: an odd number."
            )
        if len(self.passing_below) != 2:
            raise InvalidSetting(f"passing_below is {self.passing_below}; it takes two numbers: from,to.")
