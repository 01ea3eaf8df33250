"""C-SWM on its own paper's *2D shapes*: does our program know what comes next where the authors' does?

Kipf, van der Pol, Welling (ICLR 2020), section 4.1 and table 1. Five objects of different shapes and colours stand in
the cells of a 5 x 5 grid. An action moves one of them to a neighbouring cell, if that is free. The model learns from
1,000 episodes of 100 random actions. Then it imagines 1, 5 and 10 steps of 10,000 other episodes in its own space, and
the true state is looked for among those of all 10,000: H@1 is how often it is the nearest to the imagined one, MRR the
mean of one divided by its place.

Model and loss are those of ``baselines/cswm.py``. As in the paper are five slots of two numbers, that a state is made
of one frame, the negatives (any other state of the batch), Adam's rate, and that each slot is told what is done to one
object, or nothing. A decoder is then trained on the states, as for the benchmark, and draws the next frame of the other
episodes. Settled otherwise:

- The frames have 80 x 80 pixels instead of 50 x 50: 16 pixels a cell give the extractor's maps the 5 x 5 places of the
  grid, as the authors' have.
- 20 passes in batches of 256 instead of 100 passes in batches of 1,024, with a rate that falls to zero.

``python -m baselines.published.cswm_shapes`` trains one model for each seed and prints the table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import asdict, dataclass
from statistics import fmean
from typing import Final

import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor

from baselines.cswm import ContrastiveConfig, ContrastiveWorldModel, GraphTransition
from baselines.published.descent import train
from dmotion_bench.actions import Discrete
from dmotion_bench.learning.action_encoding import Actions
from dmotion_bench.learning.hardware.memory import keep_freed_memory
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ModelInputs, TripletBatch
from dmotion_bench.scoring.latent_ranking import ranks

SIDE, OBJECTS, CELL = 5, 5, 16
MOVES: Final = ((-1, 0), (1, 0), (0, -1), (0, 1))
WAYS: Final = ("up", "down", "left", "right")
ACTIONS: Final = Discrete(names=tuple(f"{name}-{way}" for name in "abcde" for way in WAYS))
EPISODES, LENGTH = 1_000, 100
ASKED, HORIZONS = 10_000, (1, 5, 10)
BATCH, PASSES, RATE = 256, 20, 5e-4
DRAWN_BATCH, DECODER_STEPS, DRAWN_RATE = 64, 1_500, 1e-3
PUBLISHED: Final = {1: 1.0, 5: 1.0, 10: 0.999}
"""H@1 by steps ahead, from the paper's table 1."""


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Boards: the cell of each object, before and after each action."""

    cells: Int[Tensor, "n s 5"]
    actions: Int[Tensor, "n t"]


def recorded(count: int, length: int, generator: torch.Generator) -> Episodes:
    """So many episodes of random actions, each from five cells drawn evenly."""
    board = torch.rand(count, SIDE**2, generator=generator).argsort(1)[:, :OBJECTS]
    actions = torch.randint(len(ACTIONS.names), (count, length), generator=generator)
    boards = [board]
    for step in range(length):
        board = after(board, actions[:, step])
        boards.append(board)
    return Episodes(cells=torch.stack(boards, 1), actions=actions)


def after(board: Int[Tensor, "n 5"], action: Int[Tensor, " n"]) -> Int[Tensor, "n 5"]:
    """The next board: one object goes to the neighbouring cell, unless that is taken or beyond the edge."""
    which, way = action // len(MOVES), torch.tensor(MOVES)[action % len(MOVES)]
    cell = board.gather(1, which[:, None])[:, 0]
    row, column = cell // SIDE + way[:, 0], cell % SIDE + way[:, 1]
    wanted = row * SIDE + column
    inside = (row >= 0) & (row < SIDE) & (column >= 0) & (column < SIDE)
    free = inside & ~(board == wanted[:, None]).any(1)
    return board.scatter(1, which[:, None], torch.where(free, wanted, cell)[:, None])


def shapes() -> Float[Tensor, "6 3 16 16"]:
    """An empty cell and the five objects, in [-1, 1]: a circle, a square, a triangle, a cross and a diamond."""
    down, right = torch.meshgrid(*[torch.arange(CELL) - (CELL - 1) / 2] * 2, indexing="ij")
    outlines = (
        down.square() + right.square() <= 7.5**2,
        torch.maximum(down.abs(), right.abs()) <= 6.5,
        (right.abs() <= (down + 7.5) / 2) & (down <= 6.5),
        torch.minimum(down.abs(), right.abs()) <= 2.5,
        down.abs() + right.abs() <= 8,
    )
    colours = ((1, -1, -1), (-1, 1, -1), (-1, -1, 1), (1, 1, -1), (-1, 1, 1))
    tiles = -torch.ones(OBJECTS + 1, 3, CELL, CELL)
    for tile, outline, colour in zip(tiles[1:], outlines, colours, strict=True):
        tile[:, outline] = torch.tensor(colour, dtype=torch.float32)[:, None]
    return tiles


def drawn(boards: Int[Tensor, "n 5"], tiles: Float[Tensor, "6 3 16 16"]) -> Float[Tensor, "n 3 80 80"]:
    """The picture of each board."""
    what = torch.zeros(len(boards), SIDE**2, dtype=torch.int64)
    what.scatter_(1, boards, torch.arange(1, OBJECTS + 1).expand_as(boards))
    return rearrange(tiles[what], "n (y x) c p q -> n c (y p) (x q)", y=SIDE)


class OwnActions(GraphTransition):
    """Tells slot k what is done to object k, or nothing; the benchmark's worlds have one agent, so all slots are told.

    Nothing says that slot k is to hold object k; but only of a slot that does can the change be predicted.
    """

    def __init__(self, config: ContrastiveConfig) -> None:
        super().__init__(config, Discrete(names=WAYS))

    def told(self, action: Actions, slots: int) -> Float[Tensor, "b k 4"]:
        """The way of the object that is moved, zeros for the others."""
        object_ = F.one_hot(action // len(MOVES), slots).float()
        told: Tensor = object_[:, :, None] * self.encoding(action % len(MOVES))[:, None]
        return told


class ShapesModel(ContrastiveWorldModel):
    """The benchmark's C-SWM in the paper's size, with the paper's actions."""

    def __init__(self) -> None:
        config = ContrastiveConfig(slots=OBJECTS, features=2, frames=1, near=0.0)
        super().__init__(config, ModelInputs(height=SIDE * CELL, width=SIDE * CELL, actions=ACTIONS))
        self.transition = OwnActions(config)


def trained(seed: int, passes: int, decoder_steps: int, data: Episodes) -> ShapesModel:
    """A C-SWM of 2D shapes: states from so many passes over the recording, then a decoder of them."""
    torch.manual_seed(seed)
    model = ShapesModel()
    contrast, decoder = model.phases()
    tiles = shapes()

    def batches(size: int) -> Callable[[], TripletBatch]:
        return lambda: _triplets(data, torch.randint(len(data.actions), (size,)), tiles)

    train(model, contrast, batches(BATCH), steps=passes * (data.actions.numel() // BATCH), rate=RATE)
    train(model, decoder, batches(DRAWN_BATCH), steps=decoder_steps, rate=DRAWN_RATE)
    return model.eval()


def _triplets(data: Episodes, episode: Int[Tensor, " b"], tiles: Float[Tensor, "6 3 16 16"]) -> TripletBatch:
    """One moment of each episode; the first frame has none before it, and is given twice."""
    moment = torch.randint(data.actions.shape[1], (len(episode),))
    previous, current, following = (
        drawn(data.cells[episode, place], tiles) for place in ((moment - 1).clamp(min=0), moment, moment + 1)
    )
    return TripletBatch(previous=previous, current=current, next=following, action=data.actions[episode, moment])


@dataclass(frozen=True, kw_only=True)
class Figures:
    """What one training reaches on new episodes.

    Attributes:
        ranked: H@1 and MRR, by steps ahead.
        error: Mean squared error of the drawn next frame, over pixel values from 0 to 255.
        copying: The same of repeating the last frame.
    """

    ranked: dict[int, tuple[float, float]]
    error: float
    copying: float


@torch.no_grad()
def figures(model: ContrastiveWorldModel, data: Episodes) -> Figures:
    """Imagine the steps of all episodes beside each other, and draw the first."""
    tiles, pieces = shapes(), -(-len(data.cells) // BATCH)

    def pictures(step: int) -> Iterator[Float[Tensor, "b 3 80 80"]]:
        return (drawn(boards, tiles) for boards in torch.chunk(data.cells[:, step], pieces))

    def states(step: int) -> Float[Tensor, "n k d"]:
        pairs = zip(pictures(max(step - 1, 0)), pictures(step), strict=True)
        return torch.cat([model.states(before, now) for before, now in pairs])

    imagined, ranked = (states(0),), {}
    own: list[float] = []
    copied: list[float] = []
    for step in range(1, max(HORIZONS) + 1):
        imagined = model.advance(imagined, data.actions[:, step - 1])
        if step in HORIZONS:
            boards = torch.unique(data.cells[:, step].flatten(1), dim=0, return_inverse=True)[1]
            places = ranks(imagined[0].flatten(1).double(), states(step).flatten(1).double(), boards)
            ranked[step] = (float((places == 1).double().mean()), float(places.reciprocal().mean()))
        if step == 1:
            for state, last, true in zip(torch.chunk(imagined[0], pieces), pictures(0), pictures(1), strict=True):
                own += _errors(model.frame((state,)), true)
                copied += _errors(last, true)
    return Figures(ranked=ranked, error=fmean(own), copying=fmean(copied))


def _errors(picture: Float[Tensor, "b 3 h w"], true: Float[Tensor, "b 3 h w"]) -> list[float]:
    """Of each frame, as pixels."""
    difference = to_pixels(picture).double() - to_pixels(true).double()
    values: list[float] = difference.square().flatten(1).mean(1).tolist()
    return values


def written(found: Sequence[Figures]) -> str:
    """The table in Markdown: each training, and the paper's H@1."""
    titles = [f"H@1, {step} ahead | MRR, {step} ahead" for step in HORIZONS]
    lines = [f"| training | {' | '.join(titles)} | MSE | copying |", f"|---|{'---|' * (2 * len(HORIZONS) + 2)}"]
    for seed, one in enumerate(found):
        ranked = [f"{100 * value:.1f}" for step in HORIZONS for value in one.ranked[step]]
        lines.append(f"| seed {seed} | {' | '.join(ranked)} | {one.error:.1f} | {one.copying:.1f} |")
    lines.append(f"| Kipf et al. 2020 | {' '.join(f'{100 * PUBLISHED[step]:.1f} | |' for step in HORIZONS)} | |")
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, measure and print."""
    parser = argparse.ArgumentParser(prog="python -m baselines.published.cswm_shapes", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--seeds", type=int, default=1, help="trainings, of seeds 0, 1 ...")
    parser.add_argument("--passes", type=int, default=PASSES, help="over the recorded transitions")
    parser.add_argument("--decoder-steps", type=int, default=DECODER_STEPS, help="that the decoder is trained for")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="to learn from, of 100 steps each")
    parser.add_argument("--asked", type=int, default=ASKED, help="episodes whose states are looked for")
    parser.add_argument("--json", action="store_true", help="print every value as one JSON object")
    given = parser.parse_args(arguments)
    if min(given.seeds, given.passes, given.decoder_steps, given.asked) < 1:
        parser.error("--seeds, --passes, --decoder-steps and --asked must be 1 or more.")
    if given.episodes * LENGTH < BATCH:
        parser.error(f"--episodes must be {-(-BATCH // LENGTH)} or more, to fill a batch of {BATCH}.")
    keep_freed_memory()
    began = time.process_time()
    found = []
    for seed in range(given.seeds):
        own, other = (torch.Generator().manual_seed(2 * seed + part) for part in (0, 1))
        model = trained(seed, given.passes, given.decoder_steps, recorded(given.episodes, LENGTH, own))
        found.append(figures(model, recorded(given.asked, max(HORIZONS), other)))
    sys.stderr.write(f"{(time.process_time() - began) / 60:.1f} CPU minutes\n")
    if given.json:
        sys.stdout.write(json.dumps([asdict(one) for one in found]) + "\n")
    else:
        sys.stdout.write(written(found) + "\n")


if __name__ == "__main__":
    main()
