"""Anyone's model, solver and objective: the guides' packages are built, installed, found, checked and used."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import pytest
from noise_world import noise_episode, noise_spec

from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter

pytestmark = pytest.mark.slow

GUIDE = Path(__file__).parents[1] / "docs" / "your_model.md"
COMMAND = "from dmotion_bench.cli import main; main()"
ASK = """
import sys, torch
from pathlib import Path
from dmotion_bench.learning.runs.run import Run

model = Run.open(Path(sys.argv[1])).model
frames = torch.rand(2, 3, 32, 32, generator=torch.Generator().manual_seed(0)) * 2 - 1
with torch.no_grad():
    one, other = (model.predict(frames, frames, torch.full((2,), action)) for action in range(2))
print(type(model).__module__, tuple(one.shape), torch.equal(one, other))
"""


CHECKED = "test_bright.test_the_contracts_are_kept()"
NO_GOAL = "Brightness: a state at the goal costs no less than one at the start"  # the guide says so
PLANNER_GUIDE = GUIDE.with_name("your_planner.md")


def _blocks(language: str, guide: Path = GUIDE) -> list[str]:
    return re.findall(rf"```{language}\n(.*?)```", guide.read_text(), re.DOTALL)


@pytest.fixture
def shell(tmp_path: Path):
    """Runs Python with the installed package of the guide for models."""
    (tmp_path / "test_tiny.py").write_text(_blocks("python")[1])
    return _installed(tmp_path, "tiny_latents", GUIDE)


@pytest.fixture
def planner_shell(tmp_path: Path):
    """Runs Python with the installed package of the guide for planners."""
    (tmp_path / "test_bright.py").write_text(_blocks("python", PLANNER_GUIDE)[1])
    return _installed(tmp_path, "bright_planner", PLANNER_GUIDE)


def _installed(tmp_path: Path, name: str, guide: Path):
    """What runs Python with a guide's installed package on its path and a workspace of its own."""
    package, site = tmp_path / "package", tmp_path / "site"
    (package / name).mkdir(parents=True)
    (package / name / "__init__.py").write_text(_blocks("python", guide)[0])
    (package / "pyproject.toml").write_text(_blocks("toml", guide)[0])
    places = os.pathsep.join([str(site), *(path for path in sys.path if path)])
    environment = os.environ | {"PYTHONPATH": places, "DMBENCH_WORKSPACE": str(tmp_path), "OMP_NUM_THREADS": "1"}

    def run(*arguments: str) -> str:
        done = subprocess.run(
            [sys.executable, *arguments], cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    pip = ("-m", "pip", "install", "--quiet", "--no-deps", "--no-build-isolation", "--no-index")
    run(*pip, "--disable-pip-version-check", "--target", str(site), str(package))
    return run


def test_the_guides_model_works_from_its_own_package(shell, tmp_path: Path) -> None:
    spec = noise_spec(height=32, width=32)
    data = tmp_path / "data" / "noise-tiny"
    recipe = DatasetRecipe(environment="noise", episodes=12, frames=5, shard_episodes=12)
    with DatasetWriter.create_or_resume(data, recipe, spec) as writer:
        writer.write_shard(0, (noise_episode(number, 5, spec) for number in range(12)))
        writer.finish()

    listed = "from dmotion_bench.registry import model_names; print(*model_names())\n"
    checked = "import test_tiny; test_tiny.test_the_contract_is_kept()"
    assert "tiny-latents" in shell("-c", listed + checked).split()
    trained = shell("-c", COMMAND, "train", "tiny-latents", "--set", "epochs=1", "--set", "width=8")
    folder = Path(trained.splitlines()[0])
    assert "labels used: 2 of 48" in trained
    used = _blocks("python")[2].replace("runs/tiny-latents-grid_world-small-s0", str(folder))
    used = used.replace("data/grid_world-small", str(data))
    told = shell("-c", ASK + used + "print(pictures.dtype)", str(folder)).splitlines()
    assert (told[0], told[-1]) == ("tiny_latents (2, 3, 32, 32) False", "torch.uint8")


def test_the_guides_solver_and_objective_plan_from_their_own_package(planner_shell, tmp_path: Path) -> None:
    recipe = DatasetRecipe(environment="grid_world", policy="random", episodes=20, frames=32, tasks=2)
    record_dataset(tmp_path / "data" / "grid", recipe)
    dataset = Dataset.open(tmp_path / "data" / "grid")
    plan = ("plan", "oracle", "--data", "grid", "--steps", "3", "--planner", "straight", "--json")
    chosen = ("--planner-set", "horizon=2", "--objective", "brightness", "--objective-set", "weight=2")
    said = json.loads(planner_shell("-c", COMMAND, *plan, *chosen))
    assert said["planner"] == "straight"
    assert said["frames"] == 3 * 4 * 2
    assert len(said["actions"]) == 3
    assert dataset.tasks()
    script = (
        f"import pytest, test_bright\nwith pytest.warns(match={NO_GOAL!r}): {CHECKED}\n"
        "import json; from dmotion_bench.scoring.control import ControlScoring\n"
        "from dmotion_bench.storage.dataset import Dataset\n"
        "chosen = ControlScoring(planner='straight', objective='brightness', objective_set=('weight=2',))\n"
        "print(json.dumps(chosen.planning(Dataset.open('data/grid'), needs_pixels=True)))\n"
    )
    assert json.loads(planner_shell("-c", script)) == {
        "solver": {"name": "straight", "horizon": 5},
        "objective": {"name": "brightness", "weight": 2.0},
    }


def test_the_guides_code_is_short() -> None:
    lines = [line for line in _blocks("python")[0].splitlines() if line and not line.startswith(("from", "import"))]
    assert len(lines) <= 31
