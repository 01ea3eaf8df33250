"""Runs: ``run.json``, the three checkpoints, the curves, the report and its samples."""

from __future__ import annotations

import contextlib
import hashlib
import itertools
import json
import os
import shutil
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar
from unittest import mock

import pyarrow as pa
import torch

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.report import read_report, read_report_samples
from dmotion_bench.viewing.curves import read_curves
from dmotion_bench.viewing.report import report_tab, telling_episodes
from tests.fuzz.case import Answers, Case, Checksums, Probe
from tests.fuzz.command import dmbench
from tests.fuzz.mutations import pick
from tests.fuzz.mutations.json_text import spoil_json, spoil_lines
from tests.fuzz.mutations.parquet_table import spoil_parquet
from tests.fuzz.mutations.plain import spoil_bytes
from tests.fuzz.mutations.weights import spoil_weights
from tests.fuzz.targets import Target, copied
from tests.fuzz.worlds import MOVES, NAMED, write_noise

DATA = "noise-tiny"
WORDS = {
    "video": ("fuzz-small",),
    "world": ("fuzz-world", "--labels", "100%"),
    "moves": ("fuzz-world", "--labels", "100%"),
    "begun": ("fuzz-small",),
    "begun-world": ("fuzz-world", "--labels", "100%"),
}
"""How each original is trained; the last two are interrupted."""

STOPPED_AT = {"begun": 3, "begun-world": 2}
"""Steps after which a training is interrupted: before the last validation, and at the end of the first phase."""


@dataclass
class SpoiltRun:
    """A workspace with one run, its name, and the files that were spoilt."""

    path: Path
    original: str
    files: list[str]


class RunTarget(Target):
    """See above."""

    name: ClassVar[str] = "run"
    share: ClassVar[int] = 4

    def make(self) -> None:
        """Three finished and scored runs and two that were interrupted, in a workspace each."""
        for name, words in WORDS.items():
            workspace = self.originals / name
            write_noise(workspace / "data" / DATA, MOVES if name == "moves" else NAMED).cache()
            os.environ["DMBENCH_WORKSPACE"] = str(workspace)
            train = ("train", *words, "--out", str(workspace / "runs" / name))
            if name in STOPPED_AT:
                with _interrupted(STOPPED_AT[name]):
                    assert dmbench(*train, "--set", "validations=20", allowed=(130,)).code == 130
            else:
                dmbench(*train).done()
                dmbench("score", name, "--horizon", "2").done()

    def names(self) -> list[str]:
        return list(WORDS)

    def intact(self, case: Case, name: str) -> SpoiltRun:
        copied(self.originals / name, case.folder)
        return SpoiltRun(case.folder / "runs" / name, name, [])

    def spoil(self, case: Case) -> SpoiltRun:
        case.folder.rmdir()
        spoilt = self.intact(case, pick(case.rng, ("video", "video", "world", "moves", "begun", "begun-world")))
        for _ in range(int(case.rng.choice([1, 1, 1, 2]))):
            self._spoil_file(case, spoilt)
        if case.checksums is not Checksums.KEPT:
            forge(spoilt.path, everything=case.checksums is Checksums.ALL)
        return spoilt

    def _spoil_file(self, case: Case, spoilt: SpoiltRun) -> None:
        kinds = (
            ("run.json",) * 4
            + ("best.safetensors",) * 3
            + ("last.safetensors",) * 3
            + ("watched.safetensors", "metrics.jsonl", "metrics.jsonl")
        )
        kinds += ("report/report.json",) * 3 + ("report/samples.parquet",) * 3 + ("samples",)
        name = pick(case.rng, kinds)
        file = spoilt.path / name
        if name == "samples" and (pictures := sorted(file.glob("*"))):
            file = pick(case.rng, pictures)
            name = f"samples/{file.name}"
        if not file.is_file():
            name = "last.safetensors" if spoilt.original in STOPPED_AT else "run.json"
            file = spoilt.path / name
        if case.chance(0.05):
            kind = pick(case.rng, ("gone", "folder", "link"))
            file.unlink(missing_ok=True)
            if kind == "folder":
                file.mkdir()
            elif kind == "link":
                file.symlink_to("/nonexistent/file")
            case.tell(name, kind)
            spoilt.files.append(name)
            return
        spoil = {
            ".json": spoil_json,
            ".jsonl": spoil_lines,
            ".safetensors": spoil_weights,
            ".parquet": spoil_parquet,
        }.get(file.suffix, spoil_bytes)
        before = file.read_bytes() if file.is_file() else b""
        after, told = spoil_bytes(case.rng, before) if case.chance(0.25) else spoil(case.rng, before)
        if file.is_dir() or file.is_symlink():
            return
        file.write_bytes(after)
        case.tell(name, told)
        if after != before:
            spoilt.files.append(name)

    def probes(self, case: Case, spoilt: SpoiltRun) -> Iterator[Probe]:
        path = spoilt.path
        os.environ["DMBENCH_WORKSPACE"] = str(case.folder)
        opened: list[Run] = []

        def open_it() -> Any:
            opened.append(Run.open(path))
            return {"spec": opened[0].spec, "result": opened[0].result}

        yield Probe("open", open_it)
        yield Probe("list", lambda: dmbench("list", "runs", "--json").json() and None)
        yield Probe("listed", lambda: dmbench("list", "runs").code)
        if opened:
            run = opened[0]
            yield Probe("weights", lambda: checkpoint.weights_hash(run.weights()))
            yield Probe("model", partial(_prediction, run))
        yield Probe(
            "curves", lambda: {name: (one.step, one.value) for name, one in read_curves(path / "metrics.jsonl").items()}
        )
        yield Probe("report", lambda: read_report(path / "report"))
        yield Probe("samples", partial(_samples, path / "report"))
        yield Probe("telling", lambda: telling_episodes(path))
        yield Probe("tab", lambda: report_tab(path) and None)
        if case.chance(0.15):
            yield Probe("view", lambda: dmbench("view", str(path), "--save", str(case.folder / "a.rrd")).code and None)
        if case.chance(0.3):
            words = ("--out", str(case.folder / "board"), "--json")
            yield Probe("build", lambda: dmbench("leaderboard", "build", path.name, *words).json() and None)
        if case.chance(0.2):
            yield Probe(
                "board check", lambda: dmbench("leaderboard", "check", str(path), "--quick", "--json").code and None
            )
        if case.chance(0.2):
            other = [word if word != "100%" else "10%" for word in WORDS[spoilt.original]]
            other += ["--labels", "none"] if other[0] == "fuzz-small" else []
            yield Probe(
                "twin",
                lambda: dmbench("train", *other, "--out", str(case.folder / "runs" / "twin"), "--json").json() and None,
            )
        if spoilt.original in STOPPED_AT or case.chance(0.3):
            yield Probe("train", partial(_trained, path, spoilt.original))
            if case.chance(0.5):
                yield Probe(
                    "score",
                    lambda: dmbench("score", path.name, "--horizon", "2", "--json").json()["reports"][0]["figures"],
                )

    def judge(
        self, case: Case, spoilt: SpoiltRun, answers: Answers, reference: dict[str, Any]
    ) -> Iterator[tuple[str, str]]:
        original, spoilt_files = reference[spoilt.original], set(spoilt.files)
        kept = ["weights", "model"]
        if "run.json" not in spoilt_files:
            kept += ["open", "train", "score"]
        elif case.checksums is not Checksums.ALL:
            kept.remove("model")  # what is built of the weights stands in run.json
        if "report/report.json" not in spoilt_files:
            kept += ["report", "samples", "telling"]
        if case.checksums is Checksums.ALL:
            return
        for name in kept:
            answer, wanted = answers.get(name), original.get(name)
            if answer is None or answer.value is None or wanted is None or answer.value == wanted.value:
                continue
            if name in ("samples", "telling") and answer.value in ("None", EMPTY):
                continue  # they are gone, which is said
            if name == "train" and wanted.value is None:
                continue
            yield "wrong content", f"{name} differs from the original's, of {' and '.join(sorted(spoilt_files))}"


EMPTY = hashlib.sha256(b"").hexdigest()[:24]


def _prediction(run: Run) -> Any:
    """Of fixed frames, by the trained model."""
    frames = torch.linspace(-1, 1, 2 * 3 * 16 * 16).reshape(2, 3, 16, 16)
    with torch.no_grad():
        actions = torch.tensor([0, 1]) if isinstance(run.spec.inputs.actions, Discrete) else torch.zeros(2, 2)
        return run.model.predict(frames, frames.flip(2), actions).numpy()


def _samples(folder: Path) -> Any:
    report = read_report(folder)
    samples = None if report is None else read_report_samples(folder, report)
    if samples is None:
        return None
    written = pa.BufferOutputStream()
    with pa.ipc.new_stream(written, samples.schema) as stream:
        stream.write_table(samples.combine_chunks())
    return hashlib.sha256(written.getvalue()).hexdigest()


def _trained(path: Path, original: str) -> str:
    """The weights that the training ends with when its command is given again."""
    more = ("--set", "validations=20") if original in STOPPED_AT else ()
    dmbench("train", *WORDS[original], *more, "--out", str(path), "--json").json()
    return checkpoint.weights_hash(Run.open(path).weights())


def forge(path: Path, *, everything: bool) -> None:
    """Make the hashes in ``run.json`` and ``report.json`` fit the files, as far as they can be read."""
    if not everything:
        return
    try:
        tensors, _ = checkpoint.load(path / "best.safetensors")
        weights = checkpoint.weights_hash(checkpoint.without_prefix("model", tensors))
        manifest = json.loads((path / "run.json").read_bytes())
        if manifest["result"]:
            manifest["result"]["weights"] = weights
            (path / "run.json").write_text(json.dumps(manifest, indent=2))
        report = json.loads((path / "report/report.json").read_bytes())
        report["weights"] = weights
        report["samples"]["sha256"] = hashlib.sha256((path / "report/samples.parquet").read_bytes()).hexdigest()
        (path / "report/report.json").write_text(json.dumps(report, indent=2))
    except Exception:  # forged as far as it goes
        return


@contextlib.contextmanager
def _interrupted(after: int) -> Iterator[None]:
    """Ctrl-C after so many steps of a training."""
    from dmotion_bench.learning.training.state import TrainingState

    tell, steps = TrainingState.report, itertools.count(1)

    def report(*told: Any) -> Any:
        if next(steps) == after:
            os.kill(os.getpid(), 2)
        return tell(*told)

    with mock.patch.object(TrainingState, "report", report):
        yield


def remove(path: Path) -> None:
    """A folder that may not be there."""
    shutil.rmtree(path, ignore_errors=True)
