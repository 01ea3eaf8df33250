"""Every command of the README and the docs, run from top to bottom of its page as a reader types it, only shorter.

What makes it short: recordings of 13 short episodes, trainings of a step or two, no runs but those that the page names,
one row of the table of all models, a planner of two candidates, gains of four sequences at two moments, pictures
written to files where the command would open a window. Nothing else of a command is changed (``_shortened``).

A tutorial is followed from its first line in an empty folder: its files are saved, its Python is run, its commands are
typed, and what they print is compared with what the page shows (``walk.py``).
"""

from __future__ import annotations

import contextlib
import importlib
import shlex
import shutil
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import dmbench
from known_model import result_of
from object_storage import object_storage
from pretend_slurm import use_slurm
from storage.foreign import foxglove_file, steady, video
from test_documentation import MODELS, PAGES, ROOT, _commands, _is_example
from torch import nn
from walk import BLOCK, assert_printed, run_python, save, steps

from baselines import dmotion_paper
from dmotion_bench.api import demonstration
from dmotion_bench.api import planning as api_planning
from dmotion_bench.api import scoring as api_scoring
from dmotion_bench.learning.runs import checkpoint, start
from dmotion_bench.learning.runs.start import TrainingRequest, open_run
from dmotion_bench.learning.training import table
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.gain import GainScoring, gain_tables
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import Preset, Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.sources import labels_of
from recorders.planar_push.environment import PlanarPush
from recorders.robot_push.environment import RobotPush

pytestmark = pytest.mark.slow

EPISODES = 13  # the docs name episode 12
FRAMES, GRID_FRAMES = 8, 14  # of a grid world two agents do every pair of actions, and there are four tasks
PLANNED_IN_FULL = {"own_environment"}
"""Tutorials whose Python says what planning reaches; it takes a second there."""
TUTORIALS = sorted((ROOT / "docs" / "tutorials").glob("*.md"))
READ = [*(page for page in PAGES if page.name == "README.md" or page.parent.name == "docs"), *MODELS]
RECORDED = (
    ("grid_world", "small"),
    ("grid_world", "paper"),
    ("robot_push", "small"),
    ("robot_push", "paper"),
    ("planar_push", "small"),
)
TRAINED = (
    ("dmotion", "grid_world-small"),
    ("ed-cnn", "grid_world-small"),
    ("dmotion", "grid_world-paper"),
    ("dmotion", "planar_push-small"),
    ("ed-cnn", "planar_push-small"),
)

ELSEWHERE = {
    "leaderboard serve": "tests/leaderboard/test_server.py",
    "leaderboard results": "tests/leaderboard/test_results.py",
    "tiny-latents": "tests/test_third_party.py",
    "dmbench reproduce": "tests/api/test_reproducing.py",
    "--executor ray": "tests/execution/test_executors.py",
    "--all --data planar_push-tiny --executor slurm": "tests/execution/test_executors.py",
    "--devices": "tests/cli/test_train_together.py",
    "record gym:": "tests/recorders/test_gymnasium_env.py",
    "--action-fields": "tests/storage/test_import_continuous.py",
}
"""Commands that a test of their own runs: by a part of them, where."""

COMPLETED = {
    "dmbench train dmotion": "--data grid_world-small",
    "dmbench train dmotion --live": "--data grid_world-small",
    "dmbench train dmotion --live-to training.rrd": "--data grid_world-small",
    "dmbench train dmotion --split paper": "--data grid_world-small",
    "dmbench train dmotion --labels none": "--data imported-recordings",
    "dmbench train --all": "--data grid_world-small",
    "dmbench score": "dmotion-grid_world-small-s0",
}
"""What a reader with one data set and one run may leave out; here are several."""

MENTIONED = (
    "dmbench data check",
    "dmbench data repair",
    "dmbench leaderboard check",
    "dmbench leaderboard compare RUN RUN",
    "dmbench play",
    "dmbench score --metrics control",
    "dmbench plan",
    "dmbench share",
    "dmbench share pull",
    "dmbench view",
)
"""Named in a sentence, to be completed by the reader."""


def _shorter_training(settings: Any, config: Any, training: Any) -> Any:
    config, training = _with_settings(settings, config, training)
    return config, replace(training, epochs=0.01, batch_size=4, validations=1, adaptation_steps=2)


_with_settings = start.with_settings
_conv = dmotion_paper._conv


def _tested_elsewhere(command: str) -> str | None:
    return next((test for part, test in ELSEWHERE.items() if part in command), None)


TWO = CrossEntropy(samples=2, horizon=1, iterations=1, elites=1)
_control_scoring = api_scoring.control_scoring


def _two_steps(*asked: Any, **more: Any) -> ControlScoring:
    return replace(_control_scoring(*asked, **more), steps=2)


def _few_gains(model: Any, dataset: Any, split: Any, scoring: GainScoring, how: Any) -> Any:
    return gain_tables(model, dataset, split, replace(scoring, moments=2, sequences=4), how)


def _thin_deconvolution(before: int, after: int, stride: int = 1) -> nn.Sequential:
    return nn.Sequential(nn.Upsample(scale_factor=stride), _conv(before, after, 3))


def _shorten(patch: pytest.MonkeyPatch, *, planning: bool = True) -> None:
    patch.setattr(start, "with_settings", _shorter_training)
    if planning:
        _shorten_planning(patch)
    patch.setattr(table, "model_names", lambda: ["dmotion"])
    patch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot",))
    for world in (PlanarPush, RobotPush):
        patch.setattr(world, "test_tasks", {})  # a shorter recording has other tasks
    patch.setattr("dmotion_bench.scoring.score.gain_tables", _few_gains)
    patch.setattr(dmotion_paper, "MAP_SIZE", 8)  # of 64: the layers are most of what a scoring computes
    patch.setattr(dmotion_paper, "_conv", lambda before, after, kernel=5, stride=1: _conv(before, after, 3, stride))
    patch.setattr(dmotion_paper, "_deconv", _thin_deconvolution)
    patch.setattr(demonstration, "EPISODES", 12)
    patch.setattr(demonstration, "EPOCHS", 0.01)
    patch.delenv("DMBENCH_WORKSPACE", raising=False)


def _shorten_planning(patch: pytest.MonkeyPatch) -> None:
    patch.setattr("dmotion_bench.planning.choices.make_solver", lambda name, settings=(): TWO)
    patch.setattr("dmotion_bench.scoring.control.make_solver", lambda name, settings=(): TWO)
    patch.setattr("dmotion_bench.api.planning.make_solver", lambda name, settings=(): TWO)
    for module in (api_scoring, api_planning):
        patch.setattr(module, "control_scoring", _two_steps)


def _shortened(command: str) -> list[str]:
    """The words of a command, with what makes it short, and a file in place of a window."""
    words = shlex.split(f"{command} {COMPLETED.get(command, '')}")[1:]
    match words:
        case ["record", *_] if "tiny" not in words:
            words += ["--episodes", str(EPISODES), "--frames", str(_frames(words[1])), "--tasks", "4"]
        case ["score", *_]:
            words += ["--tasks", "1"] if {"control", "--column"} & set(words) else ["--horizon", "4"]
            words += ["--workers", "1"] if "--all" in words else []  # others do not know the shortened planner
        case ["plan", *_] if "--steps" not in words:
            words += ["--steps", "2"]
        case ["bench", *_]:
            words += ["--only", "find_centres", "--seconds", "0.1"]
    if words[0] in ("train", "record") and "--live" in words:
        words[words.index("--live") : words.index("--live") + 1] = ["--live-to", "live.rrd"]
    elif words[0] in ("view", "plan") and "--save" not in words:
        words += ["--save", "shown.rrd"]
    return words


def _frames(environment: str) -> int:
    return GRID_FRAMES if environment == "grid_world" else FRAMES


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """What a reader has who comes to a page: the data sets and runs that it names, and recordings of a robot."""
    root = tmp_path_factory.mktemp("reader")
    workspace = Workspace(root)
    with pytest.MonkeyPatch.context() as patch:
        _shorten(patch)
        patch.chdir(root)
        for environment, preset in RECORDED:
            recipe = recipe_for(environment, Preset(preset), episodes=EPISODES, frames=_frames(environment), tasks=4)
            record_dataset(workspace.data / f"{environment}-{preset}", recipe)
        for model, name in TRAINED:
            labels = "100%" if model == "ed-cnn" else "one-shot"
            dataset = Dataset.open(workspace.data / name)
            run = open_run(TrainingRequest(model=model, labels=labels), dataset, None, Workspace(Path()))
            weights = run.spec.build().state_dict()
            checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
            given = labels_of(run.spec, dataset)
            run.finish(result_of(weights) | {"labels": given, "labels_total": sum(given.values())})
            if name == "grid_world-small":
                score_run(run.path, settings=ScoreSettings(horizon=4))
    (root / "recordings").mkdir()
    for number in range(10):
        file = root / f"recordings/{number}.mcap"
        foxglove_file(file, video(12, seed=number), steady(12), topic="/camera/image_raw")
    return root


@pytest.mark.parametrize("page", READ, ids=lambda page: page.name)
def test_every_command_of_a_page_runs(
    page: Path,
    template: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    _shorten(monkeypatch)
    shutil.copytree(template, tmp_path / "reader")
    monkeypatch.chdir(tmp_path / "reader")
    commands = [*dict.fromkeys(filter(_is_example, _commands(page)))]
    named = {word for command in commands for word in shlex.split(f"{command} {COMPLETED.get(command, '')}")}
    for run in Path("runs").iterdir():
        if run.name not in {*named, "dmotion-grid_world-small-s0"}:  # else commands on all runs would take minutes
            shutil.rmtree(run)
    for command in commands:
        if own := _tested_elsewhere(command):
            assert (ROOT / own).is_file()
        elif command not in MENTIONED:
            outcome = dmbench(_shortened(command), capsys, monkeypatch)
            assert outcome.code == 0, f"{page.name}: {command}\n{outcome.out}\n{outcome.err}"


def _install(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What ``pip install .`` does, into a folder of its own that this process looks into."""
    pip = ("pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index", "--target", "installed")
    subprocess.run([sys.executable, "-m", *pip, "--disable-pip-version-check", "."], cwd=folder, check=True)
    monkeypatch.syspath_prepend(str(folder / "installed"))
    importlib.invalidate_caches()


@pytest.mark.parametrize("page", TUTORIALS, ids=lambda page: page.stem)
def test_a_tutorial_can_be_followed_from_an_empty_folder(
    page: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    _shorten(monkeypatch, planning=page.stem not in PLANNED_IN_FULL)
    machines = contextlib.ExitStack()
    if page.stem == "cluster":
        use_slurm(tmp_path / "slurm", monkeypatch)
        for name, value in machines.enter_context(object_storage()).environment.items():
            monkeypatch.setenv(name, value)
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    modules, names = set(sys.modules), dict[str, Any]()
    try:
        for step in steps(page.read_text()):
            if step.kind == "file":
                save(step, tmp_path)
                importlib.invalidate_caches()
            elif step.kind == "python":
                run_python(step.text, names, page.name)
            elif step.text == "pip install .":
                _install(tmp_path, monkeypatch)
            elif step.text.startswith("export "):
                monkeypatch.setenv(*step.text.removeprefix("export ").split("=", 1))
            elif step.text.startswith("unset "):
                monkeypatch.delenv(step.text.removeprefix("unset "))
            elif own := _tested_elsewhere(step.text):
                assert (ROOT / own).is_file()
            else:
                outcome = dmbench(_shortened(step.text), capsys, monkeypatch)
                assert outcome.code == 0, f"{page.name}: {step.text}\n{outcome.out}\n{outcome.err}"
                assert_printed(step.expected, outcome.out, f"{page.name}: {step.text}")
    finally:
        machines.close()
        for name in set(sys.modules) - modules:  # the page's own, which the next page must not find
            if str(tmp_path) in str(getattr(sys.modules[name], "__file__", "")):
                del sys.modules[name]


@pytest.mark.parametrize("name", ["installation.md", "api/index.md"])
def test_python_of_a_page_runs(name: str) -> None:
    blocks = [text for kind, _, text in BLOCK.findall((ROOT / "docs" / name).read_text()) if kind == "python"]
    assert blocks
    for block in blocks:
        exec(block, {})
