"""How many steps lie between two frames, learned from video without labels.

Two frames of one episode are as many steps apart as their numbers say, so video teaches this by itself (Hartikainen et
al. 2020, "Dynamical Distance Learning", section 3; Savinov et al. 2019, "Episodic Curiosity through Reachability",
section 2.2). A network gives each frame a vector; steps are a function of the vectors' distance that is zero for equal
frames and ends at ``reach``. Frames of two episodes, and those farther apart, teach ``reach``.

A planner can add it to its cost as what lies beyond its horizon (``planning/objectives/steps_to_go.py``). The network
is kept in the workspace's ``values/``, in a file that is named by the hash of its weights::

    python -m dmotion_bench.learning.temporal_distance data/planar_push-small
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Final

import numpy as np
import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.nn import functional

from dmotion_bench.errors import DatasetError, DmbenchError, InvalidSetting, RunCorrupt
from dmotion_bench.learning.hardware.threads import using_threads
from dmotion_bench.learning.images import to_model
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.settings import from_json
from dmotion_bench.learning.training.randomness import seeded
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.readable import Frames, ReadableDataset
from dmotion_bench.values import require_bounds
from dmotion_bench.wording import shown
from dmotion_bench.workspace import Workspace

FOLDER: Final = "values"
HEX: Final = frozenset("0123456789abcdef")
SIDE: Final = 32
"""Of the pictures that the network sees [px]."""

FAR: Final = 0.25
"""Share of a batch's pairs that are frames of two episodes."""


@dataclass(frozen=True, kw_only=True)
class TemporalDistanceConfig:
    """How the network is trained.

    Attributes:
        steps: Of training.
        batch_size: Pairs of frames in each.
        reach: The most steps that it tells apart.
        width: Channels of its first layer.
        learning_rate: Of Adam; falls to zero on a line.
        seed: Of the weights and the pairs.
    """

    steps: int = 1500
    batch_size: int = 128
    reach: int = 30
    width: int = 24
    learning_rate: float = 1e-3
    seed: int = 0

    def __post_init__(self) -> None:
        require_bounds(
            self,
            from_one=("steps", "batch_size", "reach", "width"),
            above_zero=("learning_rate",),
            from_zero=("seed",),
        )


class TemporalDistance(nn.Module):
    """Steps between frames.

    Args:
        config: Of its training; width and reach are its own.
    """

    def __init__(self, config: TemporalDistanceConfig) -> None:
        super().__init__()
        self.config, w = config, config.width
        self.layers = nn.Sequential(
            nn.Conv2d(3, w, 4, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(w, 2 * w, 4, stride=2, padding=1),
            nn.SiLU(),
            nn.Conv2d(2 * w, 2 * w, 4, stride=2, padding=1),
            nn.SiLU(),
            nn.Flatten(),
            nn.Linear(2 * w * (SIDE // 8) ** 2, 64),
        )

    def embed(self, frames: Float[Tensor, "n c h w"]) -> Float[Tensor, "n d"]:
        """The vectors of frames in [-1, 1], of any size."""
        embedded: Tensor = self.layers(functional.adaptive_avg_pool2d(frames, SIDE))
        return embedded

    def between(self, first: Float[Tensor, "n d"], second: Float[Tensor, "n d"]) -> Float[Tensor, " n"]:
        """The steps between frames with these vectors."""
        apart = (first - second).square().sum(dim=1).add(1e-12).sqrt()
        return self.config.reach * (1 - torch.exp(-apart))


def train_on(dataset: ReadableDataset, config: TemporalDistanceConfig | None = None) -> TemporalDistance:
    """Train on the video of a data set's training episodes; labels are not opened."""
    return train(dataset.cache(), dataset.split("train"), config)


def train(
    frames: Frames, episodes: Int[np.ndarray, " e"], config: TemporalDistanceConfig | None = None
) -> TemporalDistance:
    """Train on the video of some episodes.

    Args:
        frames: Of all episodes.
        episodes: To learn from.
        config: Of the training.

    Raises:
        DatasetError: No episode has two frames.
    """
    config, offsets = config or TemporalDistanceConfig(), np.asarray(frames.offsets)
    episodes = episodes[offsets[episodes + 1] - offsets[episodes] > 1]
    if not len(episodes):
        raise DatasetError("none of the episodes has two frames, so no time passes in any.")
    with seeded(config.seed, 0, torch.device("cpu")):
        network = TemporalDistance(config)
    optimizer = torch.optim.Adam(network.parameters(), lr=config.learning_rate)
    for step in range(config.steps):
        generator = np.random.default_rng([config.seed, step])
        first, second, apart = pairs(generator, offsets, episodes, config.batch_size, config.reach)
        places = np.concatenate([first, second])
        both = to_model(torch.from_numpy(frames.checked(places, 1)[places]))
        one, other = network.embed(both).chunk(2)
        target = torch.from_numpy(apart)
        loss = functional.smooth_l1_loss(network.between(one, other) / config.reach, target / config.reach, beta=0.1)
        optimizer.param_groups[0]["lr"] = config.learning_rate * (1 - step / config.steps)
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimizer.step()
    return network.eval()


def pairs(
    generator: np.random.Generator,
    offsets: Int[np.ndarray, " e1"],
    episodes: Int[np.ndarray, " e"],
    count: int,
    reach: int,
) -> tuple[Int[np.ndarray, " n"], Int[np.ndarray, " n"], Float[np.ndarray, " n"]]:
    """Pairs of frames, by their places among all, and how many steps apart they are, at most ``reach``.

    Near ones are drawn as often as far ones; a share ``FAR`` is of two episodes and counts ``reach``.

    Args:
        generator: Of the draws.
        offsets: Where each episode begins, and where the last one ends.
        episodes: To draw from.
        count: Of pairs.
        reach: The most steps.
    """
    own = episodes[generator.integers(len(episodes), size=count)]
    begin, length = offsets[own], offsets[own + 1] - offsets[own]
    first = (generator.random(count) * length).astype(np.int64)
    way = generator.integers(1, reach + 1, size=count) * generator.choice([-1, 1], size=count)
    second = np.clip(first + way, 0, length - 1)
    apart = np.abs(second - first).astype(np.float32)
    other = episodes[generator.integers(len(episodes), size=count)]
    elsewhere = (generator.random(count) < FAR) & (other != own)
    strange = offsets[other] + (generator.random(count) * (offsets[other + 1] - offsets[other])).astype(np.int64)
    return (
        begin + first,
        np.where(elsewhere, strange, begin + second),
        np.where(elsewhere, np.float32(reach), apart).astype(np.float32),
    )


def place_of(name: str, workspace: Workspace | None = None) -> Path:
    """The file of a network.

    Args:
        name: The hash of its weights.
        workspace: Whose; the current one by default.

    Raises:
        InvalidSetting: That is no hash.
    """
    if len(name) != 64 or not HEX.issuperset(name):
        raise InvalidSetting(
            f"{name!r} names no learned distance; train one with "
            "'python -m dmotion_bench.learning.temporal_distance data/NAME', which prints its name."
        )
    return (workspace or Workspace.current()).root / FOLDER / f"{name}.safetensors"


def save(network: TemporalDistance, workspace: Workspace | None = None) -> str:
    """Write a network into the workspace; returns its name."""
    weights = dict(network.state_dict())
    name = checkpoint.weights_hash(weights)
    checkpoint.save(place_of(name, workspace), weights, {"config": asdict(network.config)})
    return name


def load(name: str, workspace: Workspace | None = None) -> TemporalDistance:
    """Read a network by its name.

    Raises:
        InvalidSetting: There is none of this name, or its file holds other weights.
    """
    path = place_of(name, workspace)
    if not path.is_file():
        raise InvalidSetting(
            f"there is no learned distance {name[:12]}... in {str(path.parent)!r}; train one with "
            "'python -m dmotion_bench.learning.temporal_distance data/NAME'."
        )
    try:
        weights, facts = checkpoint.load(path)
    except RunCorrupt:
        raise InvalidSetting(
            f"{shown(str(path))} is damaged, so it holds no learned distance; delete that file and train the network "
            "again with 'python -m dmotion_bench.learning.temporal_distance data/NAME'."
        ) from None
    try:
        config = from_json(TemporalDistanceConfig, Fields(facts, "it").pairs("config"))
        with torch.device("meta"):  # no memory is taken for a width that the file only claims
            forms = checkpoint.forms_of(TemporalDistance(config).state_dict())
        if forms != checkpoint.forms_of(weights):
            raise InvalidSetting(f"{str(path)!r} holds no learned distance: its weights are of another width.")
        network = TemporalDistance(config)
        network.load_state_dict(weights)
    except (TypeError, ValueError, RuntimeError) as error:
        raise InvalidSetting(f"{str(path)!r} holds no learned distance: {error}.") from None
    if checkpoint.weights_hash(weights) != name:
        raise InvalidSetting(f"{str(path)!r} holds other weights than its name says; train the network again.")
    return network.eval()


def main(arguments: Sequence[str] | None = None) -> None:
    """Train a network on a data set and print its name."""
    parser = argparse.ArgumentParser(description="Learn from video how many steps lie between two frames.")
    parser.add_argument("data", help="The data set's folder.")
    parser.add_argument("--steps", type=int, default=TemporalDistanceConfig.steps, help="Of training.")
    parser.add_argument("--seed", type=int, default=0)
    asked = parser.parse_args(arguments)
    try:
        config, workspace = TemporalDistanceConfig(steps=asked.steps, seed=asked.seed), Workspace.current()
        with using_threads(1):
            network = train_on(Dataset.open(workspace.dataset(asked.data)), config)
        name = save(network, workspace)
    except DmbenchError as error:
        parser.error(str(error))
    sys.stdout.write(f"{name}\n")


if __name__ == "__main__":
    main()
