"""The commands that are killed: what each needs, how it is called, and what it leaves behind."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path

from tests.kill.contents import Content, files, report, training

DMBENCH = (sys.executable, "-c", "from dmotion_bench.cli import main; main()")
ROOT = Path(__file__).parents[2]
QUICK = ("--set", "batch_size=8", "--set", "precision=float32")


@dataclass(frozen=True, kw_only=True)
class Scenario:
    """A command.

    Attributes:
        name: Of it.
        words: After ``dmbench``; or the whole command line where it begins with Python.
        needs: Files and folders of the base that it needs.
        outcome: What is compared.
        says: Whether what it prints is the outcome, too; without times.
        without: Folders of these that it has to make again, such as a cache.
    """

    name: str
    words: tuple[str, ...]
    needs: tuple[str, ...]
    outcome: Callable[[Path], Content]
    says: bool = False
    without: tuple[str, ...] = ()

    @property
    def command(self) -> tuple[str, ...]:
        """The whole command line."""
        return self.words if self.words[0] == sys.executable else (*DMBENCH, *self.words)

    def prepare(self, base: Path, workspace: Path) -> None:
        """Put what it needs into a new workspace."""
        workspace.mkdir(parents=True)
        for name in self.needs:
            source, place = base / name, workspace / name
            place.parent.mkdir(parents=True, exist_ok=True)
            shutil.copytree(source, place) if source.is_dir() else shutil.copyfile(source, place)
        for name in self.without:
            shutil.rmtree(workspace / name, ignore_errors=True)


RECORD = (
    "record",
    "grid_world",
    "--preset",
    "tiny",
    "--frames",
    "10",
    "--tasks",
    "3",
    "--workers",
    "2",
    "--out",
    "data/new",
)
TRAIN = ("train", "lapo", "--data", "data/walk-tiny", "--set", "epochs=12", "--set", "validations=12", *QUICK)
WORLD = (
    "train",
    "wm-ae",
    "--labels",
    "100%",
    "--data",
    "data/walk-tiny",
    "--set",
    "epochs=3",
    "--set",
    "validations=8",
)
TRAIN_PUSHES = ("train", "cswm", "--labels", "100%", "--data", "data/grid-tiny", "--set", "epochs=0.2", *QUICK)
IMPORT = ("data", "import", "camera.mcap", "--actions", "/action", "--size", "32", "--frames-per-episode", "10")

SCENARIOS: tuple[Scenario, ...] = (
    Scenario(
        name="record",
        words=(*RECORD, "--episodes", "90"),
        needs=(),
        outcome=lambda workspace: files(workspace, "data/new"),
    ),
    Scenario(
        name="extend",
        words=(*RECORD, "--episodes", "90"),
        needs=("data/new",),
        outcome=lambda workspace: files(workspace, "data/new"),
    ),
    Scenario(
        name="import",
        words=(*IMPORT, "--out", "data/imported"),
        needs=("camera.mcap",),
        outcome=lambda workspace: files(workspace, "data/imported"),
    ),
    Scenario(
        name="train",
        words=(*TRAIN, "--out", "runs/new"),
        needs=("data/walk-tiny",),
        without=("data/walk-tiny/cache",),
        outcome=lambda workspace: training(workspace, "new"),
    ),
    Scenario(
        name="train in phases",
        words=(*WORLD, "--set", "validations=8", "--out", "runs/new"),
        needs=("data/walk-tiny",),
        outcome=lambda workspace: training(workspace, "new"),
    ),
    Scenario(
        name="score",
        words=("score", "pushes", "--horizon", "4", "--json"),
        needs=("data/grid-tiny", "runs/pushes/run.json", "runs/pushes/best.safetensors"),
        without=("data/grid-tiny/cache",),
        outcome=lambda workspace: report(workspace, "pushes"),
    ),
    Scenario(
        name="score control",
        words=(sys.executable, "-m", "tests.kill.short_control", "runs/pushes"),
        needs=("data/grid-tiny", "runs/pushes/run.json", "runs/pushes/best.safetensors"),
        outcome=lambda workspace: report(workspace, "pushes"),
    ),
    Scenario(
        name="score references",
        words=("score", "idle", "random", "scripted", "--metrics", "control", "--json"),
        needs=("data/grid-tiny",),
        outcome=lambda workspace: files(workspace, "data/grid-tiny"),
        says=True,
    ),
    Scenario(
        name="plan",
        words=("plan", "pushes", "--task", "1", "--steps", "2", "--planner", "exhaustive", "--json"),
        needs=("data/grid-tiny", "runs/pushes/run.json", "runs/pushes/best.safetensors"),
        outcome=lambda workspace: {},
        says=True,
    ),
    Scenario(
        name="board",
        words=("leaderboard", "build", "--json"),
        needs=("data/grid-tiny", "data/walk-tiny", "runs/pushes", "runs/walks"),
        outcome=lambda workspace: files(workspace, "reports"),
        says=True,
    ),
)


GRID = ("record", "grid_world", "--preset", "tiny", "--episodes", "40", "--tasks", "3", "--out", "data/grid-tiny")
MADE: dict[str, tuple[tuple[tuple[str, ...], ...], tuple[str, ...]]] = {
    "data/new": (((*RECORD, "--episodes", "30"),), ()),
    "data/grid-tiny": ((GRID,), ()),
    "runs/pushes": (
        ((*TRAIN_PUSHES, "--out", "runs/pushes"), ("score", "pushes", "--horizon", "4")),
        ("data/grid-tiny",),
    ),
    "runs/walks": (
        (
            ("train", "lapo", "--data", "data/walk-tiny", "--set", "epochs=2", *QUICK, "--out", "runs/walks"),
            ("score", "walks", "--horizon", "2"),
        ),
        ("data/walk-tiny",),
    ),
}
"""What dmbench makes for the commands: with which commands, in order, and of what else."""


def make_base(base: Path, scenarios: Iterable[Scenario]) -> None:
    """All that these commands need, made by dmbench without any disturbance."""
    base.mkdir(parents=True)
    needs = {name for scenario in scenarios for name in scenario.needs}
    for name, (_, above) in reversed(MADE.items()):
        if any(need == name or need.startswith(f"{name}/") for need in needs):
            needs |= {name, *above}
    if "camera.mcap" in needs:
        _make_camera(base / "camera.mcap")
    if "data/walk-tiny" in needs:
        _make_walks(base / "data" / "walk-tiny")
    for name, (commands, _) in MADE.items():
        for words in commands if name in needs else ():
            done = subprocess.run(
                (*DMBENCH, *words), cwd=base, env=environment(base), capture_output=True, text=True, check=False
            )
            if done.returncode:
                raise RuntimeError(f"{' '.join(words)}: {done.stderr}")


def _make_camera(file: Path) -> None:
    """A recording of another system."""
    sys.path.insert(0, str(ROOT / "tests"))
    from storage.foreign import foxglove_file, steady, video

    count = 600
    actions = [(t_ns, ("left", "right")[number % 2]) for number, t_ns in enumerate(steady(count))]
    foxglove_file(file, video(count, 48, 48), steady(count), actions=actions)


def _make_walks(path: Path) -> None:
    """A data set of an environment that is not installed."""
    sys.path.insert(0, str(ROOT / "tests"))
    from walking_square import record_walks

    record_walks(path, episodes=12, frames=6)


def environment(workspace: Path) -> dict[str, str]:
    """Of every command: its workspace, one thread."""
    return os.environ | {
        "DMBENCH_WORKSPACE": ".",
        "OMP_NUM_THREADS": "1",
        "PYTHONPATH": str(ROOT),
        "HOME": str(workspace),
    }


def said(out: str) -> Content:
    """What a command printed."""
    return {"said": json.loads(out.strip().splitlines()[-1])}
