"""What became slower or faster than in a stored run of ``dmbench bench --json``.

A round's speed is taken relative to what the machine could do in that round, where the two were measured in turn: so a
machine that is busier than it was, or a little slower, is not taken for slower code. A speed is *slower* if all its
rounds are slower than all rounds of the stored one, and *faster* likewise; anything else lies within the noise of the
two measurements. No threshold is chosen: with six rounds each, two equal speeds are told apart in this way once in 462
times.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from typing import Literal

from dmotion_bench.benchmarks.result import Result
from dmotion_bench.errors import UsageError
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.json_file import JsonUnreadable, read_json
from dmotion_bench.wording import shown

Verdict = Literal["slower", "faster", "within noise"]


@dataclass(frozen=True, kw_only=True)
class Stored:
    """A stored run.

    Attributes:
        processor: What it ran on.
        threads: With how many.
        results: By their names.
    """

    processor: str
    threads: int
    results: dict[str, Result]


@dataclass(frozen=True, kw_only=True)
class Change:
    """A speed that was measured in both runs.

    Attributes:
        name, unit: Of the speed.
        before, now: The medians over the rounds.
        ratio: The present speed over the stored one; relative to the machine's limit where both have it.
        relative: Whether that is so.
        verdict: Whether the difference is more than noise.
    """

    name: str
    unit: str
    before: float
    now: float
    ratio: float
    relative: bool
    verdict: Verdict


def read_stored(path: Path) -> Stored:
    """A run as ``dmbench bench --json`` printed it.

    Raises:
        UsageError: The file holds something else, or cannot be read.
    """
    try:
        fields = Fields(read_json(path), "it")
        results = [Result.from_json(Fields(one, "a result")) for one in fields.many("results")]
        return Stored(
            processor=fields.text("processor"),
            threads=_threads(fields),
            results={one.name: one for one in results},
        )
    except (OSError, JsonUnreadable, ValueError) as error:
        why = error.strerror if isinstance(error, OSError) else error
        raise UsageError(
            f"{shown(str(path))} is no output of 'dmbench bench': {why}; make such a file with "
            "'dmbench bench --json > FILE'."
        ) from None


def _threads(fields: Fields) -> int:
    if (threads := fields.whole("threads")) < 1:
        raise ValueError(f"it says that {threads} threads computed")
    return threads


def changes(stored: Stored, results: Sequence[Result]) -> Iterator[Change]:
    """The speeds that both runs have, in the order of the present one."""
    for now in results:
        before = stored.results.get(now.name)
        if before is not None and before.unit == now.unit:
            yield _change(before, now)


def _change(before: Result, now: Result) -> Change:
    relative = bool(before.limits and now.limits) and before.limit_name == now.limit_name
    old, new = (_relative(one) if relative else one.rounds for one in (before, now))
    verdict: Verdict = "within noise"
    if max(new) < min(old):
        verdict = "slower"
    elif min(new) > max(old):
        verdict = "faster"
    return Change(
        name=now.name,
        unit=now.unit,
        before=before.value,
        now=now.value,
        ratio=median(new) / median(old),
        relative=relative,
        verdict=verdict,
    )


def _relative(result: Result) -> tuple[float, ...]:
    return tuple(speed / limit for speed, limit in zip(result.rounds, result.limits, strict=True))
