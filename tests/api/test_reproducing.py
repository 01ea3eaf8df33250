"""A table as one command: what a dry run counts is what is done, once; a killed one ends with the same bytes."""

from __future__ import annotations

import dataclasses
import json
import multiprocessing
import os
import signal
from collections import Counter
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from dmbench_command import dmbench
from small_tables import CONTROL, TABLE, Known

import dmotion_bench as dm
from dmotion_bench import registry
from dmotion_bench.api import contract, reproducing, table_work
from dmotion_bench.cli import progress, reproduce
from dmotion_bench.errors import UsageError
from dmotion_bench.execution.job_progress import JobProgress
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.training import table as learning_table
from dmotion_bench.planning.columns import COLUMNS
from dmotion_bench.recording import session
from dmotion_bench.reproduction.settled import Page
from dmotion_bench.reproduction.table import Table
from dmotion_bench.scoring import side_by_side
from dmotion_bench.scoring.score import score_run
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset

FROZEN = dataclasses.replace(
    registry.table("control"),
    worlds=tuple(
        dataclasses.replace(one, episodes=12, frames=30)
        for one in registry.table("control").worlds
        if one.environment == "planar_push"
    ),
    entrants=CONTROL.entrants,
    columns=tuple(dataclasses.replace(one, tasks=1, steps=1) for one in registry.table("control").columns),
    preset=Preset.TINY,
    seeds=(0,),
)


class Stopped(Exception):
    """Raised in the middle of a table."""


@pytest.fixture(autouse=True)
def _no_probes(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reproducing, "Speeds", lambda **_: Known())


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The table, made without an interruption."""
    root = tmp_path_factory.mktemp("whole")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(reproducing, "Speeds", lambda **_: Known())
        dm.reproduce(TABLE, workspace=root, workers=1)
    return root


@pytest.fixture
def done(monkeypatch: pytest.MonkeyPatch) -> Counter[str]:
    """How many jobs of each kind were done in this process."""
    counted: Counter[str] = Counter()

    def counting(kind: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def called(*given: Any, **named: Any) -> Any:
            counted[kind] += 1
            return function(*given, **named)

        return called

    places: list[tuple[Any, str, str]] = [
        (session, "record_shard", "record"),
        (contract, "train_rows", "train"),
        (learning_table, "train", "whole trainings"),
        (side_by_side, "score_job", "score"),
        (table_work, "score_reference_job", "oracle"),
    ]
    for module, name, kind in places:
        monkeypatch.setattr(module, name, counting(kind, getattr(module, name)))
    part = table_work.leaderboard_part
    monkeypatch.setattr(table_work, "leaderboard_part", lambda name: counting("page", part(name)))
    return counted


def content(root: Path) -> dict[str, object]:
    """What the table is made of: bytes of recordings and samples, hashes of weights, figures of entries."""
    found: dict[str, object] = {}
    for path in sorted(root.glob("data/*/video/*.mcap")) + sorted(root.glob("runs/*/report/samples.parquet")):
        found[str(path.relative_to(root))] = path.read_bytes()
    for path in sorted(root.glob("runs/*/")):  # a killed process may leave a lock file beside them
        result = Run.open(path).result or {}
        found[path.name] = result.get("weights"), result.get("labels_total")
    for path in sorted(root.glob("reports/**/entries/*.json")):
        found[path.name] = json.loads(path.read_bytes())["figures"]
    return found


@pytest.mark.slow
def test_a_dry_run_counts_what_is_done_and_nothing_is_done_twice(tmp_path: Path, done: Counter[str]) -> None:
    told = dm.reproduce(TABLE, workspace=tmp_path, dry_run=True).cost
    assert not list(tmp_path.iterdir())
    assert {line.what: line.amount for line in told.lines if line.kind == "train"} == {
        "lapo": "3 runs, 1 whole training",
        "ed-cnn": "2 runs, 2 whole trainings",  # which cannot use demonstrations
    }
    made = dm.reproduce(TABLE, workspace=tmp_path, workers=1)
    assert not made.failures
    for kind in ("record", "train", "score", "page"):
        assert told.jobs(kind) == done[kind] > 0, kind
    assert [path.name for path in made.pages] == ["index.html"]
    assert len(made.runs) == 5
    labels = {path.name: (Run.open(path).result or {})["labels_total"] for path in made.runs}
    assert sorted(labels.values())[:4] == [1, 2, 4, 8]
    shared = [path for path in made.runs if Run.open(path).manifest.get("trained_as")]
    assert [Run.open(path).spec.model for path in shared] == ["lapo", "lapo"]

    before = Counter(done)
    again = dm.reproduce(TABLE, workspace=tmp_path, workers=1)
    assert done == before
    assert (again.pages, again.runs) == (made.pages, made.runs)
    assert not any(line.jobs for line in again.cost.lines)


@pytest.mark.slow
def test_parts_that_are_made_one_after_the_other_stand_on_one_page(tmp_path: Path) -> None:
    for models in ("lapo", "ed-cnn"):
        (page,) = dm.reproduce(TABLE, models=[models], workspace=tmp_path, workers=1).pages
    shown = page.read_text()
    assert all(path.name in shown for path in tmp_path.glob("runs/*/"))
    assert not any(line.jobs for line in dm.reproduce(TABLE, workspace=tmp_path, dry_run=True).cost.lines)
    assert Page(page.parent).beside((), Preset.SMALL) == []  # these were trials


@pytest.mark.slow
def test_one_that_is_stopped_in_each_part_goes_on_and_ends_the_same(whole: Path, tmp_path: Path) -> None:
    for part in ("recording", "training", "scoring prediction", "building own"):
        seen: list[str] = []

        def stop(told: JobProgress, part: str = part, seen: list[str] = seen) -> None:
            seen.append(told.what)
            if told.what == part and told.done >= 1:
                raise Stopped

        with pytest.raises(Stopped):
            dm.reproduce(TABLE, workspace=tmp_path, workers=1, progress=stop)
        assert seen[-1] == part
    dm.reproduce(TABLE, workspace=tmp_path, workers=1)
    assert content(tmp_path) == content(whole)
    assert not list(tmp_path.glob(".jobs-*"))


def _until(part: str, at: float, root: Path, table: Table = TABLE, workers: int = 2) -> None:
    """Kill this process in the middle of a part of a table."""

    def kill(told: JobProgress) -> None:
        if told.what == part and told.done >= at:
            os.kill(os.getpid(), signal.SIGKILL)

    reproducing.Speeds = lambda **_: Known()  # type: ignore[assignment, misc]
    dm.reproduce(table, workspace=root, workers=workers, progress=kill)


@pytest.mark.slow
def test_one_that_is_killed_three_times_ends_with_the_same_bytes(whole: Path, tmp_path: Path) -> None:
    context = multiprocessing.get_context("forkserver")
    for part, at in (("training", 0), ("training", 2), ("scoring prediction", 1)):
        process = context.Process(target=_until, args=(part, at, tmp_path))
        process.start()
        process.join(180)
        assert process.exitcode == -signal.SIGKILL
    dm.reproduce(TABLE, workspace=tmp_path, workers=2)
    assert content(tmp_path) == content(whole)


@pytest.mark.slow
def test_each_column_of_control_keeps_its_page(tmp_path: Path, done: Counter[str]) -> None:
    told = dm.reproduce(CONTROL, workspace=tmp_path, dry_run=True).cost

    def stop(part: JobProgress) -> None:
        if part.what == "scoring second":
            raise Stopped

    with pytest.raises(Stopped):
        dm.reproduce(CONTROL, workspace=tmp_path, workers=1, progress=stop)
    made = dm.reproduce(CONTROL, workspace=tmp_path, workers=1)
    assert not made.failures
    assert [told.jobs(kind) for kind in ("oracle", "page")] == [done["oracle"], done["page"]] == [1, 2]
    objectives, references = [], []
    for page in made.pages:
        entries = [json.loads(path.read_bytes()) for path in (page.parent / "entries").glob("ed-cnn*.json")]
        (entry,) = [one for one in entries if one["kind"] == "measured"]
        objectives.append(entry["settings"]["control_objective"])
        assert (entry["settings"]["control_tasks"], entry["settings"]["control_steps"]) == (2, 4)
        assert entry["figures"]["control_distance[4]"]["n"] == 2
        references.append({"oracle", "idle"} & {*entry["reference"]})
    assert objectives == ["centres", "tracked"]
    assert references == [{"oracle", "idle"}, {"idle"}]
    before = Counter(done)
    again = dm.reproduce(CONTROL, workspace=tmp_path, workers=1)
    assert done == before
    assert not any(line.jobs for line in again.cost.lines)


@pytest.mark.slow
def test_what_lacks_its_reference_or_its_page_is_left(
    tmp_path: Path, done: Counter[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    table = dataclasses.replace(CONTROL, columns=CONTROL.columns[:1])
    kinds = ("train", "oracle", "score", "page")

    def left() -> list[int]:
        return [dm.reproduce(table, workspace=tmp_path, dry_run=True).cost.jobs(kind) for kind in kinds]

    with monkeypatch.context() as patch:
        patch.setattr(table_work, "score_reference_job", lambda job: (job.data, "no memory."))
        made = dm.reproduce(table, workspace=tmp_path, workers=1)
    assert made.failures == {"control by oracle for first": "no memory."}
    assert (made.pages, done["score"]) == ((), 0)  # the model waits for its reference
    assert left() == [0, 1, 2, 1]

    (run,) = made.runs
    (scoring,) = reproducing.plan_table(table, workspace=tmp_path).scorings
    score_run(run, metrics=scoring.metrics(), settings=scoring.settings)
    assert "oracle" not in json.loads((run / "report" / "report.json").read_bytes())["reference"]
    assert left() == [0, 1, 2, 1]
    (page,) = dm.reproduce(table, workspace=tmp_path, workers=1).pages
    entries = [json.loads(path.read_bytes()) for path in (page.parent / "entries").glob("ed-cnn*.json")]
    assert ["oracle" in one["reference"] for one in entries if one["kind"] == "measured"] == [True]
    assert left() == [0, 0, 0, 0]

    page.unlink()
    assert left() == [0, 0, 0, 1]
    assert dm.reproduce(table, workspace=tmp_path, workers=1).pages == (page,)
    os.utime(page, ns=(0, 0))
    assert left() == [0, 0, 0, 1]
    dm.reproduce(table, workspace=tmp_path, workers=1)
    assert left() == [0, 0, 0, 0]


@pytest.mark.slow
def test_frozen_columns_stand_on_one_page_although_killed_between_them(tmp_path: Path, done: Counter[str]) -> None:
    told = dm.reproduce(FROZEN, workspace=tmp_path, dry_run=True).cost
    runs, groups = 5, 5  # of prediction one and of five columns one each, whose tasks are a group
    assert [told.jobs(kind) for kind in ("record", "oracle", "page")] == [2, 5, 1]
    assert told.jobs("score") == 1 + runs + groups
    (page,) = (line for line in told.lines if line.kind == "page")
    assert page.amount == "6 entries"

    context = multiprocessing.get_context("forkserver")
    process = context.Process(target=_until, args=("scoring paper", 0, tmp_path, FROZEN, 1))
    process.start()
    process.join(180)
    assert process.exitcode == -signal.SIGKILL
    left = dm.reproduce(FROZEN, workspace=tmp_path, dry_run=True).cost
    kinds = ("record", "train", "oracle", "score", "page")
    assert [left.jobs(kind) for kind in kinds] == [0, 0, 2, 4, 1]
    made = dm.reproduce(FROZEN, workspace=tmp_path, workers=1)
    assert not made.failures
    assert [done[kind] for kind in kinds] == [0, 0, 2, 4, 1]

    (index,) = made.pages
    entries = [json.loads(path.read_bytes()) for path in (index.parent / "entries").glob("ed-cnn*.json")]
    measured = {one["settings"].get("control_column"): one for one in entries if one["kind"] == "measured"}
    discrete = [name for name, column in COLUMNS.items() if not column.continuous]
    assert {*measured} == {None, *discrete}
    for name in discrete:
        assert measured[name]["protocol"] == COLUMNS[name].protocol
        assert measured[name]["dataset"]["name"] == "planar_push-test-tiny"
        assert {"oracle", "idle", "random"} <= {*measured[name]["reference"]}
        assert measured[name]["figures"]["control_distance[1]"]["n"] == 1
    assert "mse" in measured[None]["figures"]
    assert measured[None]["dataset"]["name"] == "planar_push-tiny"
    assert not any(line.jobs for line in dm.reproduce(FROZEN, workspace=tmp_path, dry_run=True).cost.lines)


def test_a_model_on_request_is_counted_only_where_it_is_named(tmp_path: Path) -> None:
    always, asked = TABLE.entrants
    table = dataclasses.replace(TABLE, entrants=(always, dataclasses.replace(asked, on_request=True)))
    for models, trained in ((None, ["lapo"]), (["ed-cnn"], ["ed-cnn"]), (["lapo", "ed-cnn"], ["lapo", "ed-cnn"])):
        cost = dm.reproduce(table, models=models, workspace=tmp_path, dry_run=True).cost
        assert [line.what for line in cost.lines if line.kind == "train"] == trained


def test_the_command_says_the_cost_and_what_is_wrong(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    monkeypatch.setenv("COLUMNS", "120")
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {(registry.TABLES, "mine"): TABLE})

    def ran(*words: str) -> Any:
        return dmbench(["reproduce", *words], capsys, monkeypatch)

    out = ran("mine", "--dry-run").out
    assert "Left of the table 'mine', three budgets of" in out.replace("\n", " ")
    assert "grid_world" in out
    assert "3 runs, 1 whole training" in out
    assert "CPU seconds of one core" in out
    left: Mapping[str, Any] = json.loads(ran("mine", "--dry-run", "--json").out)["left"]
    assert sum(line["jobs"] for line in left["lines"]) == 1 + 3 + 5 + 1
    assert not list(tmp_path.iterdir())
    for words, says in (
        (("papr",), "no table named 'papr'; did you mean 'paper'?"),
        (("mine", "--seeds", "0,x"), "--seeds holds 'x'; give whole numbers"),
        (("mine", "--models", "cswm"), "no model of this table named 'cswm'"),
        (("mine", "--executor", "sge"), "no executor named 'sge'"),
    ):
        outcome = ran(*words)
        assert outcome.code == 2
        assert says in outcome.sentence()


def test_ctrl_c_says_how_to_go_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def interrupted(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {(registry.TABLES, "mine"): TABLE})
    monkeypatch.setattr(table_work, "record_recipe", interrupted)
    outcome = dmbench(["reproduce", "mine"], capsys, monkeypatch)
    assert outcome.code == 130
    assert "run the same command again to go on where it stopped, with '--dry-run' to see what is left" in outcome.err


@pytest.mark.slow
def test_a_data_set_of_another_recipe_is_not_taken(tmp_path: Path) -> None:
    other = dm.record("grid_world", "tiny", episodes=12, frames=6, seed=1, out=tmp_path / "data" / "grid_world-tiny")
    for dry_run in (True, False):  # it is said before anything is counted
        with pytest.raises(dm.DmbenchError, match=r"seed is 1 there and 0 here.*; for a new one rename that folder"):
            dm.reproduce(TABLE, workspace=tmp_path, workers=1, dry_run=dry_run)
    assert Dataset.open(other.dataset).recipe.seed == 1


def test_jobs_that_run_stand_beside_the_part_that_was_counted_last(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.delenv(progress.QUIET)
    monkeypatch.setattr(progress, "FIRST_SECONDS", 0.0)
    monkeypatch.setattr(progress, "SECONDS", 0.0)
    with reproduce._watching() as watch:
        for part in ("control", "scoring", "control"):
            watch.count(part, 0, 1)
        watch.jobs({"1": JobProgress(what="a job", done=1, total=4)})
    assert capsys.readouterr().err.splitlines()[-1] == "control: 0 of 1, a job 25%"


def test_trainings_that_fail_in_two_worlds_are_two_failures() -> None:
    plan: Any = SimpleNamespace(workspace=None)
    work = table_work.TableWork(plan, reproducing.Hands(), table_work.Watch())
    row = learning_table.Row(model="dmotion", labels="one-shot")

    for why in ("no space", "no memory"):
        work._note_outcome(learning_table.Outcome(row=row, run=None, error=why))

    assert list(work.failures.values()) == ["no space", "no memory"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"workers": 0}, "workers is 0; it must be a whole number of 1 or more"),
        ({"workers": "2"}, "workers is '2'; it must be a whole number"),
        ({"executor": "slrum"}, "no executor named 'slrum'; did you mean 'slurm'"),
        ({"seeds": [-1]}, "a seed is -1"),
        ({"models": []}, "no model of this table is named; name at least one: lapo, ed-cnn"),
        ({"worlds": []}, "no world of this table is named; name at least one: grid_world"),
    ],
)
def test_what_cannot_be_is_said_before_anything_is_recorded(given: dict[str, Any], said: str, tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=said):
        dm.reproduce(TABLE, workspace=tmp_path, dry_run=True, **given)
