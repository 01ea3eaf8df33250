"""What holds for every model of the benchmark: the contract, exact resuming, and blindness to unpaid labels."""

from __future__ import annotations

import dataclasses
import json
import shutil
from collections.abc import Callable
from contextlib import AbstractContextManager
from importlib.metadata import entry_points
from pathlib import Path
from unittest import mock

import pytest
import torch
from noise_world import noise_episode, noise_spec

from baselines.layers import WIDTHS
from baselines.unet import UNet
from dmotion_bench.entry_points import MODELS
from dmotion_bench.errors import UsageError
from dmotion_bench.learning.hardware.devices import launch
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.learning.runs.start import TrainingRequest, open_run, training_data
from dmotion_bench.learning.training.loop import train
from dmotion_bench.learning.training.shared_pretraining import take_over
from dmotion_bench.learning.training.state import StepReport
from dmotion_bench.registry import model_class
from dmotion_bench.specs import DatasetRecipe, Preset, Supervision
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.testing import CONTINUOUS, check_model
from dmotion_bench.workspace import Workspace

pytestmark = pytest.mark.slow

NAMES = sorted(point.name for point in entry_points(group=MODELS) if point.value.startswith("baselines."))
UNSUPERVISED = [name for name in NAMES if model_class(name).supervision is Supervision.NONE]
FEW = [name for name in NAMES if model_class(name).supervision is Supervision.FEW]
SUPERVISED = [name for name in NAMES if model_class(name).supervision is Supervision.ACTIONS]
FRAMES = 5
SETTINGS = ("batch_size=4", "epochs=1", "validations=3")
NARROW = {
    **dict.fromkeys(("laom", "laom-labels"), ("embedding=32", "hidden=32")),
    **dict.fromkeys(("wm-ae", "wm-vae"), ("latent=32", "hidden=64")),
    "clasp": ("hidden=32",),
    "cswm": ("hidden=64",),
    "jepa": ("length=32", "hidden=64", "projections=64"),
}
"""Settings of models whose layers are wide: most of a short training would be to write their weights."""


class Stopped(Exception):
    """Raised by a progress callback."""


def write_noise(path: Path, side: int) -> Dataset:
    spec = noise_spec(height=side, width=side)
    recipe = DatasetRecipe(environment="noise", episodes=13, frames=FRAMES, shard_episodes=13)
    with DatasetWriter.create_or_resume(path, recipe, spec) as writer:
        writer.write_shard(0, (noise_episode(number, FRAMES, spec) for number in range(13)))
        writer.finish()
    return Dataset.open(path)


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_noise(tmp_path_factory.mktemp("data") / "noise-tiny", 32).path


@pytest.fixture(scope="module")
def trained(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Run]:
    """A finished training with the usual seed, the same one whoever asks; read only."""
    made: dict[tuple[str, str | None], Run] = {}

    def run(name: str, labels: str | None = None) -> Run:
        if (name, labels) not in made:
            made[name, labels] = _train(name, recorded, tmp_path_factory.mktemp("trained") / "run", labels)
        return made[name, labels]

    return run


def _settings(name: str) -> tuple[str, ...]:
    return SETTINGS + NARROW.get(name, ())


def _train(
    name: str,
    data: Path,
    folder: Path,
    labels: str | None = None,
    stop_at: int | None = None,
    more: tuple[str, ...] = (),
) -> Run:
    if labels is None and name in SUPERVISED:
        labels = "100%"
    dataset = Dataset.open(data)
    request = TrainingRequest(model=name, labels=labels, preset=Preset.TINY, settings=_settings(name) + more)
    run = open_run(request, dataset, folder, Workspace(folder))

    def on_step(report: StepReport) -> None:
        if report.step == stop_at:
            raise Stopped

    train(run, training_data(run, dataset), launch("cpu"), on_step)
    return Run.open(folder)


def saved_at_every_step() -> AbstractContextManager[object]:
    """Within the block a training that is killed has lost nothing."""
    return mock.patch("dmotion_bench.learning.training.loop.CHECKPOINT_SECONDS", 0.0)


def test_the_benchmarks_models_are_those_of_its_design() -> None:
    assert set(NAMES) == {
        *("dmotion", "dmotion-no-stn", "wm-ae", "wm-vae", "ed-cnn", "cswm", "clasp"),
        *("lapo", "lam-vae", "jepa", "laom", "laom-labels", "idm-ed-cnn"),
    }
    assert set(UNSUPERVISED) == {"dmotion", "dmotion-no-stn", "clasp", "lapo", "lam-vae", "laom"}
    assert set(FEW) == {"laom-labels", "idm-ed-cnn"}


@pytest.mark.parametrize("name", NAMES)
def test_the_contract_is_kept(name: str) -> None:
    check_model(model_class(name), size=32)
    check_model(model_class(name), size=32, actions=CONTINUOUS)


def test_the_papers_networks_keep_the_contract_and_train_at_64_pixels(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("baselines.dmotion_paper.MAP_SIZE", 16)  # of 64: the same layers, on a sixteenth of the pixels
    check_model(model_class("dmotion"), arch="paper")
    dataset = write_noise(tmp_path / "noise-tiny", 64)
    request = TrainingRequest(model="dmotion", arch="paper", settings=("batch_size=2", "epochs=0.1", "validations=1"))
    run = open_run(request, dataset, tmp_path / "run", Workspace(tmp_path))
    train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
    frames = dataset.video(0)
    assert Run.open(tmp_path / "run").model.predict(frames[:1], frames[1:2], 1).shape == (1, 3, 64, 64)


@pytest.mark.parametrize("name", NAMES)
def test_what_draws_with_a_u_net_can_warp_and_be_wider(name: str, build, step, video, batch) -> None:
    kind = model_class(name)
    if "warp" not in {field.name for field in dataclasses.fields(kind.Config)}:
        assert not any(isinstance(part, UNet) for part in build(kind).modules())
        return
    model = build(kind, warp=True, width=2)
    model.enter(model.phases()[-1])
    (drawing,) = (part for part in model.modules() if isinstance(part, UNet))
    before = drawing.flow.weight.clone()
    step(model, batch if kind.supervision is Supervision.ACTIONS else video, 2)
    assert not torch.equal(drawing.flow.weight, before)
    assert not any(hasattr(part, "flow") for part in build(kind).modules())
    assert drawing.widths == [2 * usual for usual in WIDTHS]


@pytest.mark.parametrize("name", sorted({*NAMES} - {"dmotion", "dmotion-no-stn"}))
def test_a_killed_run_ends_with_the_same_bits(name, recorded, trained, tmp_path) -> None:
    whole = trained(name)
    for stop_at in (2, whole.result["steps"] // 2 + 1):  # in the second phase of those that have one
        with saved_at_every_step(), pytest.raises(Stopped):
            _train(name, recorded, tmp_path / "killed", stop_at=stop_at)
    assert _train(name, recorded, tmp_path / "killed").result["weights"] == whole.result["weights"]


@pytest.mark.parametrize("name", ["dmotion", "ed-cnn"])
def test_a_killed_training_on_own_frames_ends_with_the_same_bits(name, recorded, trained, tmp_path) -> None:
    own = ("own_frames=0.9", "own_steps=2")
    whole = _train(name, recorded, tmp_path / "whole", more=own).result
    with saved_at_every_step(), pytest.raises(Stopped):
        _train(name, recorded, tmp_path / "killed", stop_at=whole["steps"] // 2 + 1, more=own)
    assert _train(name, recorded, tmp_path / "killed", more=own).result["weights"] == whole["weights"]
    assert trained(name).result["weights"] != whole["weights"]


@pytest.mark.parametrize("name", sorted({*UNSUPERVISED} - {"dmotion"}))
def test_without_the_labels_unsupervised_training_is_the_same_to_the_bit(name, recorded, trained, tmp_path) -> None:
    bare = tmp_path / "noise-tiny"
    shutil.copytree(recorded, bare)
    shutil.rmtree(bare / "labels")
    told = trained(name, "one-shot")
    untold = _train(name, bare, tmp_path / "untold", labels="none")
    assert (told.result["labels_total"], untold.result["labels_total"]) == (2, 0)
    tables = {"table", "table.rows"}
    weights, same = told.model.state_dict(), untold.model.state_dict()
    assert [key for key in weights if not torch.equal(weights[key], same[key])] == [*(tables & {*weights})]


@pytest.mark.parametrize("name", NAMES)
def test_one_label_is_a_budget_and_one_that_is_counted(name, trained) -> None:
    run = trained(name, "1")
    assert run.result["labels_total"] == 1
    frames = torch.zeros(1, 3, 32, 32)
    for action in (0, 1):  # one of them was never shown
        assert run.model.predict(frames, frames, torch.tensor([action])).isfinite().all()


@pytest.mark.parametrize("name", [*FEW, "lapo", "ed-cnn"])
def test_rows_of_a_budget_were_given_equally_many_labels(name, trained) -> None:
    assert trained(name, "16").result["labels_total"] == 16


@pytest.mark.parametrize("name", ["dmotion", "lapo", "lam-vae"])
def test_a_fine_tuning_shares_the_stage_without_labels(name, recorded, trained, tmp_path) -> None:
    """Its own bits before the labels are those of a run without any; so are another run's that takes it over."""
    tuned_by = ("adaptation=finetuned", "adaptation_steps=3")
    tuned = _train(name, recorded, tmp_path / "runs" / "tuned", labels="3-shot", more=tuned_by)
    averaged, tables = trained(name, "one-shot"), {"table", "table.rows"}
    stored, _ = checkpoint.load(tuned.unadapted, required=None)
    before = checkpoint.without_prefix("model", stored)
    weights = averaged.model.state_dict()
    assert all(torch.equal(before[key], weights[key]) for key in {*weights} - tables)
    assert any(not torch.equal(tuned.model.state_dict()[key], weights[key]) for key in {*weights} - tables)
    assert tuned.result["labels_total"] == 6
    assert tuned.result["adapted_steps"] == 3

    dataset, runs = Dataset.open(recorded), Workspace(tmp_path)
    request = TrainingRequest(model=name, labels="one-shot", preset=Preset.TINY, settings=SETTINGS)
    after = open_run(request, dataset, None, runs)
    source = take_over(after)
    assert source is not None
    assert source.path == tuned.path
    train(after, training_data(after, dataset), launch("cpu"), lambda _: None)
    assert after.result["weights"] == averaged.result["weights"]

    shutil.rmtree(tuned.path)
    wanted = dataclasses.replace(request, labels="3-shot", settings=SETTINGS + tuned_by)
    again = open_run(wanted, dataset, None, runs)
    assert take_over(again) is not None
    train(again, training_data(again, dataset), launch("cpu"), lambda _: None)
    assert again.result["weights"] == tuned.result["weights"]


@pytest.mark.parametrize("labels", ["1", "none"])
def test_no_label_of_another_run_is_left_in_a_table_that_is_taken_over(recorded, trained, tmp_path, labels) -> None:
    shutil.copytree(trained("lapo", "one-shot").path, tmp_path / "runs" / "both")
    dataset = Dataset.open(recorded)
    request = TrainingRequest(model="lapo", labels=labels, preset=Preset.TINY, settings=SETTINGS)
    fewer = open_run(request, dataset, None, Workspace(tmp_path))
    assert take_over(fewer) is not None
    train(fewer, training_data(fewer, dataset), launch("cpu"), lambda _: None)
    assert fewer.result["weights"] == trained("lapo", labels).result["weights"]


@pytest.mark.parametrize("name", ["dmotion", "lapo"])
def test_clustering_changes_the_table_alone_and_reads_no_other_label(name, recorded, trained, tmp_path) -> None:
    """Clustering once more ends with the same bits."""
    averaged, runs = trained(name, "one-shot"), Workspace(tmp_path)
    Path(shutil.copytree(averaged.path, runs.runs / "averaged"))
    dataset = Dataset.open(recorded)
    request = TrainingRequest(
        model=name, labels="one-shot", preset=Preset.TINY, settings=(*SETTINGS, "adaptation=clustered")
    )
    found = []
    for _ in range(2):
        run = open_run(request, dataset, None, runs)
        assert take_over(run) is not None
        train(run, training_data(run, dataset), launch("cpu"), lambda _: None)
        found.append(run.result["weights"])
        weights, before = run.model.state_dict(), averaged.model.state_dict()
        (table,) = (key for key in weights if key.startswith("table"))
        assert all(torch.equal(weights[key], before[key]) for key in {*weights} - {table})
        assert weights[table].shape == before[table].shape
        assert not torch.equal(weights[table], before[table])
        assert run.result["labels_total"] == averaged.result["labels_total"]
        shutil.rmtree(run.path)
    assert found[0] == found[1]


def test_what_has_no_demonstrations_cannot_be_adapted(recorded, tmp_path) -> None:
    for name, labels, said, adaptation in (
        ("ed-cnn", "100%", "learns from actions all along", "finetuned"),
        ("ed-cnn", "100%", "nothing to adapt; leave out '--set adaptation=clustered'", "clustered"),
        ("lapo", "none", "gives none", "finetuned"),
        ("lapo", "none", "gives none", "clustered"),
        ("idm-ed-cnn", "one-shot", "has no latent_action, or keeps latent actions in no", "clustered"),
    ):
        with pytest.raises(UsageError, match=said):
            _train(name, recorded, tmp_path / name, labels=labels, more=(f"adaptation={adaptation}",))


@pytest.mark.parametrize("name", ["dmotion", "lapo"])
def test_another_budget_takes_the_training_over_and_ends_with_the_same_bits(name, recorded, trained, tmp_path) -> None:
    settings, runs = SETTINGS, Workspace(tmp_path)
    dataset = Dataset.open(recorded)

    def request(labels: str, seed: int = 0) -> TrainingRequest:
        return TrainingRequest(model=name, labels=labels, preset=Preset.TINY, settings=settings, seed=seed)

    one = Run.open(shutil.copytree(trained(name, "one-shot").path, tmp_path / "runs" / "one"))
    more = open_run(request("3-shot"), dataset, None, runs)
    source = take_over(more)
    assert source is not None
    assert source.path == one.path
    steps: list[int] = []
    train(more, training_data(more, dataset), launch("cpu"), lambda report: steps.append(report.step))
    assert not steps
    alone = _train(name, recorded, tmp_path / "alone", labels="3-shot")
    assert more.result["weights"] == alone.result["weights"] != one.result["weights"]
    assert (more.result["labels_total"], one.result["labels_total"]) == (6, 2)
    assert take_over(open_run(request("3-shot", seed=1), dataset, None, runs)) is None


@pytest.mark.parametrize("name", ["wm-ae", "wm-vae"])
def test_another_share_of_labels_goes_on_where_the_video_was_learned(name, recorded, trained, tmp_path) -> None:
    dataset, runs = Dataset.open(recorded), Workspace(tmp_path)
    shutil.copytree(trained(name).path, tmp_path / "runs" / "all")
    tenth = open_run(
        TrainingRequest(model=name, labels="10%", preset=Preset.TINY, settings=_settings(name)), dataset, None, runs
    )
    source = take_over(tenth)
    assert source is not None
    assert source.name == "all"
    steps: list[int] = []
    train(tenth, training_data(tenth, dataset), launch("cpu"), lambda report: steps.append(report.step))
    alone = trained(name, "10%")
    assert steps == list(range(tenth.result["steps"] // 2 + 1, tenth.result["steps"] + 1))
    same = ("weights", "labels", "triplets", "best_step", "validation_loss")
    assert [tenth.result[key] for key in same] == [alone.result[key] for key in same]
    logged = [[json.loads(row)["step"] for row in run.metrics.read_text().splitlines()] for run in (tenth, alone)]
    assert logged[0] == logged[1]


@pytest.mark.parametrize("name", ["ed-cnn", "cswm"])
def test_what_learns_from_labels_at_once_shares_nothing(name, recorded, trained, tmp_path) -> None:
    shutil.copytree(trained(name).path, tmp_path / "runs" / "all")
    request = TrainingRequest(model=name, labels="10%", preset=Preset.TINY, settings=_settings(name))
    assert take_over(open_run(request, Dataset.open(recorded), None, Workspace(tmp_path))) is None


@pytest.mark.parametrize("name", SUPERVISED)
def test_a_tenth_of_the_labels_is_a_tenth(name, trained) -> None:
    run = trained(name, "10%")
    each = FRAMES - 2  # triplets of an episode: one of eleven, and one to validate with
    assert run.result["labels"] == {"training": each, "validation": each}
