"""Every command of the README and the docs, run from top to bottom of its page as a reader types it, only shorter.

What makes it short: recordings of 13 short episodes, trainings of a step or two, one row of the table of all models, a
planner of two candidates, pictures written to files where the command would open a window. Nothing else of a command
is changed (``_shortened``).
"""

from __future__ import annotations

import shlex
import shutil
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from dmbench_command import dmbench
from known_model import result_of
from storage.foreign import foxglove_file, steady, video
from test_documentation import PAGES, ROOT, _commands, _is_example

from dmotion_bench.api import demonstration
from dmotion_bench.api import scoring as api_scoring
from dmotion_bench.learning import checkpoint, start, table
from dmotion_bench.learning.start import TrainingRequest, open_run
from dmotion_bench.planning.solvers.cem import CrossEntropy
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.score import ScoreSettings, score_run
from dmotion_bench.specs import Preset, Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace

pytestmark = pytest.mark.slow

EPISODES, FRAMES = 13, 16  # the docs name episode 12
READ = [page for page in PAGES if page.name == "README.md" or page.parent.name == "docs"]
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
    "--executor ray": "tests/execution/test_executors.py",
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
    "dmbench plan",
    "dmbench view",
)
"""Named in a sentence, to be completed by the reader."""


def _shorter_training(settings: Any, config: Any, training: Any) -> Any:
    config, training = _with_settings(settings, config, training)
    return config, replace(training, epochs=0.01, batch_size=4, validations=1)


_with_settings = start.with_settings


TWO = CrossEntropy(samples=2, horizon=1, iterations=1, elites=1)
_control_scoring = api_scoring.control_scoring


def _two_steps(*asked: Any, **more: Any) -> ControlScoring:
    return replace(_control_scoring(*asked, **more), steps=2)


def _shorten(patch: pytest.MonkeyPatch) -> None:
    patch.setattr(start, "with_settings", _shorter_training)
    patch.setattr(table, "model_names", lambda: ["dmotion"])
    patch.setitem(table.BUDGETS, Supervision.NONE, ("one-shot",))
    patch.setattr("dmotion_bench.planning.choices.make_solver", lambda name, settings=(): TWO)
    patch.setattr("dmotion_bench.scoring.control.make_solver", lambda name, settings=(): TWO)
    patch.setattr(api_scoring, "control_scoring", _two_steps)
    patch.setattr("dmotion_bench.planning.columns.TEST_TASKS", {})  # a shorter recording has other tasks
    patch.setattr("baselines.dmotion_paper.MAP_SIZE", 16)  # of 64: its layers are most of what a scoring computes
    patch.setattr(demonstration, "EPISODES", 12)
    patch.setattr(demonstration, "EPOCHS", 0.01)
    patch.delenv("DMBENCH_WORKSPACE", raising=False)


def _shortened(command: str) -> list[str]:
    """The words of a command, with what makes it short, and a file in place of a window."""
    words = shlex.split(f"{command} {COMPLETED.get(command, '')}")[1:]
    match words:
        case ["record", *_]:
            words += ["--episodes", str(EPISODES), "--frames", str(FRAMES), "--tasks", "4"]
        case ["score", *_]:
            words += ["--tasks", "1"] if {"control", "--column"} & set(words) else ["--horizon", "4"]
            words += ["--workers", "1"] if "--all" in words else []  # others do not know the shortened planner
        case ["plan", *_]:
            words += ["--steps", "2"]
        case ["bench", *_]:
            words += ["--only", "find_centres", "--seconds", "0.1"]
    if words[0] in ("train", "record") and "--live" in words:
        words[words.index("--live") : words.index("--live") + 1] = ["--live-to", "live.rrd"]
    elif words[0] in ("view", "plan") and "--save" not in words:
        words += ["--save", "shown.rrd"]
    return words


@pytest.fixture(scope="module")
def template(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """What a reader has who comes to a page: the data sets and runs that it names, and recordings of a robot."""
    root = tmp_path_factory.mktemp("reader")
    workspace = Workspace(root)
    with pytest.MonkeyPatch.context() as patch:
        _shorten(patch)
        patch.chdir(root)
        for environment, preset in RECORDED:
            recipe = recipe_for(environment, Preset(preset), episodes=EPISODES, frames=FRAMES, tasks=4)
            record_dataset(workspace.data / f"{environment}-{preset}", recipe)
        for model, name in TRAINED:
            labels = "100%" if model == "ed-cnn" else "one-shot"
            dataset = Dataset.open(workspace.data / name)
            run = open_run(TrainingRequest(model=model, labels=labels), dataset, None, Workspace(Path()))
            weights = run.spec.build().state_dict()
            checkpoint.save(run.best, checkpoint.with_prefix("model", weights), {})
            run.finish(result_of(weights))
            if name == "grid_world-small":
                score_run(run.path, settings=ScoreSettings(horizon=4))
        (root / "recordings").mkdir()
        for number in range(10):
            file = root / f"recordings/{number}.mcap"
            foxglove_file(file, video(12, seed=number), steady(12), topic="/camera/image_raw")
        yield root


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
    for command in dict.fromkeys(filter(_is_example, _commands(page))):
        own = next((test for part, test in ELSEWHERE.items() if part in command), None)
        if own is not None:
            assert (ROOT / own).is_file()
        elif command not in MENTIONED:
            outcome = dmbench(_shortened(command), capsys, monkeypatch)
            assert outcome.code == 0, f"{page.name}: {command}\n{outcome.out}\n{outcome.err}"
