"""Entries of the leaderboard: their files, and the references and pictures that they share."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from leaderboard.entry_file import read_entry
from tests.fuzz.case import Answers, Case, Checksums, Fault, Probe
from tests.fuzz.command import dmbench
from tests.fuzz.mutations import pick
from tests.fuzz.mutations.json_text import HOSTILE, MARKUP, spoil_json
from tests.fuzz.mutations.plain import spoil_bytes
from tests.fuzz.targets import Target, copied
from tests.fuzz.worlds import write_noise

RUN = "fuzz-small-s0"
SLACK = 1e-6
"""Relative; figures that differ by less are the same."""


@dataclass
class SpoiltEntry:
    """A folder of entries, the one that was spoilt, whether it was a measured one, and whether a reference was."""

    folder: Path
    file: Path
    measured: bool
    shared: bool


class EntryTarget(Target):
    """See above."""

    name: ClassVar[str] = "entry"
    share: ClassVar[int] = 2

    def make(self) -> None:
        """A board of one measured entry and the published ones, in a workspace with its run and data."""
        workspace = self.originals / "board"
        write_noise(workspace / "data" / "noise-tiny").cache()
        os.environ["DMBENCH_WORKSPACE"] = str(workspace)
        dmbench("train", "fuzz-small", "--out", str(workspace / "runs" / RUN)).done()
        dmbench("score", RUN, "--horizon", "2").done()
        dmbench("leaderboard", "build").done()

    def names(self) -> list[str]:
        return ["board"]

    def intact(self, case: Case, name: str) -> SpoiltEntry:
        copied(self.originals / name, case.folder)
        folder = case.folder / "reports" / "leaderboard" / "entries"
        return SpoiltEntry(folder, next(folder.glob(f"{RUN}*.json")), measured=True, shared=False)

    def spoil(self, case: Case) -> SpoiltEntry:
        case.folder.rmdir()
        spoilt, rng = self.intact(case, "board"), case.rng
        for _ in range(int(rng.choice([1, 1, 1, 2]))):
            files, kind = [spoilt.file], pick(rng, ("measured",) * 6 + ("published", "published", "shared", "picture"))
            if kind == "published":
                files = sorted(path for path in spoilt.folder.glob("*.json") if path != spoilt.file)
                spoilt.measured = False
            elif kind == "shared":
                files = sorted((spoilt.folder / "references").glob("*.json"))
                spoilt.shared = True
            file = pick(rng, files)
            if kind == "published":
                spoilt.file = file
            before = file.read_bytes()
            if kind == "picture":
                after, told = _spoil_picture(case, before)
            else:
                after, told = spoil_bytes(rng, before) if case.chance(0.15) else spoil_json(rng, before)
            file.write_bytes(after)
            case.tell(file.name, f"{kind}: {told}")
            if kind == "shared" and case.checksums is not Checksums.KEPT:
                _rename_shared(spoilt, file, after)
        return spoilt

    def probes(self, case: Case, spoilt: SpoiltEntry) -> Iterator[Probe]:
        os.environ["DMBENCH_WORKSPACE"] = str(case.folder)
        yield Probe("entry", lambda: dict(read_entry(spoilt.file).content))
        yield Probe("check", partial(_checked, spoilt.file))
        if case.chance(0.5):
            yield Probe("build", partial(_built, spoilt.folder, case.folder / "board"))
        if case.chance(0.2):
            yield Probe("rebuild", lambda: dmbench("leaderboard", "build", "--json").json() and None)
        if case.chance(0.1):
            yield Probe("check all", lambda: dmbench("leaderboard", "check", "--quick", "--json").code and None)

    def judge(
        self, case: Case, spoilt: SpoiltEntry, answers: Answers, reference: dict[str, Any]
    ) -> Iterator[tuple[str, str]]:
        entry, original = answers.get("entry"), reference["board"]["entry"]
        only_shared = spoilt.shared and spoilt.measured and len(case.told) == 1 and case.checksums is Checksums.KEPT
        if only_shared and entry is not None and entry.value not in (None, original.value):
            yield "wrong content", "an entry is read with references that do not have their hash"
        check = answers.get("check")
        if spoilt.measured and check is not None and check.value == repr("holds"):
            said, truth = (
                figures_of(folder)
                for folder in (
                    spoilt.file,
                    next((self.originals / "board/reports/leaderboard/entries").glob(f"{RUN}*.json")),
                )
            )
            if said is not None and not same_figures(said, truth):
                yield "wrong content", "'leaderboard check --quick' says that figures hold which are not the run's"


def _checked(file: Path) -> str:
    """What ``check --quick`` says of an entry: ``holds``, or not."""
    said = dmbench("leaderboard", "check", str(file), "--quick", "--json")
    verdicts = json.loads(said.out)["verdicts"] if said.out else []
    if not verdicts and not said.code:
        raise Fault("no sentence", "the check says nothing")
    return "holds" if not said.code else "not"


def _built(folder: Path, out: Path) -> Any:
    """A page with everybody's entries, in which nothing of an entry is markup."""
    dmbench("leaderboard", "build", "--entries", str(folder), "--out", str(out), "--json").json()
    page = (out / "index.html").read_text()
    if MARKUP in page or "<script>alert" in page:
        raise Fault("markup", "an entry's text stands in the page as markup")
    return None


def figures_of(file: Path) -> Any:
    try:
        content = json.loads(file.read_bytes())
        return {name: content[name] for name in ("figures", "by_episode", "samples", "weights")}
    except (ValueError, KeyError, RecursionError, TypeError):
        return None


def same_figures(one: Any, other: Any) -> bool:
    """Equal up to rounding."""
    if isinstance(one, dict) and isinstance(other, dict):
        return one.keys() == other.keys() and all(same_figures(one[name], other[name]) for name in one)
    if isinstance(one, list) and isinstance(other, list):
        return len(one) == len(other) and all(map(same_figures, one, other))
    if isinstance(one, int | float) and isinstance(other, int | float):
        return math.isclose(one, other, rel_tol=SLACK, abs_tol=SLACK)
    return bool(one == other)


def _rename_shared(spoilt: SpoiltEntry, file: Path, data: bytes) -> None:
    """Under its own hash, which the entry names."""
    digest = hashlib.sha256(data).hexdigest()
    (file.parent / f"{digest}.json").write_bytes(data)
    measured = next(spoilt.folder.glob(f"{RUN}*.json"))
    measured.write_bytes(measured.read_bytes().replace(file.stem.encode(), digest.encode()))


def _spoil_picture(case: Case, data: bytes) -> tuple[bytes, str]:
    """A picture of an entry: its PNG, or where it says to be from."""
    import base64

    try:
        content = json.loads(data)
        picture = pick(case.rng, content["pictures"])
        name = pick(case.rng, [name for name in picture if isinstance(picture[name], str)])
        raw = base64.b64decode(picture[name])
        spoilt = pick(
            case.rng,
            (
                spoil_bytes(case.rng, raw)[0],
                _png(2**31 - 1, 2**31 - 1),
                _png(60_000, 60_000),
                _png(0, 0),
                b"GIF89a" + raw,
            ),
        )
        picture[name] = base64.b64encode(spoilt).decode() if case.chance(0.8) else pick(case.rng, HOSTILE)
        return json.dumps(content).encode(), f"picture {name}"
    except (ValueError, KeyError, TypeError, IndexError, RecursionError):
        return spoil_bytes(case.rng, data)


def _png(width: int, height: int) -> bytes:
    """The head of a picture of that size, with nothing behind it."""
    import struct
    import zlib

    head = b"IHDR" + struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rest = b"IDAT" + zlib.compress(bytes(1 << 20), 9)
    parts = [
        struct.pack(">I", len(one) - 4) + one + struct.pack(">I", zlib.crc32(one)) for one in (head, rest, b"IEND")
    ]
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)
