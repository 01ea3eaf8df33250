"""The JEPA on a task of its own paper, *Two-Room*: does our program reach goals where the authors' does?

Maes et al. (2026) plan with LeWorldModel in several worlds; this is the one that fits a laptop. A red dot stands in one
of two rooms, between which there is one door. An action moves it by up to 5 px of 224 along each axis; walls stop it.
The model learns from 10,000 episodes of a script that goes towards a goal, by way of the door if need be, with noise of
twice the size of its actions. Then a recorded state is the start, the state 25 steps later in the same recording the
goal, and within 50 steps the dot must come within 16 px of it. The planner imagines blocks of five actions: the
cross-entropy method with 300 samples, 30 iterations and 30 elites looks for the five blocks after which the embedding
is nearest to the goal's, and carries out all five before it looks again.

Model and loss are those of ``baselines/jepa.py``. Layout, script and protocol are those of the authors' environment
(github.com/galilai-group/stable-worldmodel, ``envs/two_room`` and ``scripts/plan``), written anew. A linear probe says
as well how exactly an embedding holds the dot's place. Settled otherwise:

- Frames have 64 x 64 pixels instead of 224 x 224, and the networks differ as ``baselines/jepa.py`` says.
- A prediction begins from one frame or two, at random, where theirs begins from one, two or three.
- Of the sequences that the planner drew, the best is carried out, theirs carries out the last mean.
- Training is much shorter, and the rate falls along a cosine.

``python -m baselines.published.lewm_two_room`` trains one model for each seed and prints the table.
"""

from __future__ import annotations

import argparse
import json
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from typing import Final

import numpy as np
import torch
import torch.nn.functional as F
from einops import rearrange
from jaxtyping import Bool, Float, Int
from torch import Tensor

from baselines.jepa import JepaConfig, LatentWorldModel
from baselines.published.descent import train
from dmotion_bench.actions import Continuous
from dmotion_bench.learning.hardware.memory import keep_freed_memory
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ModelInputs, TripletBatch
from dmotion_bench.planning.dynamics.base import Observation
from dmotion_bench.planning.dynamics.model import ModelDynamics
from dmotion_bench.planning.objectives.feature import FeatureEvaluator
from dmotion_bench.planning.solvers.base import PlanContext
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.scoring.statistics import wilson

SIDE, FRAME = 224, 64
BORDER, LINE = 14, 4
WALL, HALF_WALL = 112, 5
DOOR, HALF_DOOR, MARGIN = 49, 14, 1.75
RADIUS, SPEED, BOUNCE = 7, 5, 0.5
NEAR_DOOR, REACHED, NOISE = 10.5, 16.0, 2.0
BLOCK, AWAY, BUDGET = 5, 25, 50
EPISODES, LENGTH, TASKS = 10_000, 100, 200
BATCH, STEPS, RATE = 128, 3_000, 1e-3
PROBED, AT_ONCE = 5_000, 4_096
TEST, DEVELOPMENT = 1, 2
NUMBERS: Final = tuple(f"{axis}{step}" for step in range(BLOCK) for axis in "xy")
ACTIONS: Final = Continuous(
    names=NUMBERS, low=(-1.0,) * len(NUMBERS), high=(1.0,) * len(NUMBERS), units=("",) * len(NUMBERS)
)
PLANNER: Final = CrossEntropy(
    samples=300, horizon=AWAY // BLOCK, iterations=30, elites=30, cost_at="last", initial_std=1.0
)
PUBLISHED: Final = {"LeWorldModel": 0.87, "PLDM": 0.97, "DINO-WM": 1.0}
"""Goals reached, from the documentation of the authors' environment; PLDM and DINO-WM as measured by them."""


@dataclass(frozen=True, kw_only=True)
class Episodes:
    """Recordings of different lengths, one beside the other; what follows an episode's end means nothing.

    Attributes:
        places: x and y of the dot before and after each action, in px of 224.
        actions: In [-1, 1].
        lengths: Actions in each episode.
    """

    places: Float[Tensor, "n s 2"]
    actions: Float[Tensor, "n t 2"]
    lengths: Int[Tensor, " n"]

    def moments(self, ahead: int) -> tuple[Int[Tensor, " m"], Int[Tensor, " m"]]:
        """All moments that the recording goes on from for so many steps: their episodes, and their steps in them."""
        steps = torch.arange(self.actions.shape[1])
        episode, step = (steps + ahead <= self.lengths[:, None]).nonzero(as_tuple=True)
        return episode, step


def after(place: Float[Tensor, "n 2"], action: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """Where the dot is one action later."""
    wanted = (place + SPEED * action.clamp(-1, 1)).clamp(BORDER + RADIUS, SIDE - BORDER - RADIUS)
    x, y = wanted.unbind(1)
    left, gap = place[:, 0] < WALL, HALF_WALL + RADIUS
    touching = torch.where(left, x > WALL - gap, x < WALL + gap)
    through = (y - DOOR).abs() <= HALF_DOOR + MARGIN
    stopped = torch.where(left, WALL - gap - BOUNCE, WALL + gap + BOUNCE)
    return torch.stack([torch.where(touching & ~through, stopped, x), y], 1)


def drawn_evenly(count: int, generator: torch.Generator) -> Float[Tensor, "n 2"]:
    """Places between the borders."""
    return BORDER + (SIDE - 2 * BORDER - 1) * torch.rand(count, 2, generator=generator)


def towards(place: Float[Tensor, "n 2"], goal: Float[Tensor, "n 2"]) -> Float[Tensor, "n 2"]:
    """The script's direction, of length 1: to the goal, or to the door, until it is near, if the goal lies beyond."""
    door = torch.tensor([float(WALL), float(DOOR)])
    beyond = (place[:, 0] < WALL) != (goal[:, 0] < WALL)
    by_door = beyond & ((door - place).norm(dim=1) > NEAR_DOOR)
    return F.normalize(torch.where(by_door[:, None], door, goal) - place, dim=1)


def recorded(count: int, generator: torch.Generator) -> Episodes:
    """So many episodes of the script with noise; each ends at its goal, or after 100 actions."""
    start, goal = drawn_evenly(count, generator), drawn_evenly(count, generator)
    while (inside := (start[:, 0] - WALL).abs() <= HALF_WALL + RADIUS).any():
        start[inside] = drawn_evenly(int(inside.sum()), generator)
    places, actions, lengths = [start], [], torch.zeros(count, dtype=torch.int64)
    going = torch.ones(count, dtype=torch.bool)
    for _ in range(LENGTH):
        noise = NOISE * torch.randn(count, 2, generator=generator)
        actions.append((towards(places[-1], goal) + noise).clamp(-1, 1))
        places.append(after(places[-1], actions[-1]))
        lengths += going
        going &= (places[-1] - goal).norm(dim=1) >= REACHED
    return Episodes(places=torch.stack(places, 1), actions=torch.stack(actions, 1), lengths=lengths)


def rooms() -> Float[Tensor, "1 64 64"]:
    """The rooms without the dot, from -1, black, to 1, white; edges are averages of the pixels of 224."""
    rows, columns = torch.meshgrid(torch.arange(SIDE), torch.arange(SIDE), indexing="ij")
    black = ((columns - WALL).abs() <= HALF_WALL) & ((rows - DOOR).abs() > HALF_DOOR)
    for line in (rows, columns):
        black |= (line >= BORDER - LINE) & (line < BORDER)
        black |= (line >= SIDE - BORDER) & (line < SIDE - BORDER + LINE)
    return F.interpolate(1 - 2 * black.float()[None, None], size=(FRAME, FRAME), mode="area")[0]


def drawn(places: Float[Tensor, "n 2"], empty: Float[Tensor, "1 64 64"]) -> Float[Tensor, "n 3 64 64"]:
    """The picture of each place: a red dot that fades outwards, in [-1, 1]."""
    centres = (torch.arange(FRAME) + 0.5) * (SIDE / FRAME) - 0.5
    across, down = torch.exp(-(centres - places[:, :, None]).square() / (2 * RADIUS**2)).unbind(1)
    share = (down[:, :, None] * across[:, None, :])[:, None]
    red = torch.tensor([1.0, -1.0, -1.0])[:, None, None]
    return empty + share * (red - empty)


class TwoRoomModel(LatentWorldModel):
    """The benchmark's JEPA; what a plan comes to is judged by the last embedding, as in the paper."""

    def __init__(self) -> None:
        super().__init__(JepaConfig(), ModelInputs(height=FRAME, width=FRAME, actions=ACTIONS))

    def features(self, state: tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]) -> Float[Tensor, "b d"]:
        """The last embedding."""
        return self.embedding(state)


def trained(seed: int, steps: int, data: Episodes) -> TwoRoomModel:
    """The model after so many batches of the recording."""
    torch.manual_seed(seed)
    model, empty, (episodes, moments) = TwoRoomModel(), rooms(), data.moments(BLOCK)

    def batch() -> TripletBatch:
        chosen = torch.randint(len(moments), (BATCH,))
        episode, moment = episodes[chosen], moments[chosen]
        alone = (moment < BLOCK) | (torch.rand(BATCH) < 0.5)
        times = (torch.where(alone, moment, moment - BLOCK), moment, moment + BLOCK)
        previous, current, following = (drawn(data.places[episode, time], empty) for time in times)
        action = data.actions[episode[:, None], moment[:, None] + torch.arange(BLOCK)].flatten(1)
        return TripletBatch(previous=previous, current=current, next=following, action=action)

    train(model, model.phases()[0], batch, steps=steps, rate=RATE)
    return model.eval()


@dataclass(frozen=True, kw_only=True)
class Tasks:
    """Where the dot starts, and where it is to come."""

    start: Float[Tensor, "n 2"]
    goal: Float[Tensor, "n 2"]


def tasks_of(data: Episodes, count: int, generator: torch.Generator) -> Tasks:
    """Moments of the recording, each once, and the places 25 steps later."""
    episodes, moments = data.moments(AWAY)
    chosen = torch.randperm(len(moments), generator=generator)[:count]
    episode, moment = episodes[chosen], moments[chosen]
    return Tasks(start=data.places[episode, moment], goal=data.places[episode, moment + AWAY])


Choose = Callable[[Float[Tensor, "m 2"], Int[Tensor, " m"], int], Float[Tensor, "m t 2"]]
"""What is done next, given places, the numbers of their tasks, and the steps that have been taken."""


def solved(tasks: Tasks, choose: Choose) -> Bool[Tensor, " n"]:
    """Which goals are reached within 50 steps."""
    place, reached, step = tasks.start.clone(), torch.zeros(len(tasks.start), dtype=torch.bool), 0
    while step < BUDGET and not reached.all():
        going = (~reached).nonzero()[:, 0]
        for action in choose(place[going], going, step)[:, : BUDGET - step].unbind(1):
            place[going] = after(place[going], action)
            reached[going] |= (place[going] - tasks.goal[going]).norm(dim=1) < REACHED
            step += 1
    return reached


def planned(model: TwoRoomModel, tasks: Tasks, seed: int) -> Choose:
    """Five blocks of actions at a time, as the model imagines them to end nearest to the goal."""
    dynamics, empty = ModelDynamics(model, at_once=AT_ONCE), rooms()

    def pictures(places: Float[Tensor, "m 2"]) -> np.ndarray:
        return to_pixels(drawn(places, empty)).numpy()

    def choose(places: Float[Tensor, "m 2"], which: Int[Tensor, " m"], step: int) -> Float[Tensor, "m t 2"]:
        seen, goals = pictures(places), pictures(tasks.goal[which])
        context = PlanContext(
            observation=Observation(previous=seen, current=seen, goals=goals, step=step),
            generators=tuple(np.random.default_rng((seed, task, step)) for task in which.tolist()),
            blocked=np.zeros((len(places), 0), bool),
        )
        best = PLANNER.plan(dynamics, FeatureEvaluator(goals), context).candidates[:, 0]
        return rearrange(torch.from_numpy(best).float(), "b t (s xy) -> b (t s) xy", xy=2)

    return choose


def idle(places: Float[Tensor, "m 2"], which: Int[Tensor, " m"], step: int) -> Float[Tensor, "m t 2"]:
    """Nothing."""
    return torch.zeros(len(places), BUDGET, 2)


def at_random(seed: int) -> Choose:
    """Any actions."""
    generator = torch.Generator().manual_seed(seed)
    return lambda places, which, step: 2 * torch.rand(len(places), BUDGET, 2, generator=generator) - 1


def scripted(tasks: Tasks) -> Choose:
    """The recording's script, without its noise."""
    return lambda places, which, step: towards(places, tasks.goal[which])[:, None]


@torch.no_grad()
def place_correlation(model: TwoRoomModel, seen: Episodes, held_out: Episodes) -> float:
    """Pearson's r of places of unseen episodes and a linear map's of their embeddings, the mean of x and y."""
    empty = rooms()

    def probed(data: Episodes) -> tuple[Float[Tensor, "n d"], Float[Tensor, "n 2"]]:
        episode, moment = data.moments(0)
        chosen = torch.linspace(0, len(moment) - 1, min(PROBED, len(moment))).long()
        places = data.places[episode[chosen], moment[chosen]]
        embedded = torch.cat([model.embed(drawn(some, empty)) for some in torch.split(places, BATCH)])
        return torch.cat([embedded, torch.ones(len(embedded), 1)], 1).double(), places.double()

    known, where = probed(seen)
    weights = torch.linalg.lstsq(known, where, driver="gelsd").solution
    embedded, places = probed(held_out)
    found = embedded @ weights
    each = [torch.corrcoef(torch.stack([found[:, axis], places[:, axis]]))[0, 1] for axis in (0, 1)]
    return float(torch.stack(each).mean())


@dataclass(frozen=True, kw_only=True)
class Row:
    """One line of the table: who acted, which share of the goals was reached, its 95% interval, and the probe's r."""

    who: str
    reached: float
    interval: tuple[float, float]
    probe: float | None = None


def row(who: str, reached: Bool[Tensor, " n"], probe: float | None = None) -> Row:
    """Of tasks whose outcome is known."""
    share = float(reached.double().mean())
    return Row(who=who, reached=share, interval=wilson(share, len(reached)), probe=probe)


def written(rows: Sequence[Row]) -> str:
    """The table in Markdown, the published shares below."""
    lines = ["| who acts | goals reached | 95% interval | probe of the place, r |", "|---|---|---|---|"]
    for one in rows:
        low, high = one.interval
        probe = "" if one.probe is None else f"{one.probe:.4f}"
        lines.append(f"| {one.who} | {100 * one.reached:.1f}% | {100 * low:.1f} to {100 * high:.1f}% | {probe} |")
    lines += [f"| {name}, published | {100 * share:.0f}% | | |" for name, share in PUBLISHED.items()]
    return "\n".join(lines)


def main(arguments: Sequence[str] | None = None) -> None:
    """Train, plan and print."""
    parser = argparse.ArgumentParser(prog="python -m baselines.published.lewm_two_room", description=__doc__)
    parser.formatter_class = argparse.RawDescriptionHelpFormatter
    parser.add_argument("--seeds", type=int, default=1, help="trainings, of seeds 0, 1 ...")
    parser.add_argument("--steps", type=int, default=STEPS, help="batches of 128 in a training")
    parser.add_argument("--episodes", type=int, default=EPISODES, help="to learn from")
    parser.add_argument("--tasks", type=int, default=TASKS, help="to plan")
    parser.add_argument("--development", action="store_true", help="plan the tasks on which settings may be chosen")
    parser.add_argument("--json", action="store_true", help="print every value as one JSON object")
    given = parser.parse_args(arguments)
    if min(given.seeds, given.steps, given.episodes, given.tasks) < 1:
        parser.error("--seeds, --steps, --episodes and --tasks must be 1 or more.")
    keep_freed_memory()
    began = time.process_time()
    source = torch.Generator().manual_seed(DEVELOPMENT if given.development else TEST)
    held_out = recorded(max(given.tasks, 20), source)
    tasks = tasks_of(held_out, given.tasks, source)
    rows = [row("nobody", solved(tasks, idle)), row("random actions", solved(tasks, at_random(0)))]
    rows.append(row("the script", solved(tasks, scripted(tasks))))
    for seed in range(given.seeds):
        seen = recorded(given.episodes, torch.Generator().manual_seed(1_000 + seed))
        model = trained(seed, given.steps, seen)
        reached = solved(tasks, planned(model, tasks, seed))
        rows.append(row(f"ours, seed {seed}", reached, place_correlation(model, seen, held_out)))
        sys.stderr.write(f"seed {seed}: {(time.process_time() - began) / 60:.1f} CPU minutes\n")
    if given.json:
        sys.stdout.write(json.dumps([asdict(one) for one in rows]) + "\n")
    else:
        sys.stdout.write(written(rows) + "\n")


if __name__ == "__main__":
    main()
