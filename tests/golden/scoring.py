"""Golden figures of scoring: what made-up models come to on small data sets that are recorded on the spot.

Write the file anew with ``cd tests && python -m golden.scoring``, after raising SCORING_VERSION.
"""

from __future__ import annotations

import dataclasses
import json
import tempfile
from pathlib import Path
from typing import Any, Final

import pyarrow as pa
import torch
from golden.control import WORLDS
from planning.worlds import PerfectGridModel
from torch import Tensor

from dmotion_bench.learning.images import to_model, to_pixels
from dmotion_bench.learning.model import ForwardModel
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.prediction import MODEL
from dmotion_bench.scoring.report import SCORING_VERSION
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.statistics import EARLIER_FEWEST
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset

FILE: Final = Path(__file__).with_name("scoring.json")
ADVICE: Final = (
    "If this is meant, raise SCORING_VERSION in dmotion_bench/scoring/report.py and write the figures anew with "
    "'cd tests && python -m golden.scoring'; published results of the version before are then of another version."
)
SETTINGS: Final = ScoreSettings(horizon=3, resamples=200)
RECIPES: Final = {
    "grid_world": DatasetRecipe(environment="grid_world", policy="random", seed=3, episodes=30, frames=14),
    "robot_push": DatasetRecipe(environment="robot_push", policy="push", seed=3, episodes=20, frames=8),
}
WITHOUT_ACTIONS: Final = "grid_world without actions"


class FlawedGridModel(PerfectGridModel):
    """Knows Grid World's rules and draws badly: a pattern over everything, red gone or green too far right.

    It has every ability that scoring asks about. All that it computes on pixels is whole numbers.
    """

    def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
        after = to_pixels(super().predict(previous, current, action)).to(torch.int16)
        red = (after[..., 0] > 200) & (after[..., 1:].amax(dim=-1) < 60)
        after[red & (action == 3)[:, None, None]] = 0
        green = (after[..., 1] > 200) & (after[..., 0] < 60) & (action == 1)[:, None, None]
        moved = green.roll(5, dims=2)
        after[green] = 0
        after[moved] = torch.tensor([0, 255, 0], dtype=torch.int16)
        row, column = torch.meshgrid(torch.arange(128), torch.arange(128), indexing="ij")
        after += ((row * 7 + column * 13) % 23 - 11).to(torch.int16)[..., None]
        return to_model(after.clamp(0, 255).to(torch.uint8))

    def agent_map(self, current: Tensor) -> Tensor:
        """Where green is, and a bit to the right of it."""
        green = (current[:, 1] > 0.9) & (current[:, 0] < -0.9)
        return (green | green.roll(4, dims=2)).float()

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        """How far green goes [px], and too much of where it is."""
        before, after = (self._green(image) for image in (current, following))
        return after - before + before / 4

    def pixel_shift(self, motion: Tensor) -> Tensor:
        return motion

    def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        shift = latent - self._green(current) / 4
        action = torch.stack([-shift[:, 1], shift[:, 1], -shift[:, 0], shift[:, 0]], dim=1).argmax(dim=1)
        return self.predict(previous, current, action)

    def embedding(self, state: Any) -> Tensor:
        """Where things are."""
        return self._finder.find(to_pixels(state[1])).centre.nan_to_num(-9).flatten(1)

    def _green(self, image: Tensor) -> Tensor:
        return self._finder.find(to_pixels(image)).centre[:, -1].nan_to_num(0.0)


def record(folder: Path) -> dict[str, Dataset]:
    """The data sets, by their names in the file."""
    datasets = {}
    for name, recipe in RECIPES.items():
        record_dataset(folder / name, recipe)
        datasets[name] = Dataset.open(folder / name)
    nameless = Dataset.open(folder / "grid_world")
    nameless.spec = dataclasses.replace(nameless.spec, actions=None)
    return datasets | {WITHOUT_ACTIONS: nameless}


def figures(name: str, dataset: Dataset) -> dict[str, Any]:
    """Every figure of a data set's model and of the references beside it, as in a report."""
    env = WORLDS[dataset.recipe.environment].make_env()
    model: ForwardModel[Any] = (
        FlawedGridModel() if name.startswith("grid_world") else WORLDS["robot_push"].make_model(env)
    )
    env.close()
    scores = score_model(model, dataset, settings=SETTINGS)
    return {
        "fingerprint": dataset.fingerprint,
        **{who: _json(scores.samples, who) for who in (MODEL, *scores.reference)},
    }


def _json(samples: pa.Table, who: str) -> dict[str, Any]:
    """With intervals, though these few episodes have none in a report."""
    found = figures_of(samples, who, resamples=SETTINGS.resamples, fewest=EARLIER_FEWEST)
    return {name: dataclasses.replace(estimate, episodes=None).to_json() for name, estimate in found.items()}


def stored() -> dict[str, Any]:
    """The golden file."""
    content: dict[str, Any] = json.loads(FILE.read_text())
    return content


def main() -> None:
    """Write the golden file."""
    torch.set_num_threads(1)
    with tempfile.TemporaryDirectory() as folder:
        found = {name: figures(name, dataset) for name, dataset in record(Path(folder)).items()}
    content = {"scoring_version": SCORING_VERSION, "figures": found}
    FILE.write_text(json.dumps(content, indent=1) + "\n")


if __name__ == "__main__":
    main()
