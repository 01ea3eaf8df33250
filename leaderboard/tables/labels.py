"""What labels are worth: eight models with 1, 2, 4 ... all labelled transitions, on both pushing worlds.

A model of video is trained once for all of its budgets, so that it has every power of two. A model that learns from
actions is trained anew for each, and has every power of four. So is relabelling (``idm-ed-cnn``), which learns from
video that an inverse model has named. Its trainings cost more than those of the six models of video together and would
bring the table to more than 40 core-hours, so it is trained only where it is named: ``--models idm-ed-cnn``. C-SWM and
the JEPA would cost another 24 core-hours.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.reproduction.table import Column, Entrant, Table, World, powers_of_two
from dmotion_bench.specs import Preset

_VIDEO: Final = ("dmotion", "dmotion-no-stn", "lapo", "lam-vae", "clasp", "laom")
_ANEW: Final = ("ed-cnn", "wm-ae")
_DOUBLED: Final = tuple(powers_of_two(4096))
_QUADRUPLED: Final = tuple(count for count in _DOUBLED[::2] if count != "1")

TABLE: Final = Table(
    title="what labels are worth: figures by the number of labelled transitions",
    worlds=(World(environment="planar_push"), World(environment="robot_push")),
    entrants=(
        *(Entrant(model=name, labels=(*_DOUBLED, "all")) for name in _VIDEO),
        *(Entrant(model=name, labels=(*_QUADRUPLED, "all")) for name in _ANEW),
        Entrant(model="idm-ed-cnn", labels=(*_QUADRUPLED, "all"), on_request=True),
    ),
    columns=(Column(name="labels", metrics=("prediction", "rollout", "gain")),),
    preset=Preset.SMALL,
    seeds=(0, 1, 2),
)
