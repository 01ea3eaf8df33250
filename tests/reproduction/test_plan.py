"""What stands in a table becomes recordings, trainings and scorings; a part of a table is chosen by names."""

from __future__ import annotations

import dataclasses
import re
import shutil
import tomllib
from importlib.metadata import EntryPoint
from pathlib import Path

import numpy as np
import pytest
import torch
from known_model import result_of
from small_tables import CONTROL, TABLE

from dmotion_bench import registry
from dmotion_bench.api import reproducing
from dmotion_bench.cli import options
from dmotion_bench.errors import InvalidSetting, RunMismatch, UnknownName, UsageError
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import default_path, resolve
from dmotion_bench.planning.columns import (
    COLUMNS,
    HEADLINE,
    TASKS,
    TEST,
    TRAININGS,
    settings_of,
    words_of_test,
)
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.reproduction.cost import control_places
from dmotion_bench.reproduction.plan import Plan
from dmotion_bench.reproduction.settled import state_of
from dmotion_bench.reproduction.table import Entrant, Table, World, powers_of_two
from dmotion_bench.scoring.references import published_results
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.workspace import Workspace
from recorders.planar_push.environment import PlanarPush

ROOT = Path(__file__).parents[2]
OURS = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["entry-points"][registry.TABLES]
"""The tables of this project as it says them itself, whatever of them is installed."""


def _ours(name: str) -> Table:
    table: Table = EntryPoint(name, OURS[name], registry.TABLES).load()
    return table


def test_a_part_of_a_table_is_chosen_by_names() -> None:
    part = registry.table("paper").narrowed(models=["dmotion"], worlds=["robot_push"], seeds=[3, 3], preset=Preset.TINY)
    assert [one.model for one in part.entrants] == ["dmotion"]
    assert (part.seeds, part.preset, len(part.columns)) == ((3,), Preset.TINY, 2)
    assert len(registry.table("paper").narrowed(worlds=["grid_world"]).columns) == 1  # control is of the robot
    for wrong, kind, says in (
        ({"models": ["dmotoin"]}, UnknownName, "did you mean 'dmotion'"),
        ({"worlds": ["push_t"]}, UnknownName, "no world of this table named 'push_t'"),
        ({"seeds": []}, UsageError, "no seed is named"),
        ({"seeds": 0}, UsageError, "seeds is 0; give a list of whole numbers"),
        ({"seeds": "01"}, UsageError, "seeds is '01'; give a list of whole numbers"),
        ({"seeds": [0, -1]}, InvalidSetting, "a seed is -1; it must be a whole number from 0"),
        ({"seeds": ["1"]}, InvalidSetting, "a seed is '1'"),
        ({"seeds": [True]}, InvalidSetting, "a seed is True"),
    ):
        with pytest.raises(kind, match=says):
            registry.table("paper").narrowed(**wrong)
    assert registry.table("paper").narrowed(models="dmotion", seeds=np.arange(2)).seeds == (0, 1)
    assert registry.table("paper").narrowed(seeds=iter([2, 1])).seeds == (2, 1)
    with pytest.raises(InvalidSetting, match="two columns of a table have the same name"):
        dataclasses.replace(TABLE, columns=TABLE.columns * 2)


def test_a_column_comes_with_the_models_and_the_recordings_that_it_needs(tmp_path: Path) -> None:
    control = registry.table("control")
    extra = control.narrowed(columns=["paper"])
    assert [one.name for one in extra.columns] == ["paper"]
    assert {one.model for one in extra.entrants} == {"dmotion", "clasp", "ed-cnn", "wm-ae"}
    headline = control.narrowed(columns=["generic-risk"], worlds=["planar_push"])
    assert headline.entrants == control.entrants
    with pytest.raises(UsageError, match="no column of this table has figures of these models"):
        control.narrowed(columns=["paper"], models=["jepa"])
    with pytest.raises(UnknownName, match="did you mean 'generic-risk'"):
        control.narrowed(columns=["generic-rsk"])

    def recorded(table: Table) -> list[str]:
        return [one.folder.name for one in Plan(table, "control", Workspace(tmp_path)).recordings]

    assert recorded(headline) == ["planar_push-small", "planar_push-test"]
    assert recorded(control.narrowed(columns=["prediction"], worlds=["planar_push"])) == ["planar_push-small"]


def test_a_part_of_the_columns_has_the_pages_of_the_whole_table(tmp_path: Path) -> None:
    whole = reproducing.plan_table(CONTROL, workspace=tmp_path)
    assert [whole.page(column).name for column in CONTROL.columns] == ["first", "second"]
    for column in CONTROL.columns:
        part = reproducing.plan_table(CONTROL, columns=[column.name], workspace=tmp_path)
        assert part.pages() == [(column,)]
        assert part.page(column) == whole.page(column)


@pytest.mark.parametrize(
    ("model", "shared"), [("laom", 1.0), ("laom-labels", 0.0), ("wm-ae", 0.5), ("idm-ed-cnn", 0.0), ("ed-cnn", 0.0)]
)
def test_what_label_budgets_share_ends_where_the_first_label_is_used(model: str, shared: float, tmp_path: Path) -> None:
    entrant = Entrant(model=model, labels=("4", "8"))
    plan = Plan(dataclasses.replace(TABLE, entrants=(entrant,)), "own", Workspace(tmp_path))
    assert [(one.shared, one.labelled) for one in plan.trainings] == [(shared, 1 - shared)] * (1 if shared else 2)
    whole = sum(one.left(plan.workspace)[1] for one in plan.trainings)
    assert whole == shared + 2 * (1 - shared)


def test_the_papers_table_has_the_rows_that_were_published() -> None:
    table = registry.table("paper")
    published = {(one.environment, one.model, one.labels) for one in published_results()}
    ours = {(w.environment, one.model, labels) for w in table.worlds for one in table.entrants for labels in one.labels}
    assert ours == published
    with_control = {
        one.model for one in published_results() if any(name.startswith("control_distance") for name in one.figures)
    }
    assert {*table.columns[1].models} == with_control


def _test_data_sets(plan: Plan) -> dict[str, DatasetRecipe]:
    return {one.folder.name: one.recipe for one in plan.recordings if one.world.fixed}


def test_the_table_of_continuous_actions_has_the_protocols_test_tasks(tmp_path: Path) -> None:
    plan = reproducing.plan_table("continuous", workspace=tmp_path)
    ((name, recipe),) = _test_data_sets(plan).items()
    settings = settings_of(recipe)
    assert settings == ("actions=continuous",)
    assert " ".join(settings) in PlanarPush.test_tasks[recipe.version]
    assert recipe == recipe_for("planar_push", episodes=600, tasks=TASKS, seed=TEST.seed, settings=settings)
    assert words_of_test(plan.trainings[0].recording.recipe) == TEST.words("planar_push", settings)
    assert f"--out data/{name}" in TEST.words("planar_push", settings)
    assert {(one.model, row.labels, one.request.seed) for one in plan.trainings for row in one.rows} == {
        (model, labels, seed) for model, labels in (("dmotion", "64"), ("ed-cnn", "100%")) for seed in range(TRAININGS)
    }
    assert [one.column.frozen for one in plan.scorings if one.data] == ["generic-wide", HEADLINE.name]


def test_the_table_of_control_is_that_of_the_protocol(tmp_path: Path) -> None:
    plan = reproducing.plan_table("control", workspace=tmp_path)
    assert (plan.table.preset, plan.table.seeds) == (Preset.SMALL, tuple(range(TRAININGS)))
    tests = _test_data_sets(plan)
    assert tests == {
        f"{name}-test": recipe_for(name, episodes=TEST.episodes, tasks=TASKS, seed=TEST.seed)
        for name in registry.environment_names()
        if hasattr(registry.environment_class(name), "test_tasks")
    }
    assert all(f"--out data/{name}" in TEST.words(name.removesuffix("-test")) for name in tests)
    frozen = {scoring.control.column for scoring in plan.scorings} - {None}
    assert frozen == {name for name, column in COLUMNS.items() if not column.continuous}
    for scoring in plan.scorings:
        models, column = {one.model for one in scoring.trainings}, scoring.column
        assert (scoring.data is None) == (column.frozen is None)
        if column.frozen is not None:
            assert models == {*(column.models or [one.model for one in plan.table.entrants])}
            assert scoring.tasks() == TASKS
    trial = reproducing.plan_table("control", preset="tiny", workspace=tmp_path)
    assert {one.recipe.seed for one in trial.recordings if one.world.fixed} == {TEST.seed + 1}


def test_the_models_of_its_columns_are_those_that_the_protocol_names() -> None:
    page = (ROOT / "docs" / "protocol.md").read_text()
    told = dict(re.findall(r"^\| `([a-z-]+)` \|(?:[^|]+\|){2} ([^|]+) \|$", page, re.MULTILINE))
    names = {"dmotion": "DMotion", "ed-cnn": "E-D CNN", "wm-ae": "WM-AE", "clasp": "CLASP"}
    for column in registry.table("control").columns[1:]:
        assert told[column.name] == (", ".join(names[model] for model in column.models) or "every model")


def test_every_table_of_ours_is_registered_and_listed() -> None:
    modules = {path.stem for path in (ROOT / "leaderboard" / "tables").glob("*.py")} - {"__init__"}
    assert {name: f"leaderboard.tables.{name}:TABLE" for name in modules} == OURS
    assert tuple(sorted(OURS)) == options.TABLES
    page = (ROOT / "docs" / "reproduce.md").read_text()
    assert {*re.findall(r"^\| `(\w+)` \| .* \| `reports/\1` \|$", page, re.MULTILINE)} == {*OURS}


@pytest.mark.parametrize("name", OURS)
def test_every_table_can_be_planned(name: str, tmp_path: Path) -> None:
    plan = reproducing.plan_table(_ours(name), workspace=tmp_path, preset="tiny")
    assert {training.model for training in plan.trainings} == {one.model for one in plan.table.entrants}
    assert all(scoring.control for scoring in plan.scorings)
    assert len(plan.pages()) == 1


def test_budgets_of_the_label_curve_end_with_all_labels(tmp_path: Path) -> None:
    assert list(powers_of_two(9)) == ["1", "2", "4", "8"]
    plan = reproducing.plan_table("labels", workspace=tmp_path, seeds=[0], worlds=["planar_push"])
    rows = {training.model: [] for training in plan.trainings}
    for training in plan.trainings:
        rows[training.model] += [row.labels for row in training.rows]
    assert rows["dmotion"] == [*(str(2**power) for power in range(13)), "100%"]
    assert rows["ed-cnn"] == [*(str(4**power) for power in range(1, 7)), "100%"]
    assert len([training for training in plan.trainings if training.model == "dmotion"]) == 1
    assert len([training for training in plan.trainings if training.model == "ed-cnn"]) == 7
    assert len([training for training in plan.trainings if training.model == "wm-ae"]) == 1  # its autoencoder is shared
    assert rows["laom"] == rows["dmotion"]
    assert rows["wm-ae"] == rows["ed-cnn"]
    assert len(rows) == 8


def test_a_model_on_request_is_in_a_table_where_it_is_named() -> None:
    table = _ours("labels")
    asked = [one.model for one in table.entrants if one.on_request]
    assert asked == ["idm-ed-cnn"]
    assert {one.model for one in table.narrowed().entrants} == {one.model for one in table.entrants} - {*asked}
    (named,) = table.narrowed(models=asked).entrants
    assert named.labels == (*(str(4**power) for power in range(1, 7)), "all")


def test_the_table_of_labels_during_the_training_has_both_scenes(tmp_path: Path) -> None:
    """As the commands of ``docs/experiments/labels-during-training.md`` once had them, one by one."""
    plan = reproducing.plan_table(_ours("laom"), workspace=tmp_path)
    assert [one.recipe for one in plan.recordings] == [
        recipe_for("planar_push", Preset.SMALL, settings=settings) for settings in ((), ("scene=distracted",))
    ]
    assert {one.request.settings for one in plan.trainings} == {("epochs=5",)}
    trained = [
        (one.recording.world.label, one.model, one.seed, row.labels) for one in plan.trainings for row in one.rows
    ]
    assert len(trained) == len({*trained})
    assert {*trained} == {
        (world, model, seed, labels)
        for world in ("planar_push", "planar_push-distracted")
        for model, labels in (("lapo", "2.5%"), ("laom", "2.5%"), ("laom-labels", "1%"), ("laom-labels", "2.5%"))
        for seed in range(3)
    }
    assert [scoring.metrics() for scoring in plan.scorings] == [("prediction",)] * 2


def test_models_that_draw_nothing_are_controlled_by_features(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(registry.model_class("jepa"), "needs_pixels", False)
    table = dataclasses.replace(CONTROL, entrants=(Entrant(model="jepa", labels=("100%",)), *CONTROL.entrants))
    plan = Plan(table, "own", Workspace(tmp_path))
    scorings = plan.of_column(table.columns[1])
    assert {one.trainings[0].model: one.control.objective for one in scorings} == {
        "jepa": "feature",
        "ed-cnn": "tracked",
    }
    assert {one.trainings[0].model: one.metrics() for one in scorings}["jepa"] == ("control",)
    (oracle,) = control_places(state_of(plan, table.columns[0]))
    assert oracle.control.objective == "centres"  # features are a model's


def test_another_recording_can_hold_the_tasks(tmp_path: Path) -> None:
    world = dataclasses.replace(
        CONTROL.worlds[0], tasks=0, control_on=World(environment="planar_push", name="test", seed=7, episodes=10)
    )
    plan = Plan(dataclasses.replace(CONTROL, worlds=(world,)), "own", Workspace(tmp_path))
    assert [one.folder.name for one in plan.recordings] == ["planar_push-tiny", "planar_push-test-tiny"]
    assert {one.data for one in plan.scorings} == {tmp_path / "data" / "planar_push-test-tiny"}


WEIGHTS = {"offset": torch.zeros(1)}


def _stand(plan: Plan, **other: object) -> list[Path]:
    """Put runs into the folders of a table as if they were trained, with its settings or with others."""
    paths = []
    for training in plan.trainings:
        dataset = training.recording.dataset()
        assert dataset is not None
        for row in training.rows:
            asked = row.request(training.request)
            spec = resolve(asked, dataset)
            path = default_path(asked, spec, plan.workspace)
            shutil.rmtree(path, ignore_errors=True)
            path.mkdir(parents=True)
            spec = dataclasses.replace(spec, **other)
            run = Run.create_or_open(path, spec, dataset_path=dataset.where, versions={})
            checkpoint.save(run.best, checkpoint.with_prefix("model", WEIGHTS), {})
            run.finish(result_of(WEIGHTS))
            paths.append(path)
    return paths


def test_runs_of_other_settings_or_data_are_told_before_anything_is_counted(tmp_path: Path) -> None:
    def planned() -> Plan:
        return reproducing.plan_table(TABLE, workspace=tmp_path, seeds=[0], models=["lapo"])

    plan = planned()
    (recording,) = plan.recordings
    record_dataset(recording.folder, recording.recipe)
    _stand(plan)
    assert [one.left(plan.workspace) for one in planned().trainings] == [(0, 0.0)]
    for other, says in (
        ({"fingerprint": "0" * 64}, r"fingerprint is '0+' there and '[0-9a-f]+' here"),
        ({"training": {"epochs": 9.0}}, r"training is \{epochs: 9\.0.*\} there and \{epochs: 1\.0.*\} here"),
        ({"config": {"whirl": 2}}, "whirl"),
    ):
        first, *more = _stand(plan, **other)
        with pytest.raises(RunMismatch, match=says) as raised:
            planned()
        said = str(raised.value)
        assert f"{str(first)!r} holds another run than the table 'own' asks for" in said
        assert f"So do 2 more: {', '.join(path.name for path in more)}." in said
        assert "To train anew, delete or rename that folder, or name another workspace with DMBENCH_WORKSPACE" in said
    _stand(plan)
    (first / "run.json").write_text("{")
    assert planned().trainings[0].left(plan.workspace) == (1, 0.0)  # its training says what is wrong


@pytest.mark.parametrize("damage", ["deleted", "other bytes"])
def test_a_run_whose_weights_are_damaged_is_trained_anew_and_not_scored(damage: str, tmp_path: Path) -> None:
    plan = reproducing.plan_table(TABLE, workspace=tmp_path, seeds=[0], models=["lapo"])
    (training,), (column,) = plan.trainings, plan.table.columns
    record_dataset(training.recording.folder, training.recording.recipe)
    first, *others = _stand(plan)
    assert training.left(plan.workspace)[0] == 0
    assert [path for _, _, path in state_of(plan, column).to_score] == [first, *others]
    weights = first / "best.safetensors"
    spoilt = weights.read_bytes()[:-1] + b"?"
    weights.unlink()
    if damage == "other bytes":
        weights.write_bytes(spoilt)
    assert training.left(plan.workspace)[0] == 1
    assert [path for _, _, path in state_of(plan, column).to_score] == others
