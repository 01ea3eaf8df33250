"""Control by frozen columns: they are the planners that they say, on tasks that the run does not know."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import InvalidSetting, RunMismatch, UnknownName, UsageError
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning import columns
from dmotion_bench.planning.choices import make_objective, make_solver
from dmotion_bench.planning.columns import COLUMNS, PROTOCOL, TEST, TaskData, tasks_hash
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.earlier_planning import present_planning, without_later
from dmotion_bench.scoring.report import read_report
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.transfer import transfer_folders
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from recorders.grid_world import GridWorld
from recorders.planar_push.environment import PlanarPush
from recorders.robot_push.environment import RobotPush

MakeRun = Callable[..., Run]


def _recipe(**changes: Any) -> DatasetRecipe:
    usual = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", seed=5, episodes=20, frames=32, tasks=2
    )
    return replace(usual, **changes)


@pytest.fixture(scope="module")
def tasks(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """A Grid World recorded for its tasks; read only but for its cache."""
    path = tmp_path_factory.mktemp("data") / "grid-tasks"
    record_dataset(path, _recipe())
    return Dataset.open(path)


@pytest.mark.parametrize("name", COLUMNS)
def test_a_column_is_a_planner_that_can_be_made_and_nothing_beside_it(name: str) -> None:
    column = COLUMNS[name]
    scoring = ControlScoring(column=name)

    make_solver(column.planner, column.planner_set)
    if column.objective is not None:
        make_objective(column.objective, column.objective_set)
    assert (scoring.planner, scoring.planner_set) == (column.planner, column.planner_set)
    assert (scoring.objective, scoring.objective_set) == (column.objective, column.objective_set)
    assert ControlScoring.from_json(scoring.to_json()) == scoring
    with pytest.raises(InvalidSetting, match="says how to plan"):
        ControlScoring(column=name, planner="exhaustive")


def test_the_papers_column_is_the_papers_planner(tasks: Dataset) -> None:
    planned = ControlScoring(column="paper").planning(tasks, needs_pixels=True)
    solver, objective = planned["solver"], planned["objective"]

    assert [solver[name] for name in ("name", "samples", "horizon", "iterations", "elites")] == ["cem", 50, 5, 4, 10]
    assert (solver["action_repeat_prob"], solver["kept_elites"], solver["cost_at"]) == (0.0, 0, "best")
    assert objective["name"] == "centres"


@pytest.mark.parametrize(
    ("name", "objective"),
    [("generic", "tracked"), ("generic-risk", "tracked-risk"), ("generic-belief", "tracked-belief")],
)
def test_the_generic_columns_are_the_same_in_every_world_and_of_the_oracle_by_pictures(
    tasks: Dataset, name: str, objective: str
) -> None:
    scoring = ControlScoring(column=name)

    assert scoring.planned_with(tasks, needs_pixels=True)[0] == objective
    assert scoring.planned_with(tasks, needs_pixels=None)[0] == objective
    assert scoring.planned_with(tasks, needs_pixels=False)[0] == "feature"


def test_columns_of_the_later_protocol_leave_those_of_the_earlier_as_they_were() -> None:
    assert {name: column.protocol for name, column in COLUMNS.items()} == {
        "generic-risk": "dmbench-3",
        "generic-belief": "dmbench-4",
        "generic-wide": "dmbench-5",
        "generic": PROTOCOL,
        "paper": PROTOCOL,
        "task-knowledge": PROTOCOL,
    }


def test_a_column_for_continuous_actions_refuses_discrete_ones(
    make_run: MakeRun, tasks: Dataset, tmp_path: Path
) -> None:
    scoring = ControlScoring(column="generic-wide")
    with pytest.raises(InvalidSetting, match=r"'generic-wide' is for continuous actions.*use 'generic-risk'"):
        scoring.planning(tasks, needs_pixels=True)
    run = make_run(tmp_path / "run")
    with pytest.raises(InvalidSetting, match="is for continuous actions"):
        score_run(run.path, metrics=None, settings=ScoreSettings(control=scoring), data=tasks.path)
    assert not (run.path / "report").exists()
    moving = Continuous(names=("dx",), low=(-1.0,), high=(1.0,), units=("",))
    spec = replace(tasks.spec, actions=moving)
    solver, objective = COLUMNS["generic-wide"].made(spec, needs_pixels=True)
    assert solver == make_solver("icem", ["cost_at=last", "initial_std=1", "horizon=10", "hold=2", "samples=25"])
    assert objective == COLUMNS["generic-risk"].made(spec, needs_pixels=True)[1]


def test_a_report_without_a_column_says_nothing_of_columns() -> None:
    said = ControlScoring().to_json()

    assert "control_column" not in said
    assert ControlScoring.from_json(said).column is None


@pytest.mark.slow
def test_a_column_has_a_report_of_its_own(make_run: MakeRun, tasks: Dataset, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    few = ScoreSettings(resamples=100, control=ControlScoring(column="paper", tasks=1, steps=1, group=1))
    report = score_run(run.path, metrics=None, settings=few, data=tasks.path)

    folder = run.path / "report/on/grid-tasks/paper"
    assert report.protocol == PROTOCOL
    assert report.settings["metrics"] == ["control"]
    assert (report.column, run.path / report.place) == ("paper", folder)
    assert read_report(folder) == report
    assert transfer_folders(run.path) == [folder]
    assert score_run(run.path, metrics=None, settings=few, data=tasks.path, renew=False) == report


def test_what_a_column_is_not_for_is_said(make_run: MakeRun, grid: Dataset, tasks: Dataset, tmp_path: Path) -> None:
    run = make_run(tmp_path / "run")
    column = ScoreSettings(control=ControlScoring(column="generic"))

    with pytest.raises(
        InvalidSetting,
        match=r"new to a run, and .* was trained on; score a column on another data set.*record grid_world",
    ):
        score_run(run.path, metrics=None, settings=column)
    with pytest.raises(InvalidSetting, match="of control alone; leave out"):
        score_run(run.path, metrics=("prediction", "control"), settings=column, data=tasks.path)
    with pytest.raises(UnknownName, match="did you mean 'generic'"):
        ControlScoring(column="genric")


def test_tasks_in_episodes_of_the_training_are_refused(make_run: MakeRun, grid: Dataset, tmp_path: Path) -> None:
    """The same seed as the training's: the test episodes may be new, but the tasks lie anywhere."""
    same = replace(grid.recipe, tasks=20, episodes=grid.recipe.episodes + 20)
    record_dataset(tmp_path / "longer", same)
    run = make_run(tmp_path / "run")
    column = ScoreSettings(control=ControlScoring(column="generic", tasks=1))

    with pytest.raises(RunMismatch, match=r"of the \d+ task episodes of 'longer' have the seed"):
        score_run(run.path, metrics=None, settings=column, data=tmp_path / "longer")


@pytest.mark.slow
def test_other_tasks_than_the_protocols_are_refused(
    make_run: MakeRun, tasks: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = make_run(tmp_path / "run")
    column = ScoreSettings(control=ControlScoring(column="paper", tasks=1, steps=1, group=1))
    monkeypatch.setattr(columns, "TEST", TaskData(name="test", seed=5))
    monkeypatch.setattr(GridWorld, "test_tasks", {2: {"": "0" * 64}}, raising=False)
    with pytest.raises(InvalidSetting, match=r"are not the test tasks of dmbench-2; record them with"):
        score_run(run.path, metrics=None, settings=column, data=tasks.path)

    monkeypatch.setattr(GridWorld, "test_tasks", {2: {"": tasks_hash(tasks)}})
    assert columns.is_test(tasks)
    assert score_run(run.path, metrics=None, settings=column, data=tasks.path).column == "paper"


def test_the_test_tasks_in_other_pictures_are_refused(
    tasks: Dataset, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(columns, "TEST", TaskData(name="test", seed=5))
    monkeypatch.setattr(GridWorld, "test_tasks", {2: {"": tasks_hash(tasks)}}, raising=False)
    record_dataset(tmp_path / "varied", _recipe(vary=("movers",)))
    varied = Dataset.open(tmp_path / "varied")

    assert tasks_hash(varied) == tasks_hash(tasks)
    assert not np.array_equal(varied.video(0), tasks.video(0))
    columns.require_fitting_tasks(tasks)
    with pytest.raises(InvalidSetting, match="'varied' are not the test tasks of dmbench-2; record them with"):
        columns.require_fitting_tasks(varied)


def test_a_column_and_a_planner_cannot_both_be_named() -> None:
    from dmotion_bench.api.scoring import control_scoring

    with pytest.raises(UsageError, match="says how to plan; leave out the planner"):
        control_scoring(planner="cem", column="generic")


DOC = (Path(__file__).parents[2] / "docs/protocol.md").read_text()


def test_the_document_has_the_hashes_of_the_columns_and_of_the_test_tasks() -> None:
    for protocol in sorted({column.protocol for column in COLUMNS.values()}):
        assert f"| `{protocol}` | `{columns.columns_hash(protocol)}` |" in DOC, (
            "it has changed: that is another protocol"
        )
    for name, world in (("planar_push", PlanarPush), ("robot_push", RobotPush)):
        for settings, tasks in world.test_tasks[1].items():
            assert f"| {', '.join([name, *settings.split()])} | `{tasks}` |" in DOC
            said = (
                (f"--set {settings}", f"data/{name}-{TEST.label(settings.split())}")
                if settings
                else (TEST.words(name),)
            )
            assert all(part.strip("'") in DOC for part in said)


@pytest.mark.parametrize(
    ("environment", "parameters", "said"),
    [
        ("planar_push", {}, "'dmbench record planar_push --episodes 600 .* --out data/planar_push-test'"),
        (
            "planar_push",
            {"actions": "continuous", "scene": "distracted"},
            "'dmbench record planar_push --set actions=continuous .* --out data/planar_push-continuous-test'",
        ),
        ("planar_push", {"actions": "discrete"}, "'dmbench record planar_push --episodes .*/planar_push-test'"),
        ("robot_push", {"actions": "continuous"}, "'dmbench record robot_push --episodes .*/robot_push-test'"),
        ("grid_world", {"version": 2}, "'dmbench record grid_world --episodes .*/grid_world-test'"),
    ],
)
def test_the_test_tasks_that_are_named_are_those_with_the_recordings_settings(
    environment: str, parameters: dict[str, Any], said: str
) -> None:
    recipe = _recipe(environment=environment, parameters=parameters)
    assert re.fullmatch(said, columns.words_of_test(recipe))


@pytest.mark.slow
@pytest.mark.parametrize("settings", PlanarPush.test_tasks[1])
def test_the_test_tasks_of_planar_push_are_those_of_the_protocol(
    settings: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tasks are chosen by positions and pushes: what is recorded with blank pictures has the same ones."""
    recipe = recipe_for(
        "planar_push", episodes=TEST.episodes, frames=101, tasks=100, seed=TEST.seed, settings=settings.split()
    )
    record_dataset(tmp_path / "drawn", replace(recipe, episodes=5))
    blank = np.zeros((128, 128, 3), np.uint8), np.zeros((128, 128), np.uint8)
    monkeypatch.setattr(PlanarPush, "_draw", lambda _: blank)
    record_dataset(tmp_path / "test", recipe)
    drawn, recorded = (Dataset.open(tmp_path / name) for name in ("drawn", "test"))

    assert len(recorded.tasks()) == columns.TASKS
    assert tasks_hash(recorded) == PlanarPush.test_tasks[1][settings]
    assert columns.is_test(recorded)
    assert drawn.video(0).any()
    assert not recorded.video(0).any()
    for episode in range(len(drawn)):
        one, other = drawn.states(episode), recorded.states(episode)
        assert np.array_equal(one.objects.position, other.objects.position, equal_nan=True)
        assert np.array_equal(one.pushed, other.pushed)
        assert np.array_equal(one.actions, other.actions)


def test_what_planned_before_some_fields_were_there_is_read_as_today(tasks: Dataset) -> None:
    now = ControlScoring(planner="icem").planning(tasks, needs_pixels=True)
    before = now | {
        "solver": {
            name: value for name, value in now["solver"].items() if name not in ("cost_at", "hold", "replan_every")
        }
    }

    assert before != now
    assert present_planning(before) == now
    assert without_later(now) == before
    assert without_later(ControlScoring(column="generic").planning(tasks, needs_pixels=True)) is None
