"""Many cases in turn: which target each is of, what came of all of them, and where faulty ones are kept."""

from __future__ import annotations

import itertools
import json
import os
import pickle
import shutil
import sys
import tempfile
import time
import traceback
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from tests.fuzz.case import Answer, Case
from tests.fuzz.child import Result, prepare_forking, run_case
from tests.fuzz.targets import Target
from tests.fuzz.targets.dataset import DatasetTarget
from tests.fuzz.targets.entry import EntryTarget
from tests.fuzz.targets.recording import RecordingTarget
from tests.fuzz.targets.remote import RemoteTarget
from tests.fuzz.targets.run import RunTarget
from tests.fuzz.targets.share import ShareTarget
from tests.fuzz.warm import load_too

TARGETS: tuple[type[Target], ...] = (
    DatasetTarget,
    RecordingTarget,
    RunTarget,
    EntryTarget,
    ShareTarget,
    RemoteTarget,
)
KEPT = 3
"""Inputs that are kept of each different fault."""


def target_of(number: int) -> str:
    """The target of a case; all in turn, by their shares."""
    wheel = [
        kind.name for place in range(max(kind.share for kind in TARGETS)) for kind in TARGETS if place < kind.share
    ]
    return wheel[number % len(wheel)]


@dataclass
class Summary:
    """What came of all cases."""

    seed: int
    cases: int = 0
    seconds: float = 0.0
    cpu_s: float = 0.0
    verdicts: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    formats: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))
    checksums: Counter[str] = field(default_factory=Counter)
    slowest: list[tuple[float, int, str]] = field(default_factory=list)
    largest: list[tuple[int, int, str, str]] = field(default_factory=list)
    faults: dict[str, dict[str, Any]] = field(default_factory=dict)

    def add(self, result: Result) -> bool:
        """Take in a case; whether it shows a fault of which few inputs are kept yet."""
        self.cases += 1
        self.cpu_s += result.cpu_s
        self.verdicts[result.target][result.verdict] += 1
        self.formats[result.target].update(result.formats)
        self.checksums[result.checksums] += 1
        self.slowest = sorted([*self.slowest, (round(result.cpu_s, 2), result.number, result.target)], reverse=True)[:5]
        peak = (result.peak >> 20, result.number, result.target, result.greedy)
        self.largest = sorted([*self.largest, peak], reverse=True)[:5]
        news = False
        for fault in result.faults:
            name = f"{result.target}: {fault['fault']} at {fault['where']}"
            known = self.faults.setdefault(name, {"count": 0, "probes": [], "cases": []})
            known["count"] += 1
            if fault["probe"] not in known["probes"] and len(known["probes"]) < 6:
                known["probes"].append(fault["probe"])
            if len(known["cases"]) < KEPT and result.number not in known["cases"]:
                known["cases"].append(result.number)
                news = True
        return news

    def take(self, other: Summary) -> None:
        """Take in what another process found."""
        self.cases += other.cases
        self.cpu_s += other.cpu_s
        self.seconds = max(self.seconds, other.seconds)
        for target, counts in other.verdicts.items():
            self.verdicts[target].update(counts)
        for target, counts in other.formats.items():
            self.formats[target].update(counts)
        self.checksums.update(other.checksums)
        self.slowest = sorted([*self.slowest, *other.slowest], reverse=True)[:5]
        self.largest = sorted([*self.largest, *other.largest], reverse=True)[:5]
        for name, fault in other.faults.items():
            known = self.faults.setdefault(name, {"count": 0, "probes": [], "cases": []})
            known["count"] += fault["count"]
            known["probes"] = list(dict.fromkeys([*known["probes"], *fault["probes"]]))
            known["cases"] = sorted([*known["cases"], *fault["cases"]])

    def to_json(self) -> dict[str, Any]:
        """As plain values; the most frequent faults first."""
        faults = dict(sorted(self.faults.items(), key=lambda one: -one[1]["count"]))
        return {
            "seed": self.seed,
            "cases": self.cases,
            "seconds": round(self.seconds, 1),
            "cpu_s": round(self.cpu_s, 1),
            "cases_per_s": round(self.cases / self.seconds, 2) if self.seconds else None,
            "verdicts": {name: dict(counts) for name, counts in sorted(self.verdicts.items())},
            "formats": {name: dict(sorted(counts.items())) for name, counts in sorted(self.formats.items())},
            "checksums": dict(self.checksums),
            "slowest": [{"cpu_s": cpu, "case": number, "target": name} for cpu, number, name in self.slowest],
            "largest": [
                {"MiB": size, "case": number, "target": name, "probe": probe}
                for size, number, name, probe in self.largest
            ],
            "faulty_cases": sum(counts["fault"] for counts in self.verdicts.values()),
            "faults": faults,
        }


class Campaign:
    """The originals of all targets, and the running of cases on them.

    Args:
        scratch: An empty folder for originals and cases.
        seed: Of every case.
        only: The names of the targets; all if empty.
    """

    def __init__(self, scratch: Path, seed: int, only: tuple[str, ...] = ()) -> None:
        self.scratch, self.seed = scratch, seed
        self.targets = {kind.name: kind(scratch / "originals") for kind in TARGETS if not only or kind.name in only}
        self.reference: dict[str, dict[str, dict[str, Answer]]] = {}
        for target in self.targets.values():
            self.reference[target.name] = self._prepared(target)
        prepare_forking()

    def _prepared(self, target: Target) -> dict[str, dict[str, Answer]]:
        """The originals, made in a child as well; and what dmbench answers of each that is intact.

        What the children had to load for that is loaded here as well, for all cases to come.
        """
        made = run_case(self._case(-1, target.name), _Making(target), {})
        if made.faults:
            raise RuntimeError(f"the originals of {target.name} cannot be made: {made.faults[0]['detail']}")
        found: dict[str, dict[str, Answer]] = {}
        for name in dict.fromkeys(target.names()):
            result = run_case(self._case(-2, target.name), _Intact(target, name), {})
            if result.faults:
                raise RuntimeError(f"an intact {name} is faulty: {result.faults[0]['detail']}")
            found[name] = result.answers
            load_too(result.loaded)
        return found

    def _case(self, number: int, target: str) -> Case:
        folder = self.scratch / "cases" / str(number)
        return Case(number=abs(number), seed=self.seed, target=target, folder=folder)

    def run(self, number: int) -> Result:
        """One case."""
        target = self.targets[target_of(number)]
        return run_case(self._case(number, target.name), target, self.reference[target.name])

    def keep(self, result: Result, folder: Path) -> None:
        """The input of a faulty case and what is known of it."""
        kept = folder / f"case-{result.number}"
        shutil.rmtree(kept, ignore_errors=True)
        target = self.targets[result.target]
        case = self._case(result.number, target.name)
        run_case(case, target, {}, only_spoil=True)
        folder.mkdir(parents=True, exist_ok=True)
        shutil.move(case.folder, kept)
        told = result.to_json() | {
            "again": f"python -m tests.fuzz --seed {self.seed} --only {result.target} --case {result.number}"
        }
        (folder / f"case-{result.number}.json").write_text(json.dumps(told, indent=1, default=str))


class _Making:
    """A target whose originals are being made."""

    def __init__(self, target: Target) -> None:
        self.target = target

    def spoil(self, case: Case) -> None:
        self.target.make()

    def probes(self, case: Case, spoilt: None) -> Iterator[Any]:
        return iter(())

    def judge(self, *_: Any) -> Iterator[Any]:
        return iter(())


class _Intact(_Making):
    """A target of which an intact copy is asked everything."""

    def __init__(self, target: Target, original: str) -> None:
        super().__init__(target)
        self.original = original

    def spoil(self, case: Case) -> Any:
        case.chance = lambda share: True  # type: ignore[method-assign] (of an original everything is asked)
        if self.target.name in ("run", "entry"):
            case.folder.rmdir()
        return self.target.intact(case, self.original)

    def probes(self, case: Case, spoilt: Any) -> Iterator[Any]:
        return self.target.probes(case, spoilt)


def scratch_folder() -> Path:
    """A new folder, in memory where there is room."""
    shared = Path("/dev/shm")
    room = shared.is_dir() and os.access(shared, os.W_OK) and shutil.disk_usage(shared).free > 2 << 30
    return Path(tempfile.mkdtemp(prefix="dmbench-fuzz-", dir=shared if room else None))


def run_side_by_side(
    campaign: Campaign, numbers: Iterator[int], *, jobs: int, seconds: float | None, keep: Path
) -> Summary:
    """Run cases in so many processes until there are no more, or time is up."""
    workers = []
    for job in range(jobs):
        read, write = os.pipe()
        process = os.fork()
        if process == 0:
            code = 1
            try:
                share = itertools.islice(numbers, job, None, jobs)
                found = run_cases(campaign, share, seconds=seconds, keep=keep, tells=job == 0)
                with os.fdopen(write, "wb") as pipe:
                    pickle.dump(found, pipe)
                code = 0
            except BaseException:
                traceback.print_exc()
            finally:
                os._exit(code)
        os.close(write)
        workers.append((process, read))
    summary = Summary(campaign.seed)
    for process, read in workers:
        with os.fdopen(read, "rb") as pipe:
            summary.take(pickle.load(pipe))
        os.waitpid(process, 0)
    return summary


def run_cases(campaign: Campaign, numbers: Iterator[int], *, seconds: float | None, keep: Path, tells: bool) -> Summary:
    """Run cases until there are no more, or time is up; ``tells`` says on stderr how far it is."""
    summary, began = Summary(campaign.seed), time.monotonic()
    for number in numbers:
        if target_of(number) not in campaign.targets:
            continue
        if seconds is not None and time.monotonic() - began > seconds:
            break
        result = campaign.run(number)
        news = summary.add(result)
        summary.seconds = time.monotonic() - began
        if news:
            campaign.keep(result, keep)
        if tells and summary.cases % 200 == 0:
            print(f"{summary.cases} cases, {len(summary.faults)} different faults", file=sys.stderr, flush=True)  # noqa: T201
    return summary
