"""What of a model is scored, and the settings that decide its figures."""

from __future__ import annotations

from dataclasses import dataclass, field, fields
from typing import Any, Literal, get_args

from dmotion_bench.errors import InvalidSetting
from dmotion_bench.learning.data.triplets import SplitProtocol
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.gain import GainScoring
from dmotion_bench.scoring.prediction import Precision
from dmotion_bench.scoring.statistics import RESAMPLES
from dmotion_bench.specs import SplitName
from dmotion_bench.values import require_bounds

Metric = Literal["prediction", "rollout", "gain", "control"]
METRICS: tuple[Metric, ...] = get_args(Metric)
DEFAULT_METRICS: tuple[Metric, ...] = ("prediction", "rollout")
"""Those that need no simulator and take seconds; the gain captured takes a minute or a few, control many."""

OWN_SETTINGS: tuple[Metric, ...] = ("gain", "control")
"""Groups that are decided by settings of their own, which begin with the group's name, and by no others."""


@dataclass(frozen=True, kw_only=True)
class ScoreSettings:
    """The settings that decide a report's figures, besides the weights and the data.

    Attributes:
        split: The episodes that are scored.
        protocol: How triplets are split; a run trained on the paper's leaking split is scored on it.
        horizon: Steps of a rollout.
        precision: Of the model's arithmetic: ``"float32"``, or ``"bf16"`` autocast.
        resamples: Draws of the bootstrap.
        gain: At how many moments the gain captured is measured, and how.
        control: Which control tasks are worked on, and how.
    """

    split: SplitName = "test"
    protocol: SplitProtocol = "episode"
    horizon: int = 15
    precision: Precision = "float32"
    resamples: int = RESAMPLES
    gain: GainScoring = field(default_factory=GainScoring)
    control: ControlScoring = field(default_factory=ControlScoring)

    def __post_init__(self) -> None:
        if self.horizon < 1:
            raise InvalidSetting(f"the horizon is {self.horizon}; a rollout has at least 1 step.")
        require_bounds(self, from_one=("resamples",))

    def to_json(self, metrics: tuple[str, ...]) -> dict[str, Any]:
        """The settings as a report with these groups of figures stores them."""
        plain = {one.name: getattr(self, one.name) for one in fields(self) if one.name not in OWN_SETTINGS}
        owned = {"gain": self.gain.to_json(), "control": self.control.to_json()}
        chosen = {name: value for group in OWN_SETTINGS if group in metrics for name, value in owned[group].items()}
        return plain | chosen | {"metrics": list(metrics)}
