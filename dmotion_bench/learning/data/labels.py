"""The label budget: the only door from training to ``labels/``, and the count of all that went through it.

What a run may ask for stands in ``label_request.py``. Unsupervised models are given demonstrations once they are
trained; those of ``Supervision.FEW`` are given the same demonstrations while they learn from video; supervised ones the
actions of a part of the training episodes. Budgets are nested: what a small one gives, a larger one of the same kind
gives, too, and of demonstrations a larger number or share whatever the kind. Whatever is handed out is counted, and the
count stands in the run, the report and the leaderboard.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, Shaped, UInt8

from dmotion_bench.actions import ActionSpec, Discrete, require_discrete
from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.learning.data.label_request import LabelRequest
from dmotion_bench.learning.data.streamed import StreamedTriplets
from dmotion_bench.learning.data.triplets import Triplets, TripletSet
from dmotion_bench.storage.readable import ReadableDataset

MOST_DEMONSTRATIONS = 4096
"""In memory as a whole: of data that are streamed there can be no more."""
HELD_BACK = 8
"""Of so many transitions in a budget, one is of the validation episodes, where a model learns from actions.

A budget of 2 to 15 holds back one. One of 1 has none to spare, so that the training validates with it, too.
"""

NOTHING_TO_DEMONSTRATE = (
    "the actions of this data set are not known, so there is nothing to demonstrate; train without labels "
    "(--labels none), or import the recording again with '--actions TOPIC'."
)


def _hand_in_hand(spec: Discrete, shown: set[int]) -> bool:
    """Whether each action of an agent always comes with the same action of another, and the reverse."""
    columns = spec.divided(np.array(sorted(shown))).T.tolist()
    return any(
        len(set(zip(one, other, strict=True))) == len(set(one)) == len(set(other))
        for one, other in itertools.combinations(columns, 2)
    )


@dataclass(frozen=True, kw_only=True)
class LabelledTriplets:
    """Triplets with labels from the budget; row i of ``triplets`` has ``actions[i]``."""

    triplets: TripletSet
    actions: Int[np.ndarray, " n"] | Float[np.ndarray, "n a"]


@dataclass(frozen=True, kw_only=True)
class DemonstrationFrames:
    """Labelled transitions: row i shows ``actions[i]``.

    Attributes:
        triplets, rows: Where their frames are.
        actions: What was done.
    """

    triplets: Triplets
    rows: Int[np.ndarray, " n"]
    actions: Int[np.ndarray, " n"] | Float[np.ndarray, "n a"]

    @property
    def frames(self) -> UInt8[np.ndarray, "n 3 h w 3"]:
        """The stored pixels; axis 1 is previous, current, next."""
        return self.triplets.gather(self.rows)


StoredActions = Int[np.ndarray, " s"] | Float[np.ndarray, "s a"]
"""Of an episode, one a step."""


def _held_back(amount: int) -> int:
    """How many of so many transitions are of the validation episodes."""
    return 0 if amount == 1 else max(1, amount // HELD_BACK)


class LabelBudget:
    """Hands out the labels that a run's budget allows, and counts them.

    Attributes:
        given: Number of labels handed out so far, by purpose.
    """

    def __init__(self, dataset: ReadableDataset, request: LabelRequest, seed: int) -> None:
        self.request, self.given = request, dict[str, int]()
        self._dataset, self._seed = dataset, seed

    @property
    def total(self) -> int:
        """All labels handed out so far."""
        return sum(self.given.values())

    def actions(self, triplets: TripletSet, purpose: Literal["training", "validation"]) -> LabelledTriplets:
        """The actions that the budget gives for training or for validation.

        Episodes come in an order that is the same for every model and seed: those of 10% are among those of 20%, and
        64 transitions are the first ones of that order. Of a number of transitions, an eighth is for validation, and at
        least one; of a single one none is (``HELD_BACK``).

        Raises:
            LabelsNotAvailable: The request is for demonstrations, or for nothing.
        """
        self._require_actions(purpose)
        episodes = np.unique(triplets.episode)
        order = np.random.default_rng(0).permutation(episodes)
        if self.request.kind == "share":
            chosen = order[: max(1, round(self.request.amount * len(order)))]
            rows = np.flatnonzero(np.isin(triplets.episode, chosen))
        else:
            held_back = _held_back(int(self.request.amount))
            wanted = held_back if purpose == "validation" else int(self.request.amount) - held_back
            rank = np.argsort(order)[np.searchsorted(episodes, triplets.episode)]
            rows = np.sort(np.argsort(rank, kind="stable")[:wanted])
        part = triplets.subset(rows)
        actions = self._of_each(part)
        self.given[purpose] = len(part)
        return LabelledTriplets(triplets=part, actions=actions)

    def streamed_actions(self, triplets: StreamedTriplets) -> tuple[StreamedTriplets, Callable[[int], StoredActions]]:
        """As ``actions`` for training: the triplets that the budget pays for, and what reads an episode's actions.

        Raises:
            LabelsNotAvailable: The request is for demonstrations, or for nothing; or the labels are not there.
        """
        self._require_actions("training")
        order = np.random.default_rng(0).permutation(len(triplets.episodes))
        counts, paid = triplets.counts[order], np.zeros_like(triplets.counts)
        if self.request.kind == "share":
            chosen = max(1, round(self.request.amount * len(order)))
            paid[order[:chosen]] = counts[:chosen]
        else:
            wanted = int(self.request.amount) - _held_back(int(self.request.amount))
            paid[order] = np.clip(wanted - (np.cumsum(counts) - counts), 0, counts)
        part = triplets.first(paid)
        self._dataset.states(int(part.episodes[0]))  # what is missing is said before the work
        self.given["training"] = len(part)
        return part, lambda episode: self._dataset.states(episode).actions

    def _require_actions(self, purpose: str) -> None:
        if self.request.kind not in ("share", "count"):
            raise LabelsNotAvailable(f"the budget {self.request} has no actions for {purpose}; ask for --labels 100%.")

    def demonstrations(self, triplets: Triplets, draw: int = 0) -> DemonstrationFrames:
        """As many transitions as the budget has, drawn from triplets in which nothing is pushed.

        Of ``K-shot`` there are so many of each action, or an error is raised. Of ``K-shot-per-agent`` a transition is
        taken if it shows an action of an agent that has been shown fewer than K times, and one more if the agents'
        actions could not be told apart by then. A number of transitions is given as far as there are so many, and a
        share as if it were that number, rounded. Once all are given in which nothing is pushed, the others follow: so
        ``all`` is all, unless something is pushed in every transition.

        Args:
            triplets: Where they are drawn from: the training's.
            draw: Another number gives another draw, for the spread over draws.

        Raises:
            LabelsNotAvailable: The request is for nothing, an action does not occur often enough, something is pushed
                in every transition, or the triplets are streamed and the demonstrations too many for the memory.
        """
        if self.request.kind == "none":
            raise LabelsNotAvailable(f"the budget {self.request} has no demonstrations; ask for --labels one-shot.")
        spec = self._dataset.spec.actions
        if spec is None:
            raise LabelsNotAvailable(NOTHING_TO_DEMONSTRATE)
        self._require_room(triplets, self._fewest(len(triplets), spec))
        order = triplets.shuffled(np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(draw,))))
        if self.request.kind in ("count", "share"):
            rows, actions = self._first_unpushed(triplets, order, self._number(len(triplets)))
        else:
            discrete = require_discrete(spec, f"the budget {self.request}")
            per_agent = self.request.kind == "shots-per-agent"
            rows, actions = (self._of_each_agent if per_agent else self._of_each_action)(triplets, order, discrete)
        self._require_room(triplets, len(rows))
        self.given["demonstrations"] = self.given.get("demonstrations", 0) + len(rows)
        return DemonstrationFrames(triplets=triplets, rows=rows, actions=actions)

    def _fewest(self, there: int, spec: ActionSpec) -> int:
        """The fewest demonstrations that the request can come to, where so many transitions are there."""
        amount = int(self.request.amount)
        if self.request.kind == "shots":
            return amount * len(require_discrete(spec, f"the budget {self.request}"))
        return amount if self.request.kind == "shots-per-agent" else min(self._number(there), there)

    def _require_room(self, triplets: Triplets, demonstrations: int) -> None:
        if isinstance(triplets, StreamedTriplets) and demonstrations > MOST_DEMONSTRATIONS:
            raise LabelsNotAvailable(
                f"{demonstrations:,} demonstrations of data that are streamed are too many for the memory; ask for at "
                f"most --labels {MOST_DEMONSTRATIONS}, or let the training use the frame cache (--no-stream)."
            )

    def _number(self, there: int) -> int:
        """The transitions that a number or a share asks for, of so many."""
        amount = self.request.amount
        return max(1, round(amount * there)) if self.request.kind == "share" else int(amount)

    def _of_each_action(
        self, triplets: Triplets, order: Iterator[int], spec: Discrete
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """The first rows of each action in which nothing is pushed, by action."""
        wanted = int(self.request.amount)
        missing = dict.fromkeys(range(len(spec)), wanted)
        found: list[tuple[int, int]] = []
        for row, action in self._unpushed(triplets, order):
            if missing[int(action)]:
                missing[int(action)] -= 1
                found.append((int(action), row))
            if not any(missing.values()):
                break
        self._require_enough([spec.names[action] for action, count in missing.items() if count], wanted)
        actions, rows = zip(*sorted(found, key=lambda one: one[0]), strict=True)
        return np.asarray(rows), np.asarray(actions)

    def _of_each_agent(
        self, triplets: Triplets, order: Iterator[int], spec: Discrete
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"]]:
        """The first rows that show something new of an agent and in which nothing is pushed, by action.

        Where two agents' actions go hand in hand in all of them, one more is taken: nothing would say whose is whose.
        """
        wanted = int(self.request.amount)
        missing = [np.full(len(names), wanted) for names in spec.parts]
        found: list[tuple[int, int]] = []
        for row, action in self._unpushed(triplets, order):
            parts, complete = spec.divided(action).tolist(), all((left <= 0).all() for left in missing)
            known = {one for one, _ in found}
            if complete and not _hand_in_hand(spec, known):
                break
            if any(left[part] > 0 for left, part in zip(missing, parts, strict=True)) or (
                complete and int(action) not in known
            ):
                found.append((int(action), row))
                for left, part in zip(missing, parts, strict=True):
                    left[part] -= 1
        lacking = [
            f"{name} of agent {agent}"
            for agent, (names, left) in enumerate(zip(spec.parts, missing, strict=True))
            for name, count in zip(names, left.tolist(), strict=True)
            if count > 0
        ]
        self._require_enough(lacking, wanted)
        actions, rows = zip(*sorted(found, key=lambda one: one[0]), strict=True)
        return np.asarray(rows), np.asarray(actions)

    def _require_enough(self, lacking: list[str], wanted: int) -> None:
        if lacking:
            held, instead = "no demonstration", "ask for a number of labels ('--labels 64')"
            if wanted > 1:
                held, instead = f"fewer than {wanted} demonstrations", "ask for fewer ('--labels one-shot')"
            raise LabelsNotAvailable(
                f"the training episodes hold {held} of {', '.join(lacking)}; {instead}, or record more episodes."
            )

    def _first_unpushed(
        self, triplets: Triplets, order: Iterator[int], wanted: int
    ) -> tuple[Int[np.ndarray, " m"], Int[np.ndarray, " m"] | Float[np.ndarray, "m a"]]:
        """The first rows in which nothing is pushed; where there are too few, then the first of the others."""
        found: list[tuple[int, Shaped[np.ndarray, "..."]]] = []
        others: list[tuple[int, Shaped[np.ndarray, "..."]]] = []
        for row, action, pushed in self._labelled(triplets, order):
            (others if pushed else found).append((row, action))
            if len(found) == wanted:
                break
        if not found:
            raise LabelsNotAvailable(
                "something is pushed in every transition of the training episodes, so there is no demonstration; "
                "record more episodes."
            )
        rows, actions = zip(*(found + others)[:wanted], strict=True)
        return np.asarray(rows), np.stack(actions)

    def _unpushed(self, triplets: Triplets, order: Iterator[int]) -> Iterator[tuple[int, Shaped[np.ndarray, "..."]]]:
        """The rows in which nothing is pushed and their actions, one by one; only their episodes are opened."""
        return ((row, action) for row, action, pushed in self._labelled(triplets, order) if not pushed)

    def _labelled(
        self, triplets: Triplets, order: Iterator[int]
    ) -> Iterator[tuple[int, Shaped[np.ndarray, "..."], bool]]:
        """The rows, their actions, and whether something is pushed, one by one; only their episodes are opened."""
        known: dict[int, tuple[Shaped[np.ndarray, "t ..."], Bool[np.ndarray, " t"]]] = {}
        for row in order:
            episode, step = (int(place[0]) for place in triplets.places(np.array([row])))
            if episode not in known:
                states = self._dataset.states(episode)
                known[episode] = states.actions, states.pushed
            actions, pushed = known[episode]
            yield row, np.asarray(actions[step]), bool(pushed[step])

    def _of_each(self, triplets: TripletSet) -> Int[np.ndarray, " n"] | Float[np.ndarray, "n a"]:
        spec = self._dataset.spec.actions
        kind, shape = (np.dtype(np.int64), ()) if spec is None else (spec.dtype, spec.shape)
        values = np.zeros((len(triplets), *shape), kind)
        for episode in np.unique(triplets.episode).tolist():
            rows = np.flatnonzero(triplets.episode == episode)
            values[rows] = self._dataset.states(episode).actions[triplets.step[rows]]
        return values
