"""An entry of a world whose control pictures judge holds as any other does, and a changed action in it is found."""

from __future__ import annotations

import copy
from typing import Any

import pytest
import strange_worlds
from known_model import stands_for_every_model, write_run

from dmotion_bench.learning.runs.manifest import stored_actions
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.build import entry_of_run
from leaderboard.check import CheckSettings, check_entry
from leaderboard.entry import Entry
from leaderboard.sources import labels_of

strange_worlds.register()
SLIDER = "gym:Strange/Slider-v0"
SCORING = ControlScoring(tasks=2, steps=3, group=2, planner_set=("samples=4", "horizon=2", "iterations=1", "elites=2"))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    stands_for_every_model(monkeypatch)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A run in a world that tells no positions, scored for predictions and control; read only."""
    made = Workspace(tmp_path_factory.mktemp("pictures"))
    recipe = recipe_for(SLIDER, Preset.TINY, episodes=14, frames=12, tasks=2, size=64, settings=("places=30",), seed=3)
    record_dataset(made.data / "slider", recipe)
    dataset = Dataset.open(made.data / "slider")
    with pytest.MonkeyPatch.context() as patch:
        stands_for_every_model(patch)
        spec = dataset.spec
        changes = {"actions": stored_actions(spec.actions), "height": spec.height, "width": spec.width}
        run = write_run(made.runs / "known", dataset, **changes)
        given = labels_of(run.spec, dataset)
        run.finish({**(run.result or {}), "labels": given, "labels_total": sum(given.values())})
        score_run(
            run.path,
            metrics=("prediction", "control"),
            settings=ScoreSettings(resamples=100, control=SCORING),
        )
    return made


@pytest.mark.slow
def test_a_sound_entry_holds(workspace: Workspace) -> None:
    entry = entry_of_run(workspace.runs / "known")
    assert "control_picture_distance[3]" in entry.figures
    assert [len(one["actions"].split()) for one in entry.content["control"]["model"]] == [3, 3]
    sums = entry.by_episode["control_picture_distance[3]"]
    assert sum(sums["sum"]) / sum(sums["n"]) == pytest.approx(entry.figures["control_picture_distance[3]"]["mean"])

    for score in (True, False):
        verdict = check_entry(entry, workspace, CheckSettings(score=score))
        assert (verdict.findings, verdict.missing) == ((), ())


def test_a_changed_action_is_found(workspace: Workspace) -> None:
    content: dict[str, Any] = copy.deepcopy(dict(entry_of_run(workspace.runs / "known").content))
    task = content["control"]["model"][1]
    first, *others = task["actions"].split()
    task["actions"] = " ".join([str(1 - int(first)), *others])

    findings = check_entry(Entry(content), workspace, CheckSettings(score=False)).findings
    assert any("of the control of model are not what happens: task 1, step 0" in one for one in findings), findings
