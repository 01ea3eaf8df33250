"""What an entry says of control is held against the simulator and the model; whatever is changed in it is found."""

from __future__ import annotations

import copy
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from known_model import stands_for_every_model, write_run

from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.columns import tasks_hash
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring
from dmotion_bench.scoring.earlier_planning import earlier_planning
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.reference_control import score_reference
from dmotion_bench.scoring.report import read_report, write_report
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.action_texts import actions_of
from leaderboard.build import entry_of_run
from leaderboard.check import CheckSettings, check_entry
from leaderboard.entry import Entry
from recorders.grid_world import GridWorld

pytestmark = pytest.mark.slow

FEW = ("samples=4", "horizon=2", "iterations=1", "elites=2")
SCORING = ControlScoring(tasks=3, steps=5, group=2, planner_set=FEW)
QUICK = CheckSettings(score=False)
RUN = "dmotion-pushed-tiny-s0"
Rows = list[dict[str, Any]]


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    stands_for_every_model(monkeypatch)


@pytest.fixture(scope="module")
def controlled(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A run scored for control, the oracle beside it; read only."""
    workspace = Workspace(tmp_path_factory.mktemp("controlled"))
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=30, frames=32, tasks=4
    )
    record_dataset(workspace.data / "pushed-tiny", recipe)
    dataset = Dataset.open(workspace.data / "pushed-tiny")
    with pytest.MonkeyPatch.context() as patch:
        stands_for_every_model(patch)
        run = write_run(workspace.runs / RUN, dataset)
        score_reference("oracle", dataset, SCORING)
        score_run(run.path, metrics=("control",), settings=ScoreSettings(resamples=100, control=SCORING))
    return workspace


@pytest.fixture(scope="module")
def entry(controlled: Workspace) -> Entry:
    """Read only; ``_content`` is a copy."""
    with pytest.MonkeyPatch.context() as patch:
        stands_for_every_model(patch)
        return entry_of_run(controlled.runs / RUN)


def _content(entry: Entry) -> dict[str, Any]:
    return copy.deepcopy(dict(entry.content))


def test_a_sound_entry_holds(controlled: Workspace, entry: Entry) -> None:
    thorough, quick = (check_entry(entry, controlled, settings) for settings in (CheckSettings(), QUICK))

    assert (thorough.findings, quick.findings) == ((), ())
    assert thorough.figures == quick.figures == len(entry.figures) == 5 + 1 + 3 + 1  # distances, successes, lost
    assert thorough.samples == (5 + 1) * 3 * 5  # moments, tasks; the model, the oracle, three quick references
    assert set(entry.content["control"]) == {"model", "oracle"}


def _other_action(content: dict[str, Any], who: str, task: int, step: int) -> None:
    taken = content["control"][who][task]["actions"].split()
    taken[step] = str((int(taken[step]) + 1) % 4)
    content["control"][who][task]["actions"] = " ".join(taken)


@pytest.mark.parametrize("who", ["model", "oracle"])
@pytest.mark.parametrize("step", [0, 4])
def test_a_changed_action_is_found(controlled: Workspace, entry: Entry, who: str, step: int) -> None:
    content = _content(entry)
    _other_action(content, who, 2, step)

    findings = check_entry(Entry(content), controlled, QUICK).findings
    assert any(f"of the control of {who} are not what happens: task 2, step {step}" in one for one in findings)


@pytest.mark.parametrize("who", ["model", "oracle", "random"])
@pytest.mark.parametrize("figure", ["control_distance[1]", "control_distance[5]", "control_success", "control_lost"])
def test_a_changed_figure_is_found(controlled: Workspace, entry: Entry, who: str, figure: str) -> None:
    content = _content(entry)
    figures = content["figures"] if who == "model" else content["reference"][who]
    figures[figure]["mean"] += 0.01

    assert any(figure in finding for finding in check_entry(Entry(content), controlled, QUICK).findings)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda content: content["control"].clear(), "control of model: the actions are those of other tasks"),
        (lambda content: content["control"]["model"].pop(), "control of model: the actions are those of other tasks"),
        (lambda content: content["control"]["model"][0].update(actions="0 1"), "control of model: a task has not 5"),
        (lambda content: content["control"]["model"][0].update(actions="0 1 2 3 4"), "control of model: a task has"),
        (lambda content: content["settings"].update(control_steps="5"), "settings.control_steps is '5'"),
        (lambda content: content["settings"].update(control_steps=10**9), "settings.control_steps is"),
        (lambda content: content["settings"].update(control_tasks=2), "control of model: the actions are those of"),
        (lambda content: content["settings"].update(metrics=[]), "control: the entry holds actions"),
        (lambda content: content["reference"].pop("random"), "reference.random"),
        (lambda content: content["by_episode"].clear(), "by_episode: "),
    ],
)
def test_what_the_entry_says_of_its_control_counts(
    controlled: Workspace, entry: Entry, change: Callable[[dict[str, Any]], None], said: str
) -> None:
    content = _content(entry)
    change(content)

    findings = check_entry(Entry(content), controlled, QUICK).findings
    assert any(finding.startswith(said) for finding in findings), findings


def test_a_search_without_bounds_is_not_planned_anew(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    content["settings"]["control_planner_set"] = ["samples=1000000000", *FEW[1:]]
    content["planning"]["solver"]["samples"] = 10**9

    verdict = check_entry(Entry(content), controlled, CheckSettings())

    said = "control: planning.solver.samples is 1000000000; nothing is planned anew with more than 10000"
    assert verdict.missing == (said,)
    assert not any("planned anew (" in remark for remark in verdict.remarks)


def test_a_planner_that_is_not_installed_is_missing_and_no_lie(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    content["settings"]["control_planner"] = "luck"
    verdict = check_entry(Entry(content), controlled, QUICK)
    assert not verdict.holds
    assert [one.startswith("code: no planner") for one in verdict.missing] == [True]


def test_what_another_version_planned_is_repeated_and_not_planned_anew(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    del content["settings"]["control_version"]
    content["settings"]["control_code"] = "0.0"

    verdict = check_entry(Entry(content), controlled)
    assert (verdict.findings, verdict.holds) == ((), False)
    assert [one.startswith("version: control was planned by version '0.0'") for one in verdict.missing] == [True]

    content["control"]["model"][0]["actions"] = " ".join(reversed(content["control"]["model"][0]["actions"].split()))
    assert check_entry(Entry(content), controlled).findings


def test_an_entry_that_names_code_holds_as_the_version_that_the_code_stands_for(
    controlled: Workspace, entry: Entry
) -> None:
    content = _content(entry)
    del content["scoring_version"], content["planning"], content["settings"]["control_version"]
    content["code"] = "0.1.0+f4b222bec15f"
    content["settings"]["control_code"] = "0.1.0+4fa30b762c67"
    report = controlled.runs / RUN / "report/report.json"
    now = report.read_text()
    old = json.loads(now)
    del old["scoring_version"], old["planning"]
    report.write_text(json.dumps(old | {"code": content["code"], "settings": content["settings"]}))
    try:
        assert entry_of_run(controlled.runs / RUN).content == content
        verdict = check_entry(Entry(content), controlled)
    finally:
        report.write_text(now)

    assert (verdict.findings, verdict.missing, verdict.holds) == ((), (), True)


def test_an_entry_in_the_words_of_an_earlier_release_holds(copied: Workspace) -> None:
    """It names a planner and a cost, of which no field could be set."""
    plain = ControlScoring(tasks=1, steps=1)
    run = copied.runs / RUN
    shutil.rmtree(run / "report")
    score_run(run, metrics=("control",), settings=ScoreSettings(resamples=100, control=plain))
    report = run / "report/report.json"
    old = json.loads(report.read_text())
    planning = earlier_planning(old["planning"])
    assert planning is not None
    old["planning"] = planning | {"arithmetic": old["planning"]["arithmetic"]}
    for name in ("objective", "objective_set", "planner_set"):
        del old["settings"][f"control_{name}"]
    old["settings"]["control_cost"] = None
    report.write_text(json.dumps(old))

    entry = entry_of_run(run)
    assert set(entry.content["planning"]) == {"planner", "cost", "arithmetic"}
    verdict = check_entry(entry, copied)
    assert (verdict.findings, verdict.missing, verdict.holds) == ((), (), True)

    content = _content(entry)
    content["planning"]["cost"]["tracking.CLEAR"] = 0.8
    assert any(one.startswith("planning.objective: ") for one in check_entry(Entry(content), copied, QUICK).findings)


def test_another_solver_than_the_entry_names_is_found(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    content["planning"]["solver"]["samples"] += 1

    findings = check_entry(Entry(content), controlled, QUICK).findings
    assert any(one.startswith("planning: the entry says") for one in findings)
    assert any(one.startswith("planning.solver: the entry says") for one in findings)


def test_figures_of_control_that_nobody_scored_are_found(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    content["figures"]["control_distance[6]"] = content["figures"]["control_distance[5]"]

    assert any(
        "control_distance[6] is nobody's" in one for one in check_entry(Entry(content), controlled, QUICK).findings
    )


def test_figures_of_control_do_not_hold_where_control_is_said_not_to_be_scored(
    controlled: Workspace, entry: Entry
) -> None:
    content = _content(entry)
    content["settings"]["metrics"] = []
    content["control"] = {}

    findings = check_entry(Entry(content), controlled, QUICK).findings
    assert "control of model: the entry has figures, and no actions that lead to them" in findings
    assert "control of oracle: the entry has figures, and no actions that lead to them" in findings


@pytest.mark.parametrize("settings", [CheckSettings(), QUICK], ids=["anew", "quick"])
def test_figures_of_the_oracle_do_not_hold_without_its_actions(
    controlled: Workspace, entry: Entry, settings: CheckSettings
) -> None:
    content = _content(entry)
    del content["control"]["oracle"]

    findings = check_entry(Entry(content), controlled, settings).findings
    assert findings == ("control of oracle: the entry has figures, and no actions that lead to them",)


def test_a_published_figure_of_control_needs_no_actions(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    content["reference"]["paper"] = {"control_distance[100]": content["figures"]["control_distance[5]"]}

    findings = check_entry(Entry(content), controlled, QUICK).findings
    assert not any("control of paper" in one for one in findings)
    assert any(one.startswith("reference.paper: ") for one in findings)  # this one was published by nobody


def _forged(workspace: Workspace, change: Callable[[Rows], None]) -> Entry:
    """The entry of a run whose samples were changed and whose report was made to agree, hash, figures and all."""
    run = workspace.runs / RUN
    folder = run / "report"
    table, report = pq.read_table(folder / "samples.parquet"), read_report(folder)
    assert report is not None
    rows = table.to_pylist()
    change(rows)
    forged = pa.Table.from_pylist(rows, table.schema)
    figures, *others = (
        {name: one.to_json() for name, one in figures_of(forged, who, resamples=100).items()}
        for who in ("model", *report.reference)
    )
    reference = dict(zip(report.reference, others, strict=True)) | {
        name: own for name, own in report.reference.items() if name == "paper"
    }
    write_report(folder, type(report)(**(vars(report) | {"figures": figures, "reference": reference})), forged)
    return entry_of_run(run)


@pytest.fixture
def copied(controlled: Workspace, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Workspace:
    """A copy to spoil, of the same data set."""
    workspace = Workspace(tmp_path)
    shutil.copytree(controlled.runs, workspace.runs)
    workspace.data.symlink_to(controlled.data)
    return workspace


def _moments(rows: Rows, who: str, task: int) -> Rows:
    mine = [row for row in rows if row["predictor"] == who and row["task"] == task]
    return sorted(mine, key=lambda row: int(row["ahead"]))


@pytest.mark.parametrize("who", ["model", "oracle"])
def test_a_forged_distance_is_found_by_repeating_the_actions(copied: Workspace, who: str) -> None:
    def nearer(rows: Rows) -> None:
        _moments(rows, who, 1)[-1]["control_distance"] *= 0.9

    findings = check_entry(_forged(copied, nearer), copied, QUICK).findings
    assert any(f"1 of the control of {who} are not what happens: task 1, step 5" in one for one in findings)
    assert any("control_distance[5]" in finding for finding in findings)


def test_a_forged_reference_is_found_by_scoring_it_anew(copied: Workspace) -> None:
    def farther(rows: Rows) -> None:
        for row in rows:
            if row["predictor"] == "random":
                row["control_distance"] += 0.1

    forged = _forged(copied, farther)
    assert check_entry(forged, copied, QUICK).holds
    assert any("control of random" in finding for finding in check_entry(forged, copied).findings)


def test_another_player_than_the_model_is_found_by_planning_anew(copied: Workspace) -> None:
    def let_chance_play(rows: Rows) -> None:
        for task in range(3):
            played = zip(_moments(rows, "model", task), _moments(rows, "random", task), strict=True)
            for mine, other in played:
                mine |= {name: other[name] for name in ("action", "control_distance", "control_lost")}

    forged = _forged(copied, let_chance_play)
    assert check_entry(forged, copied, QUICK).holds  # its actions do lead there
    strict, lenient = (check_entry(forged, copied, CheckSettings(differing=share)) for share in (0.0, 1.0))
    assert any("actions are not the model's: task" in finding for finding in strict.findings)
    assert any("planned otherwise" in remark for remark in lenient.remarks)


def test_help_in_the_last_steps_is_found(copied: Workspace) -> None:
    """The model's own actions at first, the oracle's or none afterwards."""

    def help_out(rows: Rows) -> None:
        for task in range(3):
            helped = zip(_moments(rows, "model", task)[3:], _moments(rows, "random", task)[3:], strict=True)
            for mine, other in helped:
                mine["action"] = (other["action"] + 1) % 4

    content = _content(entry_of_run(copied.runs / RUN))
    _forged(copied, help_out)
    samples = pq.read_table(copied.runs / RUN / "report" / "samples.parquet")
    forged = Entry(content | {"control": content["control"] | {"model": actions_of(samples)["model"]}})

    assert any("are not the model's" in one for one in check_entry(forged, copied).findings)


def test_whoever_checks_draws_the_tasks_that_are_planned_anew(controlled: Workspace, entry: Entry) -> None:
    def planned(draw: int) -> str:
        remarks = check_entry(entry, controlled, CheckSettings(draw=draw)).remarks
        (told,) = (remark for remark in remarks if "planned anew" in remark)
        return told

    assert planned(3) == planned(3)
    assert {planned(draw).partition(" (")[0] for draw in range(6)} == {
        "control: 10 actions of the tasks 0, 1 were planned anew",
        "control: 5 actions of the tasks 2 were planned anew",
    }
    assert CheckSettings().draw != CheckSettings().draw


def test_a_model_takes_an_action_at_each_step(controlled: Workspace, entry: Entry) -> None:
    content = _content(entry)
    content["control"]["model"][1]["actions"] = "0 1 -1 2 3"
    findings = check_entry(Entry(content), controlled, QUICK).findings
    assert any("a task of the model has a step without an action" in one for one in findings)


@pytest.mark.parametrize(
    ("settings", "said"), [({"seed": 7}, "seed is 7"), ({"steps": 4}, "steps is 4"), ({"tasks": 2}, "tasks is 2")]
)
def test_a_column_has_the_protocol_s_settings_on_its_tasks(
    controlled: Workspace, entry: Entry, monkeypatch: pytest.MonkeyPatch, settings: dict[str, Any], said: str
) -> None:
    content = _content(entry)
    column = {"column": "generic", "planner": "icem", "planner_set": ["cost_at=last"]} | settings
    content["settings"] |= {f"control_{name}": value for name, value in column.items()}
    tasks = tasks_hash(Dataset.open(controlled.data / "pushed-tiny"))

    assert not any(said in one for one in check_entry(Entry(content), controlled, QUICK).findings)
    monkeypatch.setattr(GridWorld, "test_tasks", {2: {"": tasks}}, raising=False)
    assert any(said in one for one in check_entry(Entry(content), controlled, QUICK).findings)


def test_a_run_without_control_has_no_actions(controlled: Workspace, copied: Workspace) -> None:
    run = Run.open(copied.runs / RUN)
    shutil.rmtree(run.path / "report")
    score_run(run.path, metrics=("prediction",), settings=ScoreSettings(resamples=100))

    plain = entry_of_run(run.path)
    assert plain.content["control"] == {}
    assert check_entry(plain, copied, QUICK).findings == ()
