"""Recordings of other systems, on their way through ``data import``."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from dmotion_bench.storage.dataset import Dataset
from tests.fuzz.case import Answers, Case, Checksums, Fault, Probe
from tests.fuzz.command import dmbench
from tests.fuzz.foreign import SIDE, VIDEOS, makers
from tests.fuzz.mutations import pick
from tests.fuzz.mutations.boxes import spoil_video
from tests.fuzz.mutations.hdf5_file import spoil_hdf5
from tests.fuzz.mutations.json_text import spoil_json, spoil_lines
from tests.fuzz.mutations.mcap_file import spoil_mcap
from tests.fuzz.mutations.parquet_table import spoil_parquet
from tests.fuzz.mutations.plain import spoil_bytes
from tests.fuzz.targets import Target
from tests.fuzz.targets.dataset import frames_of


@dataclass
class SpoiltRecording:
    """A foreign file or folder, the original that it is a copy of, the import's options, and what was spoilt."""

    path: Path
    original: str
    options: tuple[str, ...]
    files: list[str] = field(default_factory=list)


class RecordingTarget(Target):
    """See above."""

    name: ClassVar[str] = "recording"
    share: ClassVar[int] = 5

    def make(self) -> None:
        """One of each kind, and beside it the frames that come of it."""
        for name, maker in makers().items():
            folder = self.originals / name
            folder.mkdir(parents=True)
            made = maker(folder)
            (folder / "made.json").write_text(json.dumps({"name": str(made.relative_to(folder))}))
            for options in OPTIONS[name]:
                out = folder / "imported"
                dmbench("data", "import", str(made), *_common(options), "--out", str(out), "--json").json()
                frames = json.loads((folder / "frames.json").read_text()) if (folder / "frames.json").exists() else []
                (folder / "frames.json").write_text(json.dumps(sorted({*frames, *frames_of(out)})))
                shutil.rmtree(out)

    def names(self) -> list[str]:
        return list(OPTIONS)

    def intact(self, case: Case, name: str) -> SpoiltRecording:
        folder = self.originals / name
        made = folder / json.loads((folder / "made.json").read_text())["name"]
        to = case.folder / made.name
        if made.is_dir():
            shutil.copytree(made, to, copy_function=shutil.copyfile)
        else:
            shutil.copyfile(made, to)
        return SpoiltRecording(to, name, OPTIONS[name][0])

    def spoil(self, case: Case) -> SpoiltRecording:
        spoilt, rng = self.intact(case, pick(case.rng, self.names())), case.rng
        spoilt.options = (*pick(rng, OPTIONS[spoilt.original]), *pick(rng, MORE))
        case.told.append(" ".join(spoilt.options))
        files = (
            [spoilt.path]
            if spoilt.path.is_file()
            else sorted(path for path in spoilt.path.rglob("*") if path.is_file())
        )
        for _ in range(int(rng.choice([1, 1, 1, 2]))):
            file = pick(rng, files)
            if not file.is_file():
                continue
            name = file.name if spoilt.path.is_file() else str(file.relative_to(spoilt.path))
            if spoilt.path.is_dir() and case.chance(0.05):
                file.unlink()
                case.tell(name, "gone")
                spoilt.files.append(name)
                continue
            before = file.read_bytes()
            after, told = spoil_bytes(rng, before) if case.chance(0.3) else self._spoiler(case, file)(rng, before)
            file.write_bytes(after)
            case.tell(name, told)
            if after != before:
                spoilt.files.append(name)
        return spoilt

    @staticmethod
    def _spoiler(case: Case, file: Path) -> Callable[..., tuple[bytes, str]]:
        return {
            ".mcap": partial(spoil_mcap, mend=case.checksums is not Checksums.KEPT),
            ".json": spoil_json,
            ".jsonl": spoil_lines,
            ".parquet": spoil_parquet,
            ".mp4": spoil_video,
            ".hdf5": spoil_hdf5,
        }.get(file.suffix, spoil_bytes)

    def probes(self, case: Case, spoilt: SpoiltRecording) -> Iterator[Probe]:
        os.environ["DMBENCH_WORKSPACE"] = str(case.folder)
        out = case.folder / "imported"
        words = ("data", "import", str(spoilt.path), *_common(spoilt.options), "--out", str(out), "--json")
        before = sorted(case.folder.iterdir())
        done: list[Any] = []
        yield Probe("import", lambda: done.append(dmbench(*words).json()))
        if not done:
            yield Probe("left behind", partial(_nothing_left, case.folder, before))
            return
        yield Probe("check", lambda: dmbench("data", "check", str(out), "--json").json()["sound"])
        yield Probe("frames", partial(_known_frames, out, self.originals / spoilt.original / "frames.json"))
        yield Probe("info", lambda: dmbench("data", "info", str(out), "--json").json() and None)

    def judge(
        self, case: Case, spoilt: SpoiltRecording, answers: Answers, reference: dict[str, Any]
    ) -> Iterator[tuple[str, str]]:
        for name in ("check", "frames", "info"):
            if name in answers and answers[name].sentence is not None:
                yield "unusable", f"what was imported cannot be used: {answers[name].sentence}"
        frames = answers.get("frames")
        if frames is not None and frames.value == repr("others") and self._is_guarded(case, spoilt):
            yield "wrong content", f"frames that the recording did not hold, of {spoilt.original}"

    @staticmethod
    def _is_guarded(case: Case, spoilt: SpoiltRecording) -> bool:
        """Whether checksums within the file tell every change of a picture."""
        return case.checksums is Checksums.KEPT and spoilt.original in GUARDED


def _common(options: tuple[str, ...]) -> tuple[str, ...]:
    return ("--size", str(SIDE), *options)


def _known_frames(path: Path, known: Path) -> str:
    dataset = Dataset.open(path)
    found = frames_of(path)
    for episode in range(len(dataset)):
        if dataset.spec.actions:
            dataset.labels(episode)
    dataset.cache()
    return "known" if found <= set(json.loads(known.read_text())) else "others"


def _nothing_left(folder: Path, before: list[Path]) -> None:
    left = sorted(set(folder.iterdir()) - set(before))
    if left:
        raise Fault("left behind", ", ".join(path.name for path in left))


OPTIONS: dict[str, tuple[tuple[str, ...], ...]] = {
    "foxglove": ((), ("--actions", "/action"), ("--camera", "/camera", "--fit", "pad")),
    "bgra": ((),),
    "json": ((),),
    "jpeg": ((),),
    "png": ((),),
    "ros": ((), ("--actions", "/action")),
    "ros-compressed": ((),),
    "lerobot": ((), ("--actions", "action")),
    "pictures": ((),),
    "packed": ((), ("--actions", "/action")),
    "stream": ((),),
    "hdf5": ((), ("--actions", "actions"), ("--camera", "obs/agentview_image")),
    **{f"{kind}.{suffix}": ((),) for kind, suffix in VIDEOS},
}
"""The options that each original can be imported with."""

MORE = (
    *((), (), (), ("--salvage",), ("--salvage",), ("--clock", "header"), ("--clock", "header", "--salvage")),
    *(("--hz", "3"), ("--hz", "60"), ("--max-gap", "0.5"), ("--max-gap", "1e6"), ("--frames-per-episode", "5")),
)
"""Options beside these."""

GUARDED = ("foxglove", "bgra", "json", "jpeg", "png")
"""Originals whose chunks have a CRC-32."""
