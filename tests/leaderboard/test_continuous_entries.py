"""Entries of continuous actions: they keep what was done, to the last bit, and show pictures."""

from __future__ import annotations

import copy
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from known_model import stands_for_every_model, write_run

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import EntryInvalid
from dmotion_bench.learning.runs.manifest import stored_actions
from dmotion_bench.planning.agents import known_actions
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.control import ControlScoring, control_samples, score_control
from dmotion_bench.scoring.reference_control import score_reference
from dmotion_bench.scoring.report import read_report, write_report
from dmotion_bench.scoring.samples import read_samples, vectors, write_samples
from dmotion_bench.scoring.score import score_run
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace
from leaderboard.action_texts import actions_of, are_kept, as_text, read_action
from leaderboard.build import entry_of_run
from leaderboard.check import CheckSettings, check_entry
from leaderboard.entry import Entry
from leaderboard.entry_file import read_entry, write_entry
from leaderboard.pictures import from_png

FEW = ("samples=4", "horizon=2", "iterations=1", "elites=2")
SCORING = ControlScoring(tasks=2, steps=3, group=2, planner_set=FEW)
QUICK = CheckSettings(score=False)
MOVE = Continuous(names=("dx", "dy"), low=(-1.0, -1e300), high=(1.0, 1e300), units=("m", ""))


@pytest.fixture(autouse=True)
def _quick(monkeypatch: pytest.MonkeyPatch) -> None:
    stands_for_every_model(monkeypatch)


@pytest.fixture(scope="module")
def workspace(tmp_path_factory: pytest.TempPathFactory) -> Workspace:
    """A run on continuous actions, scored for predictions and control, with the oracle beside it; read only."""
    made = Workspace(tmp_path_factory.mktemp("continuous"))
    recipe = DatasetRecipe(
        environment="planar_push",
        parameters={"actions": "continuous"},
        policy="push",
        episodes=20,
        frames=24,
        tasks=2,
    )
    record_dataset(made.data / "moved-tiny", recipe)
    dataset = Dataset.open(made.data / "moved-tiny")
    with pytest.MonkeyPatch.context() as patch:
        stands_for_every_model(patch)
        run = write_run(made.runs / "known", dataset, actions=stored_actions(dataset.spec.actions), labels="64")
        run.finish({**(run.result or {}), "labels": {"demonstrations": 64}, "labels_total": 64})
        score_reference("oracle", dataset, SCORING)
        settings = ScoreSettings(resamples=100, control=SCORING)
        score_run(run.path, metrics=("prediction", "control"), settings=settings)
    return made


@pytest.fixture
def entry(workspace: Workspace) -> Entry:
    return entry_of_run(workspace.runs / "known")


def _content(entry: Entry) -> dict[str, Any]:
    return copy.deepcopy(dict(entry.content))


@pytest.mark.slow
def test_actions_survive_samples_and_entry_bit_for_bit(workspace: Workspace, tmp_path: Path) -> None:
    dataset = Dataset.open(workspace.data / "moved-tiny")
    result = score_control("oracle", dataset, SCORING)
    table = control_samples("oracle", result)
    write_samples(tmp_path / "samples.parquet", table)
    read = vectors(read_samples(tmp_path / "samples.parquet"), "command")
    assert read is not None
    moments = read.reshape(2, 4, 2)
    assert moments[:, :3].tobytes() == result.actions.tobytes()
    assert np.isnan(moments[:, 3]).all()

    told = [task["actions"].split() for task in actions_of(table)["oracle"]]
    entered = [[read_action(one, known_actions(dataset.spec)) for one in own] for own in told]
    assert np.array(entered).tobytes() == result.actions.tobytes()


@pytest.mark.parametrize(
    "numbers", [(-0.0, 5e-324), (0.1 + 0.2, 1.7976931348623157e299), (1e-5, -1e300), (1.0, 123456789.0)]
)
def test_a_number_is_written_as_it_is_read(numbers: tuple[float, float]) -> None:
    assert np.array(read_action(as_text(np.array(numbers)), MOVE)).tobytes() == np.array(numbers).tobytes()


def test_what_is_no_action_is_none() -> None:
    for text in ("0.5", "0.5,0.5,0.5", "2.0,0.0", "9e999,0.0", "-1"):
        assert read_action(text, MOVE) is None
    assert np.isnan(read_action("none", MOVE)).all()
    assert as_text(np.full(2, np.nan)) == "none"
    assert not are_kept({"model": [{"actions": "-1 -1"}]})
    assert are_kept({"model": [{"actions": "-1 -1"}, {"actions": "-1.0 1.0"}]})


@pytest.mark.slow
def test_a_sound_entry_holds(workspace: Workspace, entry: Entry, tmp_path: Path) -> None:
    for settings in (CheckSettings(), QUICK):
        verdict = check_entry(entry, workspace, settings)
        assert (verdict.findings, verdict.missing) == ((), ())
    assert set(entry.content["control"]) == {"model", "oracle"}
    assert read_entry(write_entry(entry, tmp_path)).content == entry.content


@pytest.mark.slow
@pytest.mark.parametrize("who", ["model", "oracle"])
def test_a_changed_action_is_found(workspace: Workspace, entry: Entry, who: str) -> None:
    content = _content(entry)
    taken = content["control"][who][1]["actions"].split()
    first, second = map(float, taken[1].split(","))
    taken[1] = f"{float(np.nextafter(first, 0))!r},{second!r}"
    content["control"][who][1]["actions"] = " ".join(taken)
    findings = check_entry(Entry(content), workspace, QUICK).findings
    assert any(f"of the control of {who} are not what happens: task 1, step 1" in one for one in findings)


@pytest.mark.parametrize("action", ["0.5", "1e+5,0.0", "-1"])
def test_an_action_that_cannot_be_is_found(workspace: Workspace, entry: Entry, action: str) -> None:
    content = _content(entry)
    taken = content["control"]["model"][0]["actions"].split()
    content["control"]["model"][0]["actions"] = " ".join([action, *taken[1:]])
    findings = check_entry(Entry(content), workspace, QUICK).findings
    assert any("control of model: a task has not 3 actions within dx" in one for one in findings), findings


def test_what_is_no_number_breaks_the_schema(entry: Entry) -> None:
    for text in ("none,none 0.0,0.0 0.0,0.0", "nan,0.0", "1.2.3,0.0", "0.0,", "0x1,0.0"):
        content = _content(entry)
        content["control"]["model"][0]["actions"] = text
        with pytest.raises(EntryInvalid, match="does not match"):
            Entry(content)


@pytest.mark.slow
def test_another_player_than_the_model_is_found_by_planning_anew(workspace: Workspace, entry: Entry) -> None:
    content = _content(entry)
    for task in content["control"]["model"]:
        task["actions"] = " ".join(["0.01,0.0"] * 3)
    findings = check_entry(Entry(content), workspace, CheckSettings()).findings
    assert any("actions are not the model's" in one and "and it plans" in one for one in findings)


def test_an_entry_of_before_opens_and_says_what_cannot_be_repeated(workspace: Workspace, tmp_path: Path) -> None:
    """Its report's control rows have no commands, and its actions are all -1."""
    copied = Workspace(tmp_path)
    run = shutil.copytree(workspace.runs / "known", copied.runs / "known")
    copied.data.symlink_to(workspace.data)
    report, table = read_report(run / "report"), read_samples(run / "report" / "samples.parquet")
    assert report is not None
    control = table["metric"].to_numpy(zero_copy_only=False) == "control"
    commands = [None if is_one else one for is_one, one in zip(control, table["command"].to_pylist(), strict=True)]
    place = table.column_names.index("command")
    field = table.schema.field(place)
    write_report(run / "report", report, table.set_column(place, field, pa.array(commands, field.type)))
    entry = entry_of_run(run)
    assert entry.content["control"]["model"][0]["actions"] == "-1 -1 -1"
    verdict = check_entry(read_entry(write_entry(entry, tmp_path)), copied, QUICK)
    assert verdict.findings == ()
    assert any("made before continuous actions were kept" in one for one in verdict.missing)


def test_pictures_show_what_they_say(workspace: Workspace, entry: Entry) -> None:
    dataset = Dataset.open(workspace.data / "moved-tiny")
    assert {one["pushed"] for one in entry.pictures} == {True, False}
    for picture in entry.pictures:
        frames, step = dataset.video(picture["episode"]), picture["step"]
        np.testing.assert_array_equal(from_png(picture["truth"]), frames[step + 1])
        np.testing.assert_array_equal(from_png(picture["predicted"]), frames[step])  # its model changes nothing
        action = dataset.states(picture["episode"]).actions[step]
        assert picture["action"] == f"dx {round(action[0], 4) + 0.0:g} m, dy {round(action[1], 4) + 0.0:g} m"


def test_many_numbers_are_described_by_the_first_few() -> None:
    many = Continuous(names=tuple("abcdef"), low=(-1.0,) * 6, high=(1.0,) * 6, units=("",) * 6)
    assert many.describe([0.5, -0.25, -0.0001, 1, 0, 0]) == "a 0.5, b -0.25, c 0, d 1, and 2 more"
