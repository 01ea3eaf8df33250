"""Control in a run's report: its figures follow from the samples, its references stand beside it, it can be killed."""

from __future__ import annotations

import hashlib
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest
from known_model import Known
from torch import Tensor

from dmotion_bench.errors import DatasetError, DmbenchError, FolderInUse, UnknownName
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.planning.mpc import CONTROL_VERSION, ControlProgress
from dmotion_bench.planning.objectives.tracked import Tracked
from dmotion_bench.planning.tasks import load_problems
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring import reference_control
from dmotion_bench.scoring.control import ControlScoring, require_tasks
from dmotion_bench.scoring.earlier_planning import earlier_planning
from dmotion_bench.scoring.figures import is_solved
from dmotion_bench.scoring.prediction import Execution
from dmotion_bench.scoring.reference_control import known_references, score_reference
from dmotion_bench.scoring.report import Report
from dmotion_bench.scoring.samples import read_samples
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset

pytestmark = pytest.mark.slow

MakeRun = Callable[..., Run]
FEW = ("samples=3", "horizon=2", "iterations=1", "elites=2")
SCORING = ControlScoring(tasks=3, steps=3, group=2, planner_set=FEW)
QUICK = ScoreSettings(horizon=3, resamples=100, control=SCORING)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Read only; ``tasks`` is a copy."""
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2}, policy="random", episodes=30, frames=32, tasks=4
    )
    path = tmp_path_factory.mktemp("data") / "grid"
    record_dataset(path, recipe)
    return path


@pytest.fixture
def tasks(recorded: Path, tmp_path: Path) -> Dataset:
    """A Grid World with tasks; its cache is empty."""
    return Dataset.open(shutil.copytree(recorded, tmp_path / "grid"))


@pytest.fixture
def run(tasks: Dataset, make_run: MakeRun, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Run:
    made = make_run(tmp_path / "run", fingerprint=tasks.fingerprint)
    monkeypatch.setattr(Run, "dataset_path", tasks.path)
    return made


def score(run: Run, *metrics: Any, settings: ScoreSettings = QUICK, **options: Any) -> Report:
    return score_run(run.path, metrics=metrics or ("control",), settings=settings, **options)


def test_figures_follow_from_the_samples_and_references_stand_beside_them(run: Run) -> None:
    report = score(run)
    samples = pq.read_table(run.path / "report/samples.parquet")
    assert set(report.reference) >= {"idle", "random", "scripted"}
    assert "oracle" not in report.reference
    assert report.reference["idle"]["control_distance[3]"]["mean"] == 1
    for predictor, figures in {"model": report.figures, **report.reference}.items():
        if predictor == "paper":
            continue
        rows = samples.filter(pc.equal(samples["predictor"], predictor))
        assert len(rows) == 3 * 4
        assert set(rows["metric"].to_pylist()) == {"control"}
        assert sorted(set(rows["task"].to_pylist())) == [0, 1, 2]
        for step in range(1, 4):
            values = rows.filter(pc.equal(rows["ahead"], step))["control_distance"].to_numpy()
            assert figures[f"control_distance[{step}]"]["mean"] == pytest.approx(values.mean(dtype=float), rel=1e-9)
            assert figures[f"control_distance[{step}]"]["n"] == 3
        assert figures["control_success[0.5]"]["mean"] == pytest.approx((values <= 0.5).mean())
    assert report.settings["control_tasks"] == 3
    assert not (run.path / "report/control.json").exists()


def _known(tasks: Dataset, scoring: ControlScoring) -> tuple[str, ...]:
    return known_references(tasks, scoring, load_problems(tasks, scoring.tasks))


def test_tasks_are_loaded_once_for_the_model_and_all_references(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[Any] = []
    monkeypatch.setattr(
        reference_control,
        "load_problems",
        lambda data, *numbers: asked.append(numbers) or load_problems(data, *numbers),
    )
    report = score(run)
    assert len(report.reference) >= 3
    assert asked == [(SCORING.tasks,)]


def test_the_oracle_stands_beside_a_model_once_it_is_scored(run: Run, tasks: Dataset) -> None:
    assert _known(tasks, SCORING) == ("idle", "random", "scripted")
    result = score_reference("oracle", tasks, SCORING)
    assert score_reference("oracle", tasks, SCORING).planned == 0
    assert _known(tasks, replace(SCORING, tasks=4)) == ("idle", "random", "scripted")
    assert score(run).reference["oracle"]["control_distance[3]"]["mean"] == pytest.approx(
        result.distance[:, 3].mean(), rel=1e-6
    )


class Killed(Exception):
    """The process is gone."""


@pytest.mark.parametrize("dies_at", [2, 5])
def test_a_killed_scoring_goes_on_to_the_same_report(
    run: Run, tmp_path: Path, dies_at: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    whole = score(run)
    planned: list[int] = []

    def note(what: str, done: int, total: int) -> None:
        if what.startswith("control by the model"):
            planned.append(done)
            if len(planned) == dies_at:
                raise Killed

    with pytest.raises(Killed):
        score(run, how=Execution(progress=note))
    assert (run.path / "report/control.json").exists()
    begun = len(planned)
    again = score(run, how=Execution(progress=note))
    assert len(planned) - begun == 6 - dies_at + (dies_at > 3)  # two groups of three steps; a done one reports once
    assert (again.figures, again.samples) == (whole.figures, whole.samples)


def test_scoring_something_else_leaves_an_interrupted_control(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    journal = run.path / "report/control.json"

    def note(what: str, done: int, total: int) -> None:
        if what.startswith("control by the model"):
            raise Killed

    with pytest.raises(Killed):
        score(run, how=Execution(progress=note))
    share = shutil.copy(journal, journal.with_name("control-0.json"))
    score(run, "prediction")
    assert journal.exists()
    assert Path(share).exists()
    score(run)
    assert not journal.exists()
    assert not Path(share).exists()


def test_what_was_planned_in_another_arithmetic_is_not_taken_over(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.planning.journal.WRITE_EVERY", 0.0)
    journal, planned = run.path / "report/control.json", []

    def note(what: str, done: int, total: int) -> None:
        if what.startswith("control by the model"):
            planned.append(done)
            if len(planned) == 5:
                raise Killed

    with pytest.raises(Killed):
        score(run, how=Execution(progress=note))
    content = in_the_earlier_format(journal)
    mine = content["key"].pop("arithmetic")
    for key, steps in (({"arithmetic": "of another machine"}, 6), ({"arithmetic": mine}, 2), ({}, 2)):
        journal.write_text(json.dumps(content | {"key": content["key"] | key}))
        planned.clear()
        planned.extend([-1] * 5)  # nothing kills it now
        score(run, how=Execution(progress=note))
        assert len(planned) - 5 == steps


def test_control_is_kept_while_it_is_true(run: Run) -> None:
    asked: list[str] = []
    how = Execution(progress=lambda what, done, total: asked.append(what.partition(",")[0]))
    control = {name: one for name, one in score(run).figures.items() if name.startswith("control_")}
    both = score(run, "prediction", how=how)
    assert not any(what.startswith("control") for what in asked)
    assert "mse" in both.figures
    assert {name: one for name, one in both.figures.items() if name.startswith("control_")} == control
    assert score(run, "control", how=how, renew=False) == both
    fewer = replace(QUICK, control=replace(SCORING, tasks=2))
    assert score(run, "control", how=how, settings=fewer, renew=False).figures["control_lost"]["n"] == 2
    assert "control by the model" in asked


def test_another_version_of_scoring_leaves_control_true_and_one_of_control_does_not(
    run: Run, monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[str] = []
    how = Execution(progress=lambda what, done, total: asked.append(what.partition(",")[0]))
    before = score(run, "prediction", "control")
    control = {name: one for name, one in before.figures.items() if name.startswith("control_")}
    for module in ("standing", "run_report"):
        monkeypatch.setattr(f"dmotion_bench.scoring.{module}.SCORING_VERSION", 2)

    renewed = score(run, "prediction", how=how, renew=False)

    assert "single steps" in asked
    assert not any(what.startswith("control by") for what in asked)
    assert renewed.scoring_version == 2
    assert {name: one for name, one in renewed.figures.items() if name.startswith("control_")} == control
    assert score(run, "control", how=how, renew=False) == renewed
    monkeypatch.setattr("dmotion_bench.scoring.control.CONTROL_VERSION", 2)
    assert not any(name.startswith("control_") for name in score(run, "prediction").figures)


def test_a_run_is_scored_by_one_at_a_time(run: Run) -> None:
    def score_too(what: str, done: int, total: int) -> None:
        with pytest.raises(FolderInUse, match=f"another dmbench is writing into '{run.path / 'report'}'; wait for it"):
            score(run, "prediction")

    score(run, how=Execution(progress=score_too))


def test_a_model_that_draws_nothing_is_controlled_by_its_features(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    class Blind(Known):
        needs_pixels = False

        def frame(self, state: Any) -> Tensor:
            raise AssertionError("nobody should look")

    monkeypatch.setattr("dmotion_bench.learning.runs.manifest.model_class", lambda name: Blind)
    report = score(run, "prediction", "control")
    assert "mse" not in report.figures
    assert report.figures["control_distance[3]"]["n"] == 3


def test_samples_of_before_control_was_scored_can_be_read(run: Run, tmp_path: Path) -> None:
    score(run, "prediction")
    table = pq.read_table(run.path / "report/samples.parquet")
    pq.write_table(table.drop_columns(["task", "control_distance", "control_lost"]), tmp_path / "old.parquet")
    old = read_samples(tmp_path / "old.parquet")
    assert old.schema == read_samples(run.path / "report/samples.parquet").schema
    assert old["control_distance"].null_count == len(old)


def test_what_cannot_be_controlled_gets_a_sentence(make_run: MakeRun, tmp_path: Path, grid: Dataset) -> None:
    with pytest.raises(DatasetError, match="stores no control tasks; record a data set with some"):
        score_run(make_run(tmp_path / "run").path, metrics=("prediction", "control"))
    assert not (tmp_path / "run/report").exists()
    with pytest.raises(DatasetError, match="--tasks"):
        require_tasks(grid)


def test_the_true_simulator_keeps_what_a_planner_looks_at(tasks: Dataset) -> None:
    """Also where it is judged by true positions, for which nothing need be seen."""
    settings = ("samples=5", "elites=2", "horizon=1", "depth=2")
    assert score_reference("oracle", tasks, replace(SCORING, planner="icem-graph", planner_set=settings)).planned == 9


def test_progress_counts_control_steps(tasks: Dataset) -> None:
    seen: list[ControlProgress] = []
    score_reference("random", tasks, SCORING, progress=seen.append)
    assert (seen[-1].steps, seen[-1].total) == (9, 9)
    kept = json.loads(next((tasks.path / "cache").glob("control-random-*.json")).read_text())
    assert np.array([one["distance"] for one in kept["tasks"].values()]).shape == (3, 4)


def test_a_report_names_the_solver_and_the_objective_in_full(run: Run) -> None:
    report = score(run, "prediction", "control")
    assert report.settings["control_version"] == CONTROL_VERSION
    solver, objective = report.planning["solver"], report.planning["objective"]
    assert (solver["name"], solver["samples"], solver["step_discount"]) == ("cem", 3, 0.0)
    assert (objective["name"], objective["fully_seen"], objective["positions.BITS"]) == ("tracked", 0.85, 5)
    assert report.planning["arithmetic"] in ("float32", "bfloat16")
    assert score(run, "prediction").planning == report.planning


def test_control_stays_where_its_environment_is_not_installed(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    before = score(run)

    def absent(*_: object, **__: object) -> None:
        raise UnknownName("environment", "of another package", [])

    monkeypatch.setattr("dmotion_bench.planning.choices.environment_class", absent)
    kept = score(run, "prediction")
    assert before.figures.items() <= kept.figures.items()
    assert kept.planning == before.planning
    with pytest.raises(UnknownName):
        score(run, "control")


def test_control_by_a_planner_that_is_not_installed_is_not_dropped(run: Run) -> None:
    score(run)
    stored = json.loads((file := run.path / "report" / "report.json").read_text())
    stored["settings"]["control_planner"] = "luck"
    file.write_text(json.dumps(stored))

    with pytest.raises(DmbenchError, match=r"holds control by what is not installed here: .*'luck'.* Install the pack"):
        score(run, "prediction")
    assert json.loads(file.read_text()) == stored


def test_figures_of_other_settings_are_not_kept(run: Run, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[str] = []
    how = Execution(progress=lambda what, done, total: asked.append(what.partition(",")[0]))
    score(run)
    for other in (
        replace(SCORING, planner_set=("samples=4", "horizon=2", "iterations=1", "elites=2")),
        replace(SCORING, objective="tracked", objective_set=("fully_seen=0.8",)),
    ):
        report = score(run, how=how, settings=replace(QUICK, control=other), renew=False)
        assert "control by the model" in asked
        asked.clear()
        assert report.settings["control_planner_set"] == list(other.planner_set)
        assert report.settings["control_objective_set"] == list(other.objective_set)
    other_default = Tracked(fully_seen=0.7)  # of another release
    monkeypatch.setattr("dmotion_bench.scoring.control.make_objective", lambda name, settings: other_default)
    assert not any(name.startswith("control_") for name in score(run, "prediction").figures)


def test_a_report_in_the_words_of_an_earlier_release_stays_true(run: Run) -> None:
    plain = replace(QUICK, control=ControlScoring(tasks=1, steps=1))  # an earlier release could set no field
    score(run, settings=plain)
    path = run.path / "report/report.json"
    now = json.loads(path.read_text())
    planning = earlier_planning(now["planning"])
    assert planning is not None
    assert (planning["planner"]["class"], planning["cost"]["tracking.CLEAR"]) == ("CrossEntropyPlanner", 0.85)
    old = now | {"planning": planning | {"arithmetic": now["planning"]["arithmetic"]}}
    settings = {
        name: value for name, value in now["settings"].items() if "_set" not in name and "objective" not in name
    }
    path.write_text(json.dumps(old | {"settings": settings | {"control_cost": None}}))
    asked: list[str] = []
    how = Execution(progress=lambda what, done, total: asked.append(what.partition(",")[0]))

    kept = score(run, "prediction", how=how, settings=plain)

    assert not any(what.startswith("control") for what in asked)
    assert kept.planning == now["planning"]
    assert {name for name in kept.figures if name.startswith("control_")}


def in_the_earlier_format(file: Path) -> dict[str, Any]:
    """A journal as releases before the checksum wrote it."""
    content = json.loads(file.read_text())
    assert content.pop("crc32")
    return content | {"format": "dmbench-control/1"}


def test_a_reference_that_was_kept_under_a_hash_of_the_code_is_kept(tasks: Dataset) -> None:
    """The oracle takes hours: what it did is not done again because versions have names now."""
    result = score_reference("oracle", tasks, SCORING)
    (new,) = (tasks.path / "cache").glob("control-oracle-*.json")
    content = in_the_earlier_format(new)
    planner = "CrossEntropyPlanner(samples=3, horizon=2, iterations=1, elites=2, stickiness=0.0, kept=0, haste=0.0)"
    common = {name: content["key"][name] for name in ("dataset", "who", "device", "steps", "seed", "group")}
    key = {"code": "0.1.0+4fa30b762c67", "planner": planner, "cost": None} | common
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:12]
    new.unlink()
    old = new.with_name(f"control-oracle-{digest}.json")

    old.write_text(json.dumps(content | {"key": key | {"code": "0.1.0+2140d529a1bd"}}))
    assert score_reference("oracle", tasks, SCORING).planned == 9
    old.write_text(json.dumps(content | {"key": key}))
    assert "oracle" in _known(tasks, SCORING)
    again = score_reference("oracle", tasks, replace(SCORING, tasks=4))
    assert again.planned == 6  # of the last group alone
    np.testing.assert_array_equal(again.actions[:3], result.actions)
    assert score_reference("oracle", tasks, replace(SCORING, tasks=4)).planned == 0


def test_a_reference_that_was_kept_in_the_words_of_an_earlier_release_is_kept(tasks: Dataset) -> None:
    score_reference("oracle", tasks, SCORING)
    (new,) = (tasks.path / "cache").glob("control-oracle-*.json")
    content = in_the_earlier_format(new)
    key = content["key"] | {"planning": earlier_planning(content["key"]["planning"])}
    digest = hashlib.sha256(json.dumps(key, sort_keys=True).encode()).hexdigest()[:12]
    new.unlink()
    new.with_name(f"control-oracle-{digest}.json").write_text(json.dumps(content | {"key": key}))
    assert score_reference("oracle", tasks, SCORING).planned == 0


def test_a_task_that_ends_at_the_limit_itself_is_solved() -> None:
    """Distances are stored in single precision, in which 0.2 is a little more than in double."""
    stored = np.array([0.2, np.nextafter(np.float32(0.2), np.float32(1)), 0.1, 0.3], np.float32)
    assert is_solved(stored).tolist() == [1, 0, 1, 0]
    assert is_solved(stored.astype(np.float64), 0.1).tolist() == [0, 0, 1, 0]
