"""The findings of checking an entry, and the verdict."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
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
        figures, samples: How many were held against a new scoring.
    """

    entry: str
    findings: tuple[str, ...]
    missing: tuple[str, ...] = ()
    remarks: tuple[str, ...] = ()
    figures: int = 0
    samples: int = 0

    @property
    def holds(self) -> bool:
        """Whether everything was checked and nothing was found."""
        return not self.findings and not self.missing

    def to_json(self) -> dict[str, Any]:
        """What ``dmbench leaderboard check --json`` prints."""
        return {"holds": self.holds} | {one.name: getattr(self, one.name) for one in fields(self)}


@dataclass(kw_only=True)
class Findings:
    """What has been found so far of one entry."""

    entry: Entry
    wrong: list[str] = field(default_factory=list)
    missing: list[str] = field(default_factory=list)
    remarks: list[str] = field(default_factory=list)
    figures: int = 0
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
            figures=self.figures,
            samples=self.samples,
        )


def short(value: object) -> str:
    """A value for a sentence."""
    text = repr(value)
    return text if len(text) <= 80 else f"{text[:77]}..."


def _close(left: float | None, right: float | None, rounding: float, absolute: float = 0.0) -> bool:
    if left is None or right is None:
        return left is right
    return math.isclose(left, right, rel_tol=rounding, abs_tol=max(rounding * 1e-3, absolute))
