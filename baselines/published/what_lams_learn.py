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
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Float, Int
from torch import Tensor, nn

from baselines.lapo import LapoConfig, VectorQuantizer

ROWS, COLUMNS, ACTIONS = 3, 4, 5
CELLS, NOISY = ROWS * COLUMNS, COLUMNS
MOVES: Final = ((-1, 0), (1, 0), (0, -1), (0, 1), (0, 0))
FOLLOWS: Final = 0.95
LABELLED: Final = 0.01
TRANSITIONS: Final = 10_000
BATCH, STEPS, PROBE_STEPS, WIDTH, RATE = 128, 1000, 600, 96, 2e-3
CODES: Final = LapoConfig(codebooks=1, latents=1, codes=8, length=16, commitment=0.25)
PUBLISHED: Final = {"without remedies": (0.781, 0.739), "with 1% of the labels": (0.295, 0.986)}
"""Controllable and stochastic loss as published."""


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
    """Pairs of frames, as flat cells, and what was done between them."""

    before: Float[Tensor, "n 16"]
    after: Float[Tensor, "n 16"]
    action: Int[Tensor, " n"]

    def part(self, index: Int[Tensor, " m"]) -> Transitions:
        """These of them."""
        return Transitions(before=self.before[index], after=self.after[index], action=self.action[index])


def after(cell: Int[Tensor, " n"], action: Int[Tensor, " n"]) -> Int[Tensor, " n"]:
    """The square's next cell; it stays where the grid ends."""
    moves = torch.tensor(MOVES)[action]
    row = (cell // COLUMNS + moves[:, 0]).clamp(0, ROWS - 1)
    column = (cell % COLUMNS + moves[:, 1]).clamp(0, COLUMNS - 1)
    return row * COLUMNS + column


def recorded(count: int, noise: float, correlated: bool, generator: torch.Generator) -> Transitions:
    """So many transitions from cells drawn evenly."""
    cell = torch.randint(CELLS, (count,), generator=generator)
    action = torch.randint(ACTIONS, (count,), generator=generator)
    if correlated:
        follows = torch.rand(count, generator=generator) < FOLLOWS
        action = torch.where(follows, cell % ACTIONS, action)
    frames = [
        torch.cat([F.one_hot(place, CELLS), noise * torch.randint(2, (count, NOISY), generator=generator)], dim=1)
        for place in (cell, after(cell, action))
    ]
    return Transitions(before=frames[0].float(), after=frames[1].float(), action=action)


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


def rolled(frames: Float[Tensor, "b 16"], down: Int[Tensor, " b"], right: Int[Tensor, " b"]) -> Float[Tensor, "b 16"]:
    """The upper cells of each frame moved round both ways, its lowest row to the right."""
    row, column = torch.arange(ROWS), torch.arange(COLUMNS)
    rows = (row - down[:, None]) % ROWS
    columns = (column - right[:, None]) % COLUMNS
    places = torch.cat([(rows[:, :, None] * COLUMNS + columns[:, None]).flatten(1), CELLS + columns], dim=1)
    return frames.gather(1, places)


def network(inputs: int, outputs: int) -> nn.Sequential:
    """Two hidden layers."""
    return nn.Sequential(
        nn.Linear(inputs, WIDTH), nn.ReLU(), nn.Linear(WIDTH, WIDTH), nn.ReLU(), nn.Linear(WIDTH, outputs)
    )


class LatentActionModel(nn.Module):
    """An encoder of two frames into one of eight codes, and a decoder of the second from the first and the code."""

    def __init__(self) -> None:
        super().__init__()
        self.encoder = network(2 * (CELLS + NOISY), CODES.action_length)
        self.quantizer = VectorQuantizer(CODES)
        self.decoder = network(CELLS + NOISY + CODES.action_length, CELLS + NOISY)
        self.action = nn.Linear(CODES.action_length, ACTIONS)

    def infer(self, pairs: Transitions) -> tuple[Float[Tensor, "b d"], Float[Tensor, ""]]:
        """The quantised latent, and the commitment loss."""
        code, commitment = self.quantizer(self.encoder(torch.cat([pairs.before, pairs.after], dim=1)))
        return code, commitment

    def loss(self, pairs: Transitions, augmented: bool) -> Float[Tensor, ""]:
        """Squared error of the second frame, summed over its cells, and the commitment."""
        seen = shown = pairs
        if augmented:
            seen, shown = _rolled_pairs(pairs), _rolled_pairs(pairs)
        code, commitment = self.infer(seen)
        drawn = self.decoder(torch.cat([shown.before, code], dim=1))
        error: Tensor = (drawn - shown.after).square().sum(1).mean() + commitment
        return error


def _rolled_pairs(pairs: Transitions) -> Transitions:
    count = len(pairs.action)
    down, right = torch.randint(ROWS, (count,)), torch.randint(COLUMNS, (count,))
    return Transitions(
        before=rolled(pairs.before, down, right), after=rolled(pairs.after, down, right), action=pairs.action
    )


def _steps(parameters: Iterator[nn.Parameter], steps: int, loss: Callable[[], Tensor]) -> None:
    """So many steps of Adam, the rate falling to zero along a cosine."""
    optimizer = torch.optim.Adam(parameters, RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, steps)
    for _ in range(steps):
        optimizer.zero_grad()
        loss().backward()  # type: ignore[no-untyped-call]
        optimizer.step()
        schedule.step()


def trained(condition: Condition, seed: int, steps: int = STEPS) -> LatentActionModel:
    """A latent-action model of the transitions of a condition."""
    generator = torch.Generator().manual_seed(seed)
    data = recorded(TRANSITIONS, condition.noise, condition.correlated, generator)
    labelled = data.part(torch.arange(round(LABELLED * TRANSITIONS)))
    model = LatentActionModel().train()

    def loss() -> Tensor:
        total = model.loss(data.part(torch.randint(TRANSITIONS, (BATCH,), generator=generator)), condition.augmented)
        if condition.labelled:
            total = total + F.cross_entropy(model.action(model.infer(labelled)[0]), labelled.action)
        return total

    _steps(model.parameters(), steps, loss)
    return model.eval()


def losses_of(
    infer: Callable[[Transitions], Float[Tensor, "b d"]], noise: float, seed: int, steps: int = PROBE_STEPS
) -> tuple[float, float]:
    """The controllable and the stochastic loss of a latent; the latter is 1 where there is no noise.

    Args:
        infer: Gives the latent of each of some transitions.
        noise: Of these.
        seed: Of the transitions, and of the new decoder.
        steps: That it is fitted for.
    """
    generator = torch.Generator().manual_seed(1_000_000 + seed)
    known, asked = (recorded(TRANSITIONS, noise, False, generator) for _ in range(2))
    with torch.no_grad():
        latents = [infer(pairs).detach() for pairs in (known, asked)]
    inputs = [torch.cat([pairs.before, latent], dim=1) for pairs, latent in zip((known, asked), latents, strict=True)]
    decoder = network(inputs[0].shape[1], CELLS + NOISY)

    def loss() -> Tensor:
        index = torch.randint(TRANSITIONS, (BATCH,), generator=generator)
        error: Tensor = (decoder(inputs[0][index]) - known.after[index]).square().sum(1).mean()
        return error

    _steps(decoder.parameters(), steps, loss)
    with torch.no_grad():
        errors = (decoder(inputs[1]) - asked.after).square().mean(0)
    upper, lowest = least_errors(noise)
    return float(errors[:CELLS].sum()) / upper, float(errors[CELLS:].sum()) / lowest if noise else 1.0


def conditions() -> list[Condition]:
    """All rows of the table, in their order."""
    return [
        Condition(noise=noise, correlated=correlated, augmented=augmented, labelled=labelled)
        for noise, correlated, augmented, labelled in itertools.product((0.0, 1.0, 2.0), *[(False, True)] * 3)
    ]


def measured(condition: Condition, seed: int, steps: int, probe_steps: int) -> tuple[float, float]:
    """Both losses of a condition under one seed."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        model = trained(condition, seed, steps)
        return losses_of(lambda pairs: model.infer(pairs)[0], condition.noise, seed, probe_steps)


def half_width(values: Sequence[float]) -> float:
    """Half of the 95% interval of a mean, by Student's t; infinite for one value."""
    if len(values) < 2:
        return float("inf")
    quantile = {2: 12.706, 3: 4.303, 4: 3.182, 5: 2.776, 6: 2.571, 7: 2.447, 8: 2.365, 9: 2.306, 10: 2.262}
    return quantile.get(len(values), 1.96) * float(np.std(values, ddof=1)) / len(values) ** 0.5


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
    began, found = time.process_time(), dict[Condition, list[tuple[float, float]]]()
    for number, condition in enumerate(conditions(), 1):
        found[condition] = [measured(condition, seed, asked.steps, asked.probe_steps) for seed in range(asked.seeds)]
        spent = (time.process_time() - began) / 60
        sys.stderr.write(f"{number} of {len(conditions())} conditions, {spent:.1f} CPU minutes\n")
    if asked.json:
        rows = [{**vars(condition), "losses": values} for condition, values in found.items()]
        sys.stdout.write(json.dumps(rows) + "\n")
    else:
        sys.stdout.write(written(found) + "\n")


if __name__ == "__main__":
    main()
