"""What a model of video learns of actions afterwards: which of its latent actions an action is.

For discrete actions this is a table: the mean latent action of each action's demonstrations, which is the least-squares
optimum of any map from an action to a latent one. Unlabelled video can correct it (``settle``). For continuous actions
it is a ridge regression (Hoerl, Kennard 1970) from the normalised action; the regularisation is the one with the least
leave-one-out error, which has a closed form (Allen's PRESS, 1974).

Where an action says what several agents do (``Discrete.joint``), each agent has a table of its own, so an agent's
action has to be demonstrated once, whatever the others do meanwhile.
"""

from __future__ import annotations

import itertools

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import InvalidSetting, ModelContractBroken
from dmotion_bench.learning.action_encoding import ActionEncoding, Actions

PENALTIES = torch.logspace(-6, 3, 37, dtype=torch.float64)
"""The regularisations that are tried, per demonstration; the normalised numbers of an action are at most 1."""

ROUNDS = 100
"""k-means ends after so many at the latest."""

ALIKE = 1e-9
"""Errors that differ by a smaller share are equal."""


class ActionToLatent(nn.Module):
    """A map from actions to latent actions, kept in one buffer, so that a checkpoint keeps it.

    Args:
        spec: Of the actions; None, if they are not known, stands for a map that cannot be asked.
        width: Length of a latent action.
        unaligned: The latent action of every action before ``fit``; zeros if left out. A discrete action that no
            demonstration shows keeps it: no motion in DMotion, the centre of the latent actions in others.

    Attributes:
        rows: A row for each discrete action; or the latent action of a continuous action's middle, and how it changes
            with each of the action's normalised numbers.
        shown: Which discrete actions the demonstrations of the last ``fit`` were of.
    """

    rows: Tensor
    before: Tensor
    shown: Tensor

    def __init__(self, spec: ActionSpec | None, width: int, unaligned: Float[Tensor, " d"] | None = None) -> None:
        super().__init__()
        self.spec, self.encoding = spec, ActionEncoding(spec)
        start = torch.zeros(1, width) if unaligned is None else unaligned[None]
        if isinstance(spec, Continuous):
            rows = nn.functional.pad(start, (0, 0, 0, spec.width))
        else:
            rows = start.repeat_interleave(self.encoding.width, 0)
        self.register_buffer("rows", rows)
        self.register_buffer("before", rows.clone(), persistent=False)
        self.register_buffer("shown", torch.zeros(len(rows), dtype=torch.bool), persistent=False)

    @torch.no_grad()
    def fit(self, latent: Float[Tensor, "n d"], action: Actions) -> None:
        """Learn from these demonstrations alone, whatever was learned before (see ``unaligned``).

        Args:
            latent: The latent action that the model reads off each demonstration.
            action: What was done in it.

        Raises:
            ModelContractBroken: The latent actions are not of the map's width, one a demonstration.
        """
        wanted = (len(action), self.rows.shape[1])
        if tuple(latent.shape) != wanted:  # torch would repeat a single number as often as it takes
            raise ModelContractBroken(
                f"ActionToLatent.fit was given latent actions of the shape {tuple(latent.shape)}; of {len(action)} "
                f"demonstrations it takes {wanted}, as the width that it was made with says."
            )
        if isinstance(self.spec, Continuous):
            self.rows.copy_(ridge(self.encoding(action), latent))
            return
        self.rows.copy_(self.before)
        for number in range(len(self.rows)):
            of_action = latent[action == number]
            self.shown[number] = len(of_action) > 0
            if self.shown[number]:
                self.rows[number] = of_action.float().mean(0)

    @torch.no_grad()
    def settle(self, latent: Float[Tensor, "n d"]) -> None:
        """Move the row of each discrete action that ``fit`` was shown to the middle of the latent actions around it.

        This is k-means, begun at the demonstrations. A latent action that is farther from every row than half the way
        between the two nearest rows belongs to none: it may be of an action that no demonstration shows, or of an
        agent that met an edge. With fewer than two demonstrated actions nothing says how far that is, and the table
        stays.

        Args:
            latent: Latent actions whose action is not known.
        """
        middles, points = self.rows[self.shown].double(), latent.double()
        belongs = torch.full((len(points),), -1, device=points.device)
        for _ in range(ROUNDS if len(middles) > 1 else 0):
            distance, nearest = torch.cdist(points, middles).min(-1)
            now = torch.where(distance < torch.pdist(middles).min() / 2, nearest, -1)
            if torch.equal(now, belongs):
                break
            belongs = now
            for number in range(len(middles)):
                if (around := belongs == number).any():
                    middles[number] = points[around].mean(0)
        self.rows[self.shown] = middles.to(self.rows)

    def forward(self, action: Actions) -> Float[Tensor, "b d"]:
        if isinstance(self.spec, Continuous):
            changes = self.encoding(action)[..., None] * self.rows[1:]
            found: Tensor = self.rows[0] + changes.sum(-2)
            return found
        return self.rows[action]


class JointActionToLatent(nn.Module):
    """A table for each agent, for a model that has a latent action for each but does not know whose is whose.

    The demonstrations decide it. Of all ways to give the model's latent actions to the agents, the one is taken in
    which they vary least within the agents' actions, each as a share of its whole variance.

    Args:
        spec: Of the joint actions; None, if they are not known, stands for tables that cannot be asked.
        agents: How many there are.
        width: Length of the latent action of one agent.
        unaligned: The latent action of every action before ``fit``; zeros if left out.

    Attributes:
        tables: An ``ActionToLatent`` for each agent.
        order: Which of the model's latent actions is whose: that of agent k is number ``order[k]``.

    Raises:
        InvalidSetting: The actions are not those of so many agents.
    """

    order: Tensor

    def __init__(
        self, spec: ActionSpec | None, agents: int, width: int, unaligned: Float[Tensor, " d"] | None = None
    ) -> None:
        super().__init__()
        if isinstance(spec, Continuous) or (spec is not None and len(spec.parts) != agents):
            many = 1 if isinstance(spec, Continuous) else len(spec.parts)
            found = "continuous" if isinstance(spec, Continuous) else f"of {many} agent" + "s" * (many > 1)
            raise InvalidSetting(
                f"the model has {agents} agents, and the actions of its data set are {found}. It needs joint actions "
                f"of {agents} agents, such as 'up/left'; take such a data set, or --set agents={many}."
            )
        self.spec, self.agents = spec, agents
        parts = [None] * agents if spec is None else [Discrete(names) for names in spec.parts]
        self.tables = nn.ModuleList(ActionToLatent(part, width, unaligned) for part in parts)
        self.register_buffer("order", torch.arange(agents))

    @torch.no_grad()
    def fit(self, latent: Float[Tensor, "n k d"], action: Int[Tensor, " n"]) -> None:
        """Learn from demonstrations whose latent actions are whose, and which of them each agent's actions are.

        An agent's action without demonstrations keeps its unaligned row. Where the demonstrations cannot decide, as
        when no agent's action is shown twice, the model's own order stands.

        Args:
            latent: The latent actions that the model reads off each demonstration, in its own order.
            action: What was done in it, jointly.
        """
        parts = self._parts(action)
        unexplained = torch.stack(
            [
                torch.stack([_unexplained(latent[:, place], part) for place in range(self.agents)])
                for part in parts.unbind(-1)
            ]
        )
        ways = list(itertools.permutations(range(self.agents)))
        best = min(ways, key=lambda way: sum(float(unexplained[agent, place]) for agent, place in enumerate(way)))
        self.order.copy_(torch.tensor(best))
        for agent, table in enumerate(self.tables):
            assert isinstance(table, ActionToLatent)
            table.fit(latent[:, self.order[agent]], parts[:, agent])

    def forward(self, action: Int[Tensor, " b"]) -> Float[Tensor, "b k d"]:
        """The latent actions of joint actions, in the order of the agents."""
        parts = self._parts(action)
        return torch.stack([table(part) for table, part in zip(self.tables, parts.unbind(-1), strict=True)], dim=1)

    def _parts(self, action: Int[Tensor, " b"]) -> Int[Tensor, "b k"]:
        sizes = () if self.spec is None else tuple(map(len, self.spec.parts))
        return torch.stack(torch.unravel_index(action, sizes), dim=-1)


def tables_of(model: nn.Module) -> list[ActionToLatent]:
    """Where a model keeps what labels taught it: one map, or one for each agent; none if it keeps that otherwise."""
    return [module for module in model.modules() if isinstance(module, ActionToLatent)]


def _unexplained(latent: Float[Tensor, "n d"], action: Int[Tensor, " n"]) -> Float[Tensor, ""]:
    """Variance within an action as a share of the whole variance; 0 where nothing varies."""
    known, index = torch.unique(action, return_inverse=True)
    latent = latent.double()
    means = torch.stack([latent[index == one].mean(0) for one in range(len(known))])
    within, whole = (latent - means[index]).square().sum(), (latent - latent.mean(0)).square().sum()
    return within / whole if whole > 0 else whole


def ridge(inputs: Float[Tensor, "n a"], outputs: Float[Tensor, "n d"]) -> Float[Tensor, "a+1 d"]:
    """The regression of ``outputs`` on ``inputs`` with the least leave-one-out error; the first row is the intercept.

    The intercept is not penalised. With one demonstration it is all that there is.
    """
    known, wanted = inputs.double().cpu(), outputs.double().cpu()
    offset, level = known.mean(0), wanted.mean(0)
    known, wanted = known - offset, wanted - level
    values, directions = _principal(known)
    places = known @ directions
    along = places.T @ wanted
    shrunk = 1 / (values[:, None] + PENALTIES * len(known))
    errors = _left_out(places, along, wanted, shrunk)
    # of equal ones the largest penalty: of two rows each tells the other the same with any
    least = min(errors) * (1 + ALIKE)
    best = max((place for place, error in enumerate(errors) if error <= least), default=-1)  # none if it is no number
    slopes = directions @ (shrunk[:, best, None] * along)
    found = torch.cat([(level - offset @ slopes)[None], slopes])
    return found.to(outputs)


def _principal(known: Float[Tensor, "n a"]) -> tuple[Float[Tensor, " m"], Float[Tensor, "a m"]]:
    """The squared singular values of rows and their directions, from the smaller of the two matrices that tell them."""
    if len(known) < known.shape[1]:
        _, values, directions = torch.linalg.svd(known, full_matrices=False)
        return values.square(), directions.T
    values, directions = torch.linalg.eigh(known.T @ known)
    return values.clamp(min=0), directions


def _left_out(
    places: Float[Tensor, "n m"],
    along: Float[Tensor, "m d"],
    wanted: Float[Tensor, "n d"],
    shrunk: Float[Tensor, "m p"],
) -> list[float]:
    """The summed squared error of each row by the regression of all others, for each penalty."""
    leverage = 1 / len(places) + places.square() @ shrunk
    held_out = (1 - leverage).clamp(min=1e-9)
    summed = []
    for place, factor in enumerate(shrunk.T):
        residual = wanted - places @ (factor[:, None] * along)
        summed.append(float((residual / held_out[:, place, None]).square().sum()))
    return summed
