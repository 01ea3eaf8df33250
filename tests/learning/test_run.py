"""A run finds its data set from any folder, and after its workspace has moved; runs of earlier versions go on."""

from __future__ import annotations

import dataclasses
import functools
import shutil
from pathlib import Path

import pytest
import torch
from known_model import result_of, spec_with
from walking_square import record_walks

from dmotion_bench.actions import Discrete
from dmotion_bench.api.viewing import find_targets, follower_of
from dmotion_bench.errors import DatasetMissing, InvalidSetting, RunCorrupt, RunError, RunMismatch
from dmotion_bench.learning.model import TrainingConfig
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.manifest import stored_actions
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.learning.runs.run import Run, RunSpec
from dmotion_bench.learning.settings import to_json
from dmotion_bench.learning.training.shared_pretraining import take_over
from dmotion_bench.registry import model_class
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.workspace import Workspace


@pytest.fixture
def workspace(tmp_path: Path) -> Path:
    (tmp_path / "work" / "data" / "grid").mkdir(parents=True)
    (tmp_path / "work" / "data" / "grid" / "dataset.json").write_text("{}")
    return tmp_path / "work"


def run_of(workspace: Path, dataset_path: str) -> Run:
    """A run whose manifest names this path."""
    (workspace / "runs").mkdir(exist_ok=True)
    shutil.rmtree(workspace / "runs" / "one", ignore_errors=True)
    made = Run.create_or_open(workspace / "runs" / "one", _asked(), dataset_path=Path(dataset_path), versions={})
    made.write()
    return Run.open(made.path)


def test_from_another_folder(workspace: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert run_of(workspace, "data/grid").dataset_path == workspace / "data" / "grid"
    other = tmp_path / "data" / "grid"  # of the same name, where the command is typed
    other.mkdir(parents=True)
    (other / "dataset.json").write_text("{}")
    assert run_of(workspace, "data/grid").dataset_path == workspace / "data" / "grid"
    assert run_of(workspace, str(other)).dataset_path == other


def test_in_a_workspace_that_has_moved(workspace: Path, tmp_path: Path) -> None:
    run_of(workspace, str(workspace / "data" / "grid"))
    moved = workspace.rename(tmp_path / "moved")
    assert Run.open(moved / "runs" / "one").dataset_path == moved / "data" / "grid"


@pytest.mark.parametrize(
    "name", ["run.json", "best.safetensors", "metrics.jsonl", "samples", "samples/00000001.png", "report", "new"]
)
def test_nothing_that_lies_elsewhere_is_read_or_written(workspace: Path, tmp_path: Path, name: str) -> None:
    """A run may come from somebody else, and name a file or a folder of whoever opens it."""
    run, elsewhere = run_of(workspace, "data/grid").path, tmp_path / "elsewhere"
    path = run / name
    elsewhere.mkdir()
    path.parent.mkdir(exist_ok=True)
    if path.exists():
        path.rename(elsewhere / path.name)
    path.symlink_to(elsewhere / path.name)
    with pytest.raises(RunError, match=rf"{name}' is a link that leads out of the run's folder, to '.*/elsewhere/"):
        Run.open(run)
    with pytest.raises(RunError, match="leads out of the run's folder"):
        follower_of(find_targets([run], Workspace(workspace)))


def test_links_within_a_run_and_those_of_other_programs_are_left_alone(workspace: Path, tmp_path: Path) -> None:
    """Weights & Biases links its own log, which is elsewhere, into its folder in the run."""
    path = run_of(workspace, "data/grid").path
    for name in ("wandb/run/logs", "tensorboard", ".git"):
        (path / name).mkdir(parents=True)
        (path / name / "debug-core.log").symlink_to(tmp_path / "core.log")
    (path / "last.safetensors").symlink_to("best.safetensors")
    path.rename(tmp_path / "one")
    path.symlink_to(tmp_path / "one")
    assert Run.open(path).dataset_path == workspace / "data" / "grid"


def test_what_is_gone_is_named_as_it_was_given(workspace: Path) -> None:
    assert run_of(workspace, "data/other").dataset_path == Path("data/other")


def test_a_data_set_is_found_under_another_name_by_its_fingerprint(tmp_path: Path) -> None:
    data = tmp_path / "data"
    meant = Dataset.open(record_walks(data / "published"))
    record_walks(data / "grid", episodes=15)  # another one has its name
    spec = dataclasses.replace(_asked(), fingerprint=meant.fingerprint)
    run = Run.create_or_open(tmp_path / "runs" / "one", spec, dataset_path=Path("data/grid"), versions={})
    assert run.dataset_path == meant.path
    assert dataset_of(run, Dataset).fingerprint == meant.fingerprint
    shutil.rmtree(data / "published")
    assert run.dataset_path == data / "grid"  # it has changed, and whoever opens it says so
    shutil.rmtree(data / "grid")
    said = rf"the run 'one' was trained on the data set 'grid', .* 'dmbench share pull {meant.fingerprint[:12]} --from"
    with pytest.raises(DatasetMissing, match=said):
        dataset_of(run, Dataset)


def _asked(**settings: object) -> RunSpec:
    config = to_json(model_class("dmotion").Config())
    training = to_json(TrainingConfig(epochs=1))
    return spec_with(config=config | settings, training=training, labels="none", height=8, width=8)


def _stored(path: Path, spec: RunSpec) -> Run:
    run = Run.create_or_open(path, spec, dataset_path=Path("data/grid"), versions={})
    path.mkdir(parents=True)
    run.write()
    return run


def test_a_run_of_before_a_setting_came_is_one_with_its_default(tmp_path: Path) -> None:
    spec = _asked()
    without = {name: value for name, value in spec.config.items() if name != "warp"}
    earlier = {name: value for name, value in spec.training.items() if name != "hard_share"}
    stored = _stored(tmp_path / "one", dataclasses.replace(spec, config=without, training=earlier))
    assert "warp" not in stored.spec.config
    assert Run.create_or_open(stored.path, spec, dataset_path=Path("data/grid"), versions={}).spec == stored.spec
    with pytest.raises(RunMismatch, match=r"config is \{warp: False\} there and \{warp: True\} here"):
        Run.create_or_open(stored.path, _asked(warp=True), dataset_path=Path("data/grid"), versions={})


def test_its_training_is_taken_over_by_another_budget(tmp_path: Path) -> None:
    spec = _asked()
    without = {name: value for name, value in spec.config.items() if name != "warp"}
    stored = _stored(tmp_path / "one", dataclasses.replace(spec, config=without))
    stored.metrics.touch()
    weights = {"a": torch.ones(3)}
    for file in (stored.best, stored.last):
        checkpoint.save(file, checkpoint.with_prefix("model", weights), {})
    stored.finish(result_of(weights))

    def of(asked: RunSpec) -> Run | None:
        labelled = dataclasses.replace(asked, labels="one-shot")
        return take_over(Run.create_or_open(tmp_path / "two", labelled, dataset_path=Path("data/grid"), versions={}))

    assert of(_asked(warp=True)) is None
    whole = stored.last.read_bytes()
    stored.last.write_bytes(whole[:-1] + bytes([whole[-1] ^ 1]))
    assert of(spec) is None  # a damaged checkpoint is not handed on
    stored.last.write_bytes(whole)
    source = of(spec)
    assert source is not None
    assert source.name == "one"


@pytest.mark.parametrize(
    ("model", "has", "opened"),
    [
        ("dmotion", "last.safetensors", ["dmotion-grid-tiny-5-shot-s0", "dmotion-wide-grid-s0", "mine", "sweep-s3"]),
        ("wm-ae", "watched.safetensors", ["mine", "sweep-s3", "wm-ae-grid-s0"]),
        ("ed-cnn", "last.safetensors", []),  # it shares nothing, as none of its runs has what could be shared
    ],
)
def test_only_runs_that_may_share_their_training_are_opened(
    model: str, has: str, opened: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A name as dmbench gives them tells the model, the data set and the seed; one of the user's own tells nothing."""
    others = ("dmotion-grid-s1", "dmotion-grid-s10", "dmotion-grids-s0", "dmotion-other-tiny-s0", "wm-ae-grid-s1")
    for name in (*others, "dmotion-grid-tiny-5-shot-s0", "dmotion-wide-grid-s0", "wm-ae-grid-s0", "mine", "sweep-s3"):
        _stored(tmp_path / name, _asked())
        (tmp_path / name / has).touch()
    _stored(tmp_path / "begun", _asked())
    asked = dataclasses.replace(_asked(), model=model, seed=0, config={}, training={})
    run = Run.create_or_open(tmp_path / "new", asked, dataset_path=Path("data/grid"), versions={})
    found, read = [], Run.open
    monkeypatch.setattr(Run, "open", lambda path: found.append(path.name) or read(path))
    assert take_over(run) is None
    assert found == opened


def test_a_setting_that_this_version_does_not_know_is_named(tmp_path: Path) -> None:
    stored = _stored(tmp_path / "one", _asked(whirl=2))
    with pytest.raises(InvalidSetting, match="whirl"):
        Run.create_or_open(stored.path, _asked(), dataset_path=Path("data/grid"), versions={})


def test_a_run_remembers_how_many_actions_each_of_several_agents_has(tmp_path: Path) -> None:
    joint = Discrete.joint(("up", "down"), ("left", "right", "stay"))
    spec = dataclasses.replace(_asked(agents=2), actions=stored_actions(joint), height=32, width=32)
    assert spec.actions == {"parts": [2, 3]}
    read = _stored(tmp_path / "one", spec).spec
    assert read.action_spec is not None
    assert read.action_spec.fits(joint)
    assert [len(names) for names in read.action_spec.parts] == [2, 3]  # type: ignore[union-attr]
    assert {"table.order", "table.tables.0.rows", "table.tables.1.rows"} < set(read.build().state_dict())
    assert stored_actions(Discrete.numbered(6)) == 6


@pytest.mark.parametrize("parts", [None, 4, [], [4], [4, 1], [4, "4"], [4, True], [64, 65], [2] * 13, [4, -4, -4]])
def test_parts_that_cannot_be_are_named(parts: object) -> None:
    with pytest.raises(InvalidSetting, match="the parts of the actions are"):
        dataclasses.replace(_asked(), actions={"parts": parts})


def test_a_run_keeps_the_names_of_its_actions_beside_what_decides_the_training(tmp_path: Path) -> None:
    names = ("up", "down", "left", "right")
    opened = functools.partial(Run.create_or_open, dataset_path=Path("data/grid"), versions={})
    run = opened(tmp_path / "one", _asked(), actions=Discrete(names))
    run.path.mkdir()
    run.write()
    read = Run.open(run.path)
    assert read.named_actions == Discrete(names)
    assert read.spec == _asked()
    assert opened(run.path, _asked(), actions=Discrete.numbered(4)).named_actions == Discrete(names)
    assert _stored(tmp_path / "before", _asked()).named_actions is None


@pytest.mark.parametrize("names", [["up"], ["up", "up", "left", "right"], [1, 2, 3, 4], "up", None])
def test_other_names_than_it_has_actions_are_refused(tmp_path: Path, names: object) -> None:
    run = _stored(tmp_path / "one", _asked())
    run.manifest["action_names"] = names
    run.write()
    with pytest.raises(RunCorrupt, match=r"run\.json' cannot be read"):
        Run.open(run.path)
