"""A command is started, killed at a random moment, and started again until it comes to its end."""

from __future__ import annotations

import contextlib
import os
import signal
import subprocess
import time
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import psutil

from tests.kill.contents import Content, listing, timeless
from tests.kill.scenarios import Scenario, environment, said

LOOK_EVERY = 0.001  # [s] at the files, while their changes are counted; looking takes a third of the time at most
WAIT_EVERY = 0.01  # [s] otherwise
PATIENCE = 600.0  # [s]
ORPHANS = 20.0  # [s] after which no process of a killed command may be left
ENDED = {signal.SIGKILL: (-9,), signal.SIGTERM: (143,), signal.SIGINT: (130,)}
"""What a command's exit code must be."""

SIGNALS = (signal.SIGKILL,) * 6 + (signal.SIGTERM,) * 3 + (signal.SIGINT,)
AGAIN = 0.35
"""How often the next attempt is killed as well."""


@dataclass(frozen=True, kw_only=True)
class Undisturbed:
    """How a command goes that nobody kills: what it leaves behind, how long it takes, how often files change."""

    content: Content
    names: list[str]
    seconds: float
    changes: int


@dataclass
class Ended:
    """How an attempt ended."""

    code: int
    out: str
    err: str
    seconds: float
    changes: int
    struck: signal.Signals | None = None
    whom: str = ""


@dataclass
class Round:
    """A command that was killed until it was let be.

    Attributes:
        strikes: Of each kill: the signal, whom it met, and when.
        faults: What was wrong.
    """

    strikes: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Strike:
    """When and how a command is killed.

    Attributes:
        signal: Sent.
        whom: ``command``, ``everything`` (its workers, too) or ``a worker``.
        after_s: By the clock; or so long after the change.
        after_changes: Of the files in the workspace; None for a moment by the clock.
    """

    signal: signal.Signals
    whom: str
    after_s: float
    after_changes: int | None

    def __str__(self) -> str:
        when = f"{self.after_s:.2f} s" if self.after_changes is None else f"change {self.after_changes}"
        return f"{self.signal.name} to {self.whom} at {when}"


def undisturbed(scenario: Scenario, base: Path, workspace: Path) -> Undisturbed:
    """Run it to its end."""
    scenario.prepare(base, workspace)
    ended = attempt(scenario, workspace, None, count_changes=True)
    if ended.code:
        raise RuntimeError(f"{scenario.name} fails undisturbed: {ended.err}")
    return Undisturbed(
        content=content_of(scenario, workspace, ended),
        names=listing(workspace),
        seconds=ended.seconds,
        changes=ended.changes,
    )


def content_of(scenario: Scenario, workspace: Path, ended: Ended) -> Content:
    """What came of it."""
    found = scenario.outcome(workspace)
    return timeless(found | said(ended.out)) if scenario.says else found


def attack(scenario: Scenario, base: Path, workspace: Path, truth: Undisturbed, rng: np.random.Generator) -> Round:
    """Kill, start again, compare."""
    found = Round()
    scenario.prepare(base, workspace)
    strike: Strike | None = draw_strike(rng, truth)
    while True:
        ended = attempt(scenario, workspace, strike, wait_for_orphans=strike is None or bool(rng.integers(2)))
        if ended.struck is not None:
            found.strikes.append(str(strike))
        found.faults += _misbehaviour(ended, strike)
        if ended.struck is None or (ended.whom == "a worker" and ended.code == 0):
            break
        strike = draw_strike(rng, truth) if rng.random() < AGAIN else None
    if ended.code:
        found.faults.append(f"started again, it fails with {ended.code}: {ended.err[-400:]}")
        return found
    content, names = content_of(scenario, workspace, ended), listing(workspace)
    differing = sorted(
        key for key in truth.content.keys() | content.keys() if truth.content.get(key) != content.get(key)
    )
    if differing:
        found.faults.append(f"differs from the undisturbed outcome: {', '.join(differing[:6])}")
    if left := sorted(set(names) ^ set(truth.names)):
        found.faults.append(f"other files than undisturbed: {', '.join(left[:6])}")
    return found


def draw_strike(rng: np.random.Generator, truth: Undisturbed) -> Strike:
    """Any moment: by the clock, or soon after some file has changed."""
    by_clock = rng.random() < 0.35 or not truth.changes
    whom = str(rng.choice(["command", "everything", "a worker"], p=[0.65, 0.2, 0.15]))
    number = signal.SIGKILL if whom == "a worker" else SIGNALS[int(rng.integers(len(SIGNALS)))]
    return Strike(
        signal=number,
        whom=whom,
        after_s=float(rng.uniform(0, truth.seconds)) if by_clock else float(rng.choice([0, 0.002, 0.01, 0.05])),
        after_changes=None if by_clock else int(rng.integers(1, truth.changes + 1)),
    )


def attempt(
    scenario: Scenario,
    workspace: Path,
    strike: Strike | None,
    *,
    wait_for_orphans: bool = True,
    count_changes: bool = False,
) -> Ended:
    """One start of the command.

    Args:
        wait_for_orphans: Whether the next attempt may begin only when no process of this one is left.
        count_changes: Whether changes of files are counted to the end, and not only until the strike.
    """
    place = workspace.parent / f"said-{time.monotonic_ns()}"  # what is left of a killed attempt may still write
    out, err = place.with_suffix(".out"), place.with_suffix(".err")
    began, changes, struck, whom, moment = time.monotonic(), 0, None, "", None
    with out.open("wb") as stdout, err.open("wb") as stderr:
        process = subprocess.Popen(
            scenario.command,
            cwd=workspace,
            env=environment(workspace),
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=stderr,
            start_new_session=True,
        )
        before, looking = _state(workspace), 0.0
        while process.poll() is None:
            if count_changes or (strike is not None and strike.after_changes is not None and struck is None):
                time.sleep(max(LOOK_EVERY, 2 * looking))
                looked = time.monotonic()
                now = _state(workspace)
                changes, before = changes + (now != before), now
                looking = time.monotonic() - looked
            else:
                time.sleep(WAIT_EVERY)
            passed = time.monotonic() - began
            if strike is not None and struck is None:
                if strike.after_changes is None:
                    due = passed >= strike.after_s
                else:
                    if moment is None and changes >= strike.after_changes:
                        moment = passed
                    due = moment is not None and passed >= moment + strike.after_s
                if due and (strike.signal is signal.SIGKILL or _catches(process.pid, signal.SIGTERM)):
                    struck, whom = _send(strike, process.pid)
            if passed > PATIENCE:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
                return Ended(-1, "", f"no end after {PATIENCE:g} s", passed, changes)
    ended = Ended(
        process.returncode, out.read_text(), err.read_text(errors="replace"), time.monotonic() - began, changes
    )
    if struck is not None and (process.returncode != 0 or whom == "a worker"):  # else it had ended before
        ended.struck, ended.whom = struck, whom
    if wait_for_orphans and not _all_gone(process.pid):
        ended.err += "\nTraceback: processes of the command are left"
        with contextlib.suppress(ProcessLookupError):
            os.killpg(process.pid, signal.SIGKILL)
    return ended


def _send(strike: Strike, process: int) -> tuple[signal.Signals | None, str]:
    """Whom it met; the command itself where there is no worker."""
    with contextlib.suppress(ProcessLookupError):
        if strike.whom == "everything":
            os.killpg(process, strike.signal)
            return strike.signal, strike.whom
        workers = _children(process) if strike.whom == "a worker" else []
        os.kill(workers[-1] if workers else process, strike.signal)
        return strike.signal, strike.whom if workers else "command"
    return None, ""


def _catches(process: int, number: signal.Signals) -> bool:
    """Whether a process has got so far that it handles a signal; before that it is Python's own start that ends."""
    with contextlib.suppress(OSError, ValueError, StopIteration):
        lines = Path(f"/proc/{process}/status").read_text().splitlines()
        caught = next(line for line in lines if line.startswith("SigCgt:"))
        return bool(int(caught.split()[1], 16) >> (number - 1) & 1)
    return False


def _children(process: int) -> list[int]:
    """The processes below it, the youngest last; workers may be the children of a server."""
    with contextlib.suppress(psutil.Error):
        below = psutil.Process(process).children(recursive=True)
        return [one.pid for one in sorted(below, key=lambda one: (one.create_time(), one.pid))]
    return []


def _all_gone(group: int) -> bool:
    deadline = time.monotonic() + ORPHANS
    while time.monotonic() < deadline:
        try:
            os.killpg(group, 0)
        except ProcessLookupError:
            return True
        time.sleep(0.05)
    return False


def _state(workspace: Path) -> dict[str, tuple[int, int, int]]:
    found: dict[str, tuple[int, int, int]] = {}
    for folder, _, names in os.walk(workspace):
        for name in names:
            with contextlib.suppress(OSError):
                at = os.stat(os.path.join(folder, name))  # noqa: PTH116, PTH118 (a thousand times a second)
                found[f"{folder}/{name}"] = (at.st_size, at.st_mtime_ns, at.st_ino)
    return found


def _misbehaviour(ended: Ended, strike: Strike | None) -> list[str]:
    """What must not be said by a command that ends, however it ends."""
    words = ["Traceback", "Exception ignored"]
    if ended.struck is not signal.SIGKILL:  # which nobody can clean up after
        words.append("resource_tracker")
    faults = [
        f"{word!r} on stderr after {strike or 'nothing'}: {ended.err[-600:]}" for word in words if word in ended.err
    ]
    if ended.struck is not None and ended.whom != "a worker" and ended.code not in ENDED[ended.struck]:
        faults.append(f"exit code {ended.code} after {strike}: {ended.err[-300:]}")
    if ended.struck in (signal.SIGTERM, signal.SIGINT) and ended.code in (143, 130) and "dmbench: " not in ended.err:
        faults.append(f"not a word after {strike}")
    return faults
