"""Labels during the training, with and without distractors: LAPO, LAOM and LAOM with labels on Planar Push.

It repeats a finding of Nikulin et al. (arXiv 2502.00379): how well a linear probe reads the action from a latent action
that is learned beside distractors, without labels and with 1% or 2.5% of them. The probe is among the figures of
prediction. Labels that only name the latent actions afterwards do not change it, so LAPO and LAOM have one budget.
"""

from __future__ import annotations

from typing import Final

from dmotion_bench.reproduction.table import Column, Entrant, Table, World
from dmotion_bench.specs import Preset

_SETTINGS: Final = ("epochs=5",)
_DURING: Final = ("1%", "2.5%")

TABLE: Final = Table(
    title="labels during the training of latent actions, with and without distractors",
    worlds=(
        World(environment="planar_push"),
        World(environment="planar_push", name="distracted", settings=("scene=distracted",)),
    ),
    entrants=(
        *(Entrant(model=name, labels=_DURING[-1:], settings=_SETTINGS) for name in ("lapo", "laom")),
        Entrant(model="laom-labels", labels=_DURING, settings=_SETTINGS),
    ),
    columns=(Column(name="prediction", metrics=("prediction",)),),
    preset=Preset.SMALL,
    seeds=(0, 1, 2),
)
