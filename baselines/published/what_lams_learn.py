"""What a latent action holds on a 4 x 4 grid, as *What Do Latent Action Models Actually Learn?* asks (2506.15691).

Zhang, Pearce et al. (NeurIPS 2025) show for a linear latent-action model that training is a principal component
analysis of all changes between two frames, caused by actions or not; and on a small grid world that the same holds
for a network with a quantised latent (section 5). A square walks in the upper 3 x 4 cells by five actions (four
directions and stay); the lowest row holds noise. Three things decide what the latent holds: how strong the noise is,
whether the policy's actions follow from the frame, and the two remedies, augmentation and a few labels.

Two losses say what is in it. Each is the error of the next frame as a decoder predicts it from the first frame and the
latent, divided by the least error that is possible without a latent: 0 means that the latent says everything, 1 that
it says nothing. *Controllable* is that of the upper cells, *stochastic* that of the lowest row.

Settled here, since the authors' program is in a supplement that we have not seen:

- Noise 0, 1 or 2 is the brightness of the lowest row's four cells; each is on in half of the frames, independently.
- A correlated policy takes in 95% of the steps the one action that the square's cell decides (the cells' numbers
  modulo 5), else any.
- Augmentation rolls the upper cells and the row, both frames of a pair alike; the encoder's pair is rolled otherwise
  than the decoder's, so that only what does not depend on the place passes from one to the other.
- 1% of the training's transitions are labelled: a linear map reads their actions from the latent, and its
  cross-entropy is added to the loss.
- The losses are those of a new decoder, fitted to fresh transitions of the uniform policy while the encoder is frozen.
  So all conditions are asked the same question.

``python -m baselines.published.what_lams_learn`` trains all 24 conditions with five seeds and prints the table.
"""

from __future__ import annotations

import argparse
import itertools
import json
import math
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from scipy.special import stdtrit
from torch import Tensor, nn

from baselines.lapo import LapoConfig, VectorQuantizer
from baselines.published.descent import descend
from dmotion_bench.scoring.statistics import LEVEL

ROWS, COLUMNS, ACTIONS = 3, 4, 5
CELLS, NOISY = ROWS * COLUMNS, COLUMNS
MOVES: Final = ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0))
FOLLOWS: Final = 0.95
LABELLED: Final = 0.01
TRANSITIONS: Final = 10_000
BATCH, STEPS, PROBE_STEPS, WIDTH, RATE = 128, 800, 500, 64, 2e-3
CODES, LENGTH = 8, 16
PUBLISHED: Final = {"without remedies": (0.781, 0.739), "with remedies": (0.295, 0.986)}
"""Controllable and stochastic loss as published: two pairs that are quoted of the table, not its rows."""


@dataclass(frozen=True, kw_only=True, order=True)
class Condition:
    """One row of the table.

    Attributes:
        noise: Brightness of the noise.
        correlated: Whether the policy's actions mostly follow from the frame.
        augmented: Whether the training rolls its frames.
        labelled: Whether 1% of the transitions have labels during the training.
    """

    noise: float
    correlated: bool
    augmented: bool
    labelled: bool


@dataclass(frozen=True, kw_only=True)
class Transitions:
    """Pairs of frames, as flat cells, and what was done between them; ``m`` data sets beside each other."""

    before: Float[Tensor, "m n 16"]
    after: Float[Tensor, "m n 16"]
    action: Int[Tensor, "m n"]

    def part(self, index: Int[Tensor, " b"]) -> Transitions:
        """These of each data set."""
        return Transitions(before=self.before[:, index], after=self.after[:, index], action=self.action[:, index])


def after(cell: Int[Tensor, " n"], action: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """The square's next cell; it stays where the grid ends."""
    moves = torch.tensor(MOVES)[action]
    row = (cell // COLUMNS + moves[:, 0]).clamp(0, ROWS - 1)
    column = (cell % COLUMNS + moves[:, 1]).clamp(0, COLUMNS - 1)
    return row * COLUMNS + column


def recorded(count: int, noise: float, correlated: bool, generator: torch.Generator) -> Transitions:
    """One data set of so many transitions, from cells drawn evenly."""
    cell = torch.randint(CELLS, (count,), generator=generator)
    action = torch.randint(ACTIONS, (count,), generator=generator)
    if correlated:
        follows = torch.rand(count, generator=generator) < FOLLOWS
        action = torch.where(follows, cell % ACTIONS, action)
    frames = [
        torch.cat([F.one_hot(place, CELLS), noise * torch.randint(2, (count, NOISY), generator=generator)], dim=1)
        for place in (cell, after(cell, action))
    ]
    return Transitions(before=frames[0].float()[None], after=frames[1].float()[None], action=action[None])


def beside(sets: Sequence[Transitions]) -> Transitions:
    """Data sets beside each other."""
    return Transitions(
        before=torch.cat([one.before for one in sets]),
        after=torch.cat([one.after for one in sets]),
        action=torch.cat([one.action for one in sets]),
    )


def least_errors(noise: float) -> tuple[float, float]:
    """The least squared error of the upper and the lowest cells that a prediction without a latent can have.

    Of the upper ones by counting over all cells and actions of the uniform policy; of the noise its variance. Summed
    over the cells.
    """
    cells = torch.arange(CELLS).repeat_interleave(ACTIONS)
    nexts = F.one_hot(after(cells, torch.arange(ACTIONS).repeat(CELLS)), CELLS).double()
    grouped = rearrange(nexts, "(c a) k -> c a k", a=ACTIONS)
    upper = (grouped - grouped.mean(1, keepdim=True)).square().sum(2).mean()
    return float(upper), NOISY * noise**2 / 4


def rolled(
    frames: Float[Tensor, "m b 16"], down: Int[Tensor, " b"], right: Int[Tensor, " b"]
) -> Float[Tensor, "m b 16"]:
    """The upper cells of each frame moved round both ways, its lowest row to the right."""
    row, column = torch.arange(ROWS), torch.arange(COLUMNS)
    rows = (row - down[:, None]) % ROWS
    columns = (column - right[:, None]) % COLUMNS
    places = torch.cat([(rows[:, :, None] * COLUMNS + columns[:, None]).flatten(1), CELLS + columns], dim=1)
    return frames.gather(2, places.expand(len(frames), -1, -1))


class Networks(nn.Module):
    """So many networks of two hidden layers beside each other, which share nothing but the time they take."""

    def __init__(self, count: int, inputs: int, outputs: int) -> None:
        super().__init__()
        sizes = itertools.pairwise((inputs, WIDTH, WIDTH, outputs))
        self.layers = nn.ModuleList(Linears(count, one, other) for one, other in sizes)

    def forward(self, features: Float[Tensor, "m b i"]) -> Float[Tensor, "m b o"]:
        first, *others = self.layers
        features = first(features)
        for layer in others:
            features = layer(F.relu(features))
        return features


class Linears(nn.Module):
    """So many linear layers beside each other, initialised as torch's."""

    def __init__(self, count: int, inputs: int, outputs: int) -> None:
        super().__init__()
        reach = inputs**-0.5
        self.weight = nn.Parameter(torch.empty(count, inputs, outputs).uniform_(-reach, reach))
        self.bias = nn.Parameter(torch.empty(count, 1, outputs).uniform_(-reach, reach))

    def forward(self, features: Float[Tensor, "m b i"]) -> Float[Tensor, "m b o"]:
        return torch.baddbmm(self.bias, features, self.weight)


class LatentActionModels(nn.Module):
    """An encoder of two frames into one of eight codes, a decoder of the second from the first and the code; of each m.

    Every model has a codebook of its own.
    """

    def __init__(self, count: int) -> None:
        super().__init__()
        self.count = count
        self.encoder = Networks(count, 2 * (CELLS + NOISY), LENGTH)
        self.quantizer = VectorQuantizer(
            LapoConfig(codebooks=count, latents=1, codes=CODES, length=LENGTH, commitment=0.25)
        )
        self.decoder = Networks(count, CELLS + NOISY + LENGTH, CELLS + NOISY)
        self.action = Linears(count, LENGTH, ACTIONS)

    def infer(self, pairs: Transitions) -> tuple[Float[Tensor, "m b d"], Float[Tensor, ""]]:
        """The quantised latents, and the commitment loss, summed over the models."""
        latent = self.encoder(torch.cat([pairs.before, pairs.after], dim=2))
        code, commitment = self.quantizer(rearrange(latent, "m b d -> b (m d)"))
        return rearrange(code, "b (m d) -> m b d", m=self.count), commitment * self.count

    def loss(self, pairs: Transitions, augmented: bool) -> Float[Tensor, ""]:
        """Squared error of the second frame, summed over its cells and the models, and the commitment."""
        seen = shown = pairs
        if augmented:
            seen, shown = _rolled_pairs(pairs), _rolled_pairs(pairs)
        code, commitment = self.infer(seen)
        return _error(self.decoder(torch.cat([shown.before, code], dim=2)), shown.after) + commitment

    def label_loss(self, labelled: Transitions) -> Float[Tensor, ""]:
        """Cross-entropy of the labelled actions as they are read from the latent, summed over the models."""
        read = self.action(self.infer(labelled)[0])
        each: Tensor = F.cross_entropy(read.flatten(0, 1), labelled.action.flatten()) * self.count
        return each


def _error(drawn: Float[Tensor, "m b 16"], true: Float[Tensor, "m b 16"]) -> Float[Tensor, ""]:
    return (drawn - true).square().sum((0, 2)).mean()


def _rolled_pairs(pairs: Transitions) -> Transitions:
    count = pairs.action.shape[1]
    down, right = torch.randint(ROWS, (count,)), torch.randint(COLUMNS, (count,))
    return Transitions(
        before=rolled(pairs.before, down, right), after=rolled(pairs.after, down, right), action=pairs.action
    )


def trained(data: Transitions, *, augmented: bool, labelled: bool, steps: int = STEPS) -> LatentActionModels:
    """A latent-action model of each of some data sets."""
    models = LatentActionModels(len(data.action)).train()
    told = data.part(torch.arange(round(LABELLED * data.action.shape[1])))

    def loss() -> Tensor:
        total = models.loss(data.part(torch.randint(data.action.shape[1], (BATCH,))), augmented)
        return total + models.label_loss(told) if labelled else total

    descend(models.parameters(), steps, RATE, loss)
    return models.eval()


def losses_of(
    infer: Callable[[Transitions], Float[Tensor, "m b d"]],
    noises: Sequence[float],
    seeds: Sequence[int],
    steps: int = PROBE_STEPS,
) -> list[tuple[float, float]]:
    """The controllable and the stochastic loss of each of some latents; the latter is 1 where there is no noise.

    Args:
        infer: Gives the latents of some transitions.
        noises: Of these, of each latent.
        seeds: Of these, of each latent.
        steps: That the new decoders are fitted for.
    """
    drawn = [
        [recorded(TRANSITIONS, noise, False, torch.Generator().manual_seed(2 * seed + part)) for part in (0, 1)]
        for noise, seed in zip(noises, (1_000_000 + seed for seed in seeds), strict=True)
    ]
    known, asked = (beside([pair[part] for pair in drawn]) for part in (0, 1))
    with torch.no_grad():
        inputs = [torch.cat([pairs.before, infer(pairs)], dim=2) for pairs in (known, asked)]
    decoders = Networks(len(noises), inputs[0].shape[2], CELLS + NOISY)

    def loss() -> Tensor:
        index = torch.randint(TRANSITIONS, (BATCH,))
        return _error(decoders(inputs[0][:, index]), known.after[:, index])

    descend(decoders.parameters(), steps, RATE, loss)
    with torch.no_grad():
        errors = (decoders(inputs[1]) - asked.after).square().mean(1)
    found = []
    for noise, error in zip(noises, errors, strict=True):
        upper, lowest = least_errors(noise)
        stochastic = float(error[CELLS:].sum()) / lowest if noise else 1.0
        found.append((float(error[:CELLS].sum()) / upper, stochastic))
    return found


def conditions() -> list[Condition]:
    """All rows of the table, in their order."""
    return [
        Condition(noise=noise, correlated=correlated, augmented=augmented, labelled=labelled)
        for noise in (0.0, 1.0, 2.0)
        for correlated, augmented, labelled in itertools.product((False, True), repeat=3)
    ]


def measured(seeds: int, steps: int, probe_steps: int) -> dict[Condition, list[tuple[float, float]]]:
    """Both losses of every condition under each seed."""
    found: dict[Condition, list[tuple[float, float]]] = {}
    for augmented, labelled in itertools.product((False, True), repeat=2):
        found |= measured_alike(augmented, labelled, seeds, steps, probe_steps)
    return {condition: found[condition] for condition in conditions()}


def measured_alike(
    augmented: bool, labelled: bool, seeds: int, steps: int, probe_steps: int
) -> dict[Condition, list[tuple[float, float]]]:
    """The same of the conditions that are trained alike: all noises, policies and seeds, beside each other."""
    alike = [one for one in conditions() if (one.augmented, one.labelled) == (augmented, labelled)]
    runs = [(condition, seed) for condition in alike for seed in range(seeds)]
    with torch.random.fork_rng():
        torch.manual_seed(0)
        data = beside(
            [
                recorded(TRANSITIONS, one.noise, one.correlated, torch.Generator().manual_seed(seed))
                for one, seed in runs
            ]
        )
        models = trained(data, augmented=augmented, labelled=labelled, steps=steps)
        noises, own = [one.noise for one, _ in runs], [seed for _, seed in runs]
        losses = losses_of(lambda pairs: models.infer(pairs)[0], noises, own, probe_steps)
    return {condition: losses[place * seeds : (place + 1) * seeds] for place, condition in enumerate(alike)}


def half_width(values: Sequence[float]) -> float:
    """Half of the 95% interval of a mean, by Student's t; infinite for one value."""
    if len(values) < 2:
        return float("inf")
    quantile = float(stdtrit(len(values) - 1, (1 + LEVEL) / 2))
    spread = float(np.std(values, ddof=1))
    return quantile * spread / math.sqrt(len(values))


def written(found: dict[Condition, list[tuple[float, float]]]) -> str:
    """The table in Markdown, and below it the published figures."""
    lines = [
        "| noise | policy | augmentation | labels | controllable loss | stochastic loss |",
        "|---|---|---|---|---|---|",
    ]
    for condition, values in found.items():
        figures = [
            f"{np.mean(column):.3f} ± {half_width(column):.3f}" if condition.noise or place == 0 else "-"
            for place, column in enumerate(zip(*values, strict=True))
        ]
        words = (
            f"{condition.noise:g}",
            "95% correlated" if condition.correlated else "uniform",
            "yes" if condition.augmented else "no",
            "1%" if condition.labelled else "0",
        )
        lines.append(f"| {' | '.join([*words, *figures])} |")
    lines += ["", "| published (2506.15691, table 1) | controllable loss | stochastic loss |", "|---|---|---|"]
    lines += [f"| {name} | {ours:.3f} | {other:.3f} |" for name, (ours, other) in PUBLISHED.items()]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, measure and print."""
    parser = argparse.ArgumentParser(prog="python -m baselines.published.what_lams_learn", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--seeds", type=int, default=5, help="trainings of each condition")
    parser.add_argument("--steps", type=int, default=STEPS, help="of a training")
    parser.add_argument("--probe-steps", type=int, default=PROBE_STEPS, help="of the decoder that asks")
    parser.add_argument("--json", action="store_true", help="print every value as one JSON object")
    asked = parser.parse_args(arguments)
    if min(asked.seeds, asked.steps, asked.probe_steps) < 1:
        parser.error("--seeds, --steps and --probe-steps must be 1 or more.")
    torch.set_num_threads(1)  # the networks are small: more threads would wait for each other
    began = time.process_time()
    found = measured(asked.seeds, asked.steps, asked.probe_steps)
    sys.stderr.write(f"{(time.process_time() - began) / 60:.1f} CPU minutes\n")
    if asked.json:
        rows = [{**vars(condition), "losses": values} for condition, values in found.items()]
        sys.stdout.write(json.dumps(rows) + "\n")
    else:
        sys.stdout.write(written(found) + "\n")


if __name__ == "__main__":
    main()
