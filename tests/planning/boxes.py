"""Two boxes on a black ground or a table, and a curtain in front of them, for what has to do with where objects are."""

from __future__ import annotations

import numpy as np
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.planning.objectives.tabletop.settings import TabletopSettings
from dmotion_bench.specs import EnvSpec, ObjectSpec

RED, BLUE = (230, 20, 20), (20, 20, 230)
SPEC = EnvSpec(
    id="covered",
    actions=Discrete(("left", "right")),
    agent=ObjectSpec(name="curtain", shape="box", color=(250, 250, 250)),
    objects=(
        ObjectSpec(name="red_box", shape="box", color=RED),
        ObjectSpec(name="blue_box", shape="box", color=BLUE),
    ),
    height=64,
    width=64,
)
SETTINGS = TabletopSettings()
FIRST = torch.zeros(1, dtype=torch.long)
AT = (20, 30)
TABLE = torch.tensor([200, 180, 150], dtype=torch.uint8)


def picture(
    red: tuple[int, int] | None = AT, blue: tuple[int, int] = (50, 50), curtain: slice | None = None
) -> torch.Tensor:
    """Boxes of 11 x 11 pixels around their centres (x, y), and a white curtain over some columns."""
    frame = np.zeros((64, 64, 3), np.uint8)
    for place, color in ((red, RED), (blue, BLUE)):
        if place is not None:
            frame[place[1] - 5 : place[1] + 6, place[0] - 5 : place[0] + 6] = color
    if curtain is not None:
        frame[:, curtain] = 250
    return torch.from_numpy(frame)[None]


def on_a_table(
    frame: torch.Tensor, left: int = 0, top: int = 0, right: int | None = None, bottom: int | None = None
) -> torch.Tensor:
    """The picture with a table under the boxes; the ground outside its columns and rows (last ones excluded) stays."""
    standing = torch.zeros(frame.shape[:-1], dtype=torch.bool)
    standing[:, top:bottom, left:right] = True
    table = frame.clone()
    table[standing & (frame == 0).all(-1)] = TABLE
    return table
