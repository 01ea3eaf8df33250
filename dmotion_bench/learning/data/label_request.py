"""How many labels a run asks for: its budget, as the command line writes it, checked against what a model can use.

It is ``none``, so many labelled transitions (``64``), all of them (``all``, ``100%``), a share (``10%``), or so many
demonstrations of each discrete action (``one-shot``, ``5-shot``). Where an action says what several agents do
(``Discrete.joint``), it may be so many of each agent's every action instead (``one-shot-per-agent``): one transition
shows an action of each, so there are far fewer.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from decimal import Decimal
from typing import Final, Literal

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import InvalidSetting, UsageError
from dmotion_bench.specs import Supervision

PER_AGENT = "-per-agent"
ALLOWED = (
    "none, a number of labelled transitions such as 64, all, a share such as 10%, one-shot or K-shot (5-shot), or of "
    f"joint actions K-shot{PER_AGENT}"
)
_SHOTS: Final = ("shots", "shots-per-agent")
DEMONSTRATIONS = 64
"""Given to models of video by default if the actions are continuous."""


@dataclass(frozen=True)
class LabelRequest:
    """A budget: so many demonstrations of each action, so many transitions, or the actions of a share of the episodes.

    Attributes:
        kind: ``"none"``, ``"shots"``, ``"shots-per-agent"``, ``"count"`` or ``"share"``.
        amount: Demonstrations per action, transitions, or the share in (0, 1].
    """

    kind: Literal["none", "shots", "shots-per-agent", "count", "share"]
    amount: float = 0.0

    @classmethod
    def parse(cls, text: str) -> LabelRequest:
        """Read what the command line was given.

        Raises:
            InvalidSetting: It is none of the allowed forms.
        """
        if text == "none":
            return cls("none")
        if text == "all":
            return cls("share", 1)
        if re.fullmatch(r"[1-9]\d{0,8}", text):
            return cls("count", int(text))
        if (match := re.fullmatch(rf"(one|\d{{1,6}})-shot({PER_AGENT})?", text)) and match[1].lstrip("0"):
            return cls("shots-per-agent" if match[2] else "shots", 1 if match[1] == "one" else int(match[1]))
        if (match := re.fullmatch(r"(\d{1,3}(?:\.\d+)?)%", text)) and 0 < float(match[1]) <= 100:
            return cls("share", float(match[1]) / 100)
        raise InvalidSetting(f"no label budget {text!r}; it can be {ALLOWED}.")

    def __str__(self) -> str:
        if self.kind == "none":
            return "none"
        if self.kind in _SHOTS:
            many = "one-shot" if self.amount == 1 else f"{self.amount:.0f}-shot"
            return many if self.kind == "shots" else many + PER_AGENT
        return f"{self.amount:.0f}" if self.kind == "count" else f"{_percentage(self.amount)}%"

    def of(self, transitions: int) -> LabelRequest:
        """What is asked for where there are so many transitions: more than there are is all of them."""
        return LabelRequest("share", 1) if self._exceeds(transitions) else self

    def require_of(self, transitions: int) -> None:
        """Refuse a number of labels that is larger than that of the transitions of a data set.

        Raises:
            UsageError: It is.
        """
        if self._exceeds(transitions):
            raise UsageError(
                f"'--labels {self}' asks for more labelled transitions than the data set has, {transitions:,}; give a "
                "smaller number, or '--labels all'."
            )

    def _exceeds(self, transitions: int) -> bool:
        return self.kind == "count" and self.amount > transitions

    @classmethod
    def for_model(
        cls, model: str, supervision: Supervision, asked: str | None, actions: ActionSpec | None = None
    ) -> LabelRequest:
        """The budget of a run, checked against what the model and the actions can use.

        Args:
            model: Its name.
            supervision: What it learns from.
            asked: The budget, None for the default.
            actions: Of the data set.

        Raises:
            UsageError: A model that learns from labels without any, or demonstrations of each of continuous actions.
        """
        request = cls.parse(asked) if asked is not None else None
        continuous = isinstance(actions, Continuous)
        if continuous and request is not None and request.kind in _SHOTS:
            raise UsageError(
                f"{asked!r} asks for demonstrations of each action, and continuous actions ({actions}) cannot be "
                "counted one by one; give a number of labelled transitions, such as --labels 64."
            )
        if supervision is Supervision.ACTIONS:
            if request is None or request.kind not in ("share", "count"):
                given = f"not {asked!r}" if asked else "and none was given"
                raise UsageError(
                    f"{model} learns from the actions of its training episodes, {given}; "
                    "give it a share of them: --labels 100% or --labels 10%, or a number: --labels 64."
                )
            return request
        if request is not None and request.kind == "shots-per-agent" and not _is_joint(actions):
            raise UsageError(
                f"{asked!r} asks for demonstrations of each agent's actions, and an action of this data set is not a "
                f"joint one; give it --labels {str(request).removesuffix(PER_AGENT)}."
            )
        usual = "64 (the default)" if continuous else "one-shot (the default), K-shot"
        if supervision is Supervision.FEW and request == cls("none"):
            raise UsageError(
                f"{model} learns from video and a few labelled transitions together, and cannot do without; give it "
                f"--labels {usual}, a number of transitions, a share such as 1%, or all."
            )
        return request or (cls("count", DEMONSTRATIONS) if continuous else cls("shots", 1))


def _percentage(share: float) -> str:
    """The shortest text of a share in percent that is read as the same share, without an exponent."""
    texts = [f"{Decimal(f'{share * 100:.{digits}g}'):f}" for digits in range(1, 18)]
    return next((text for text in texts if float(text) / 100 == share), texts[-1])


def _is_joint(actions: ActionSpec | None) -> bool:
    return isinstance(actions, Discrete) and len(actions.parts) > 1


def first_budget(actions: ActionSpec | None) -> str:
    """The budget that a model of video has by default, as it is written."""
    return str(LabelRequest.for_model("", Supervision.NONE, None, actions))
