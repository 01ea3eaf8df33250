"""The findings of checking an entry, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from typing import Any, Final

from leaderboard.comparison import PARTS
from leaderboard.entry import Entry

SAME: Final = 1e-9
"""Relative; between figures of the same samples."""

SHOWN: Final = 4
"""Findings of a kind that are spelt out."""


@dataclass(frozen=True, kw_only=True)
class Verdict:
    """The result of checking an entry.

    Attributes:
        entry: Its name.
        findings: What does not hold; empty for a sound entry.
        missing: What would be needed to check it and is not here: its weights, its data, the code that scored it.
        remarks: What is to be borne in mind.
        figures: How many of the model's were computed again: by a new scoring, or from the stored samples alone.
        samples: How many were held against a new scoring.
        weights: The hash of the weights that the entry names; None for a published row.
        seed: Of the training that it names.
        run: The name of its run.
    """

    entry: str
    findings: tuple[str, ...]
    missing: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    figures: int = 0
    samples: int = 0
    weights: str | None = None
    seed: int | None = None
    run: str | None = None

    @property
    def holds(self) -> bool:
        """Whether everything was checked and nothing was found."""
        return not self.findings and not self.missing

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench leaderboard check --json`` prints."""
        return {"holds": self.holds} | {one.name: getattr(self, one.name) for one in fields(self)}


@dataclass(kw_only=True)
class Findings:
    """What has been found so far of one entry.

    Attributes:
        entry: That is checked.
        wrong, missing, remarks: Sentences of the verdict.
        figures: Names of the model's figures that were computed again.
        samples: How many were compared with a new scoring.
    """

    entry: Entry
    wrong: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    figures: set[str] = field(default_factory=set)
    samples: int = 0

    def expect(self, what: str, said: object, found: object) -> None:
        """Add a finding if the entry says something else than what was found."""
        if said != found:
            self.wrong.append(f"{what}: the entry says {short(said)}, it is {short(found)}")

    def expect_figures(
        self,
        where: str,
        said: Mapping[str, Any],
        found: Mapping[str, Any],
        rounding: float = SAME,
        *,
        means_only: bool = False,
        absolute: float = 0.0,
    ) -> None:
        """Add a finding for each figure that differs, at most the first few; by less than ``absolute`` none does."""
        wrong = [f"{name} is missing" for name in found if name not in said]
        wrong += [f"{name} is nobody's" for name in said if name not in found]
        for name in (name for name in said if name in found):
            for part in ("mean", "n") if means_only else PARTS:
                left, right = said[name][part], found[name][part]
                if not _close(left, right, rounding, absolute):
                    wrong.append(f"{name}.{part} is said to be {left} and is {right}")
        self.wrong += [f"{where}: {one}" for one in wrong[:SHOWN]]
        if len(wrong) > SHOWN:
            self.wrong.append(f"{where}: and {len(wrong) - SHOWN} more")

    def verdict(self) -> Verdict:
        """The verdict."""
        on = "" if self.entry.trained_on is None else f" on {self.entry.content['dataset']['name']}"
        return Verdict(
            entry=self.entry.name + on,
            findings=tuple(self.wrong),
            missing=tuple(self.missing),
            remarks=tuple(self.remarks),
            figures=len(self.figures),
            samples=self.samples,
            weights=self.entry.content["weights"] if self.entry.is_measured else None,
            seed=self.entry.content["seed"] if self.entry.is_measured else None,
            run=self.entry.name if self.entry.is_measured else None,
        )


def copies_found(verdicts: Sequence[Verdict]) -> list[Verdict]:
    """The verdicts, with what is to be said where several entries have the same weights.

    At each entry whose weights another one calls a training with another seed that is a finding. Where they only have
    another name it is a remark. Copies are found by the hash of their weights: of ones that were changed a little
    nothing is said.
    """
    seeds: dict[str, dict[int, str]] = {}
    runs: dict[str, dict[str, int]] = {}
    for one in verdicts:
        if one.weights is not None and one.seed is not None and one.run is not None:
            seeds.setdefault(one.weights, {}).setdefault(one.seed, one.entry)
            runs.setdefault(one.weights, {}).setdefault(one.run, one.seed)

    def with_copies(one: Verdict) -> Verdict:
        if one.weights not in seeds:
            return one
        findings = [
            f"weights: {name} has the same and calls them a training with seed {seed}, here it is {one.seed}; "
            "they are one training"
            for seed, name in seeds[one.weights].items()
            if seed != one.seed
        ]
        remarks = [
            f"weights: the run {name} has the same; they are one training under two names"
            for name, seed in runs[one.weights].items()
            if name != one.run and seed == one.seed
        ]
        return replace(one, findings=(*one.findings, *findings), remarks=(*one.remarks, *remarks))

    return [with_copies(one) for one in verdicts]


def short(value: object) -> str:
    """A value for a sentence."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _close(left: float | None, right: float | None, rounding: float, absolute: float = 0.0) -> bool:
    if left is None or right is None:
        return left is right
    return math.isclose(left, right, rel_tol=rounding, abs_tol=max(rounding * 1e-3, absolute))
