"""The label budget: the only door from training to ``labels/``, and the count of all that went through it.

A run asks for a budget (``none``, ``one-shot``, ``5-shot``, ``10%``, ``100%``). Unsupervised models are given a few
demonstrations per action, once they are trained; supervised ones the actions of a part of the training episodes.
Whatever is handed out is counted, and the count stands in the run, the report and the leaderboard.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Int, UInt8

from dmotion_bench.actions import require_discrete
from dmotion_bench.errors import InvalidSetting, LabelsNotAvailable, UsageError
from dmotion_bench.learning.triplets import TripletSet
from dmotion_bench.specs import EnvSpec, EpisodeLabels, Supervision

ALLOWED = "none, one-shot, K-shot (such as 5-shot), or a share such as 10% or 100%"


@dataclass(frozen=True)
class LabelRequest:
    """A budget: so many demonstrations of each action, or the actions of a share of the episodes.

    Attributes:
        kind: ``"none"``, ``"shots"`` or ``"share"``.
        amount: Demonstrations per action, or the share in (0, 1].
    """

    kind: Literal["none", "shots", "share"]
    amount: float = 0.0

    @classmethod
    def parse(cls, text: str) -> LabelRequest:
        """Read what the command line was given.

        Raises:
            InvalidSetting: It is none of the allowed forms.
        """
        if text == "none":
            return cls("none")
        if text == "one-shot":
            return cls("shots", 1)
        if (match := re.fullmatch(r"(\d{1,6})-shot", text)) and int(match[1]) > 0:
            return cls("shots", int(match[1]))
        if (match := re.fullmatch(r"(\d{1,3}(?:\.\d+)?)%", text)) and 0 < float(match[1]) <= 100:
            return cls("share", float(match[1]) / 100)
        raise InvalidSetting(f"no label budget {text!r}; it can be {ALLOWED}.")

    def __str__(self) -> str:
        if self.kind == "none":
            return "none"
        if self.kind == "shots":
            return "one-shot" if self.amount == 1 else f"{self.amount:.0f}-shot"
        return f"{self.amount * 100:g}%"

    @classmethod
    def for_model(cls, model: str, supervision: Supervision, asked: str | None) -> LabelRequest:
        """The budget of a run, checked against what the model can use.

        Raises:
            UsageError: A supervised model without labels, or an unsupervised one with a share of them.
        """
        request = cls.parse(asked) if asked is not None else None
        if supervision is Supervision.ACTIONS:
            if request is None or request.kind != "share":
                given = f"not {asked!r}" if asked else "and none was given"
                raise UsageError(
                    f"{model} learns from the actions of its training episodes, {given}; "
                    "give it a share of them: --labels 100% or --labels 10%."
                )
            return request
        if request is not None and request.kind == "share":
            raise UsageError(
                f"{model} learns from video alone and takes a few demonstrations afterwards, not {asked!r}; "
                "give it --labels one-shot (the default), K-shot, or none."
            )
        return request or cls("shots", 1)


@runtime_checkable
class LabelledDataset(Protocol):
    """What the budget needs of a ``storage.dataset.Dataset``."""

    @property
    def spec(self) -> EnvSpec: ...

    def labels(self, episode: int) -> EpisodeLabels: ...


@dataclass(frozen=True, kw_only=True)
class LabelledTriplets:
    """Triplets with labels from the budget; row i of ``triplets`` has ``actions[i]``."""

    triplets: TripletSet
    actions: Int[np.ndarray, " n"]


@dataclass(frozen=True, kw_only=True)
class DemonstrationFrames:
    """Labelled transitions as stored pixels; axis 1 of ``frames`` is previous, current, next."""

    frames: UInt8[np.ndarray, "n 3 h w 3"]
    actions: Int[np.ndarray, " n"]


class LabelBudget:
    """Hands out the labels that a run's budget allows, and counts them.

    Attributes:
        given: Number of labels handed out so far, by purpose.
    """

    def __init__(self, dataset: LabelledDataset, request: LabelRequest, seed: int) -> None:
        self.request, self.given = request, dict[str, int]()
        self._dataset, self._seed = dataset, seed

    @property
    def total(self) -> int:
        """All labels handed out so far."""
        return sum(self.given.values())

    def actions(self, triplets: TripletSet, purpose: str) -> LabelledTriplets:
        """The actions of the budget's share of the episodes.

        Shares are nested: the episodes of 10% are among those of 20%, and the same for every model and seed.

        Raises:
            LabelsNotAvailable: The request is not for a share.
        """
        if self.request.kind != "share":
            raise LabelsNotAvailable(f"the budget {self.request} has no actions for {purpose}; ask for --labels 100%.")
        episodes = np.unique(triplets.episode)
        order = np.random.default_rng(0).permutation(episodes)
        chosen = order[: max(1, round(self.request.amount * len(order)))]
        part = triplets.subset(np.flatnonzero(np.isin(triplets.episode, chosen)))
        actions = self._of_each(part, lambda labels, steps: labels.actions[steps])
        self.given[purpose] = len(part)
        return LabelledTriplets(triplets=part, actions=actions)

    def demonstrations(self, triplets: TripletSet, draw: int = 0) -> DemonstrationFrames:
        """So many transitions of each action as the budget has, drawn from triplets in which nothing is pushed.

        Args:
            triplets: Where they are drawn from: the training's.
            draw: Another number gives another draw, for the spread over draws.

        Raises:
            LabelsNotAvailable: The request is not for demonstrations, or an action does not occur often enough.
        """
        if self.request.kind != "shots":
            raise LabelsNotAvailable(f"the budget {self.request} has no demonstrations; ask for --labels one-shot.")
        spec = self._dataset.spec.actions
        if spec is None:
            raise LabelsNotAvailable(
                "the actions of this data set are not known, so there is nothing to demonstrate; train without labels "
                "(--labels none), or import the recording again with '--actions TOPIC'."
            )
        known_actions = require_discrete(spec, "a demonstration of each action")
        wanted = int(self.request.amount)
        missing = dict.fromkeys(range(len(known_actions)), wanted)
        rows: list[int] = []
        found: list[int] = []
        generator = np.random.default_rng(np.random.SeedSequence(self._seed, spawn_key=(draw,)))
        known: dict[int, EpisodeLabels] = {}
        for row in generator.permutation(len(triplets)).tolist():
            if not any(missing.values()):
                break
            episode, step = int(triplets.episode[row]), int(triplets.step[row])
            labels = known.get(episode) or known.setdefault(episode, self._dataset.labels(episode))
            action = int(labels.actions[step])
            if missing[action] and not labels.pushed[step]:
                missing[action] -= 1
                rows.append(row)
                found.append(action)
        if lacking := [known_actions.names[action] for action, count in missing.items() if count]:
            raise LabelsNotAvailable(
                f"the training episodes hold fewer than {wanted} demonstrations of {', '.join(lacking)}; "
                "ask for fewer (--labels one-shot) or record more episodes."
            )
        order = np.argsort(np.asarray(found), kind="stable")
        self.given["demonstrations"] = self.given.get("demonstrations", 0) + len(rows)
        return DemonstrationFrames(frames=triplets.gather(np.asarray(rows)[order]), actions=np.asarray(found)[order])

    def _of_each(
        self,
        triplets: TripletSet,
        read: Callable[[EpisodeLabels, Int[np.ndarray, " n"]], Int[np.ndarray, " n"]],
    ) -> Int[np.ndarray, " n"]:
        values = np.zeros(len(triplets), np.int64)
        for episode in np.unique(triplets.episode).tolist():
            rows = np.flatnonzero(triplets.episode == episode)
            values[rows] = read(self._dataset.labels(episode), triplets.step[rows])
        return values
