"""Models whose every figure is known beforehand."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pyarrow.compute as pc
import pytest
import torch
from known_model import Known
from torch import Tensor

from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.scoring.frame_measures import FrameMeasures
from dmotion_bench.scoring.pixels import PSNR_CAP
from dmotion_bench.scoring.prediction import Execution, score_reference_steps, score_steps
from dmotion_bench.scoring.references import agent_moves, copy_last
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.transitions import HeldOut, TransitionBatch
from dmotion_bench.specs import MASK_AGENT, episode_seed
from dmotion_bench.storage.dataset import Dataset
from recorders.grid_drawing import Version
from recorders.grid_things import FACTS, draw
from recorders.grid_world import GridWorld

from .conftest import FRAMES, Oracle, write_dataset

QUICK = ScoreSettings(horizon=4, resamples=200)


@pytest.mark.slow
def test_an_oracle_is_perfect(grid: Dataset, oracle: Oracle) -> None:
    figures = score_model(oracle, grid, settings=QUICK).figures

    perfect = {"mse": 0, "psnr": PSNR_CAP, "ssim": 1, "position_error": 0, "position_error_paper": 0}
    perfect |= {"miss_rate": 0, "false_positive_rate": 0}
    for name, value in perfect.items():
        for kind in (name, f"{name}_push"):
            assert (figures[kind].mean, figures[kind].std) == (value, 0), kind
    for ahead in range(1, 5):
        assert figures[f"rollout_mse[{ahead}]"].mean == 0
        assert figures[f"rollout_position_error[{ahead}]"].mean == 0
    assert "rollout_mse[5]" not in figures
    assert figures["mse"].n == 3 * (FRAMES - 2)
    assert figures["mse_push"].n == sum(int(grid.states(e).pushed[1:].sum()) for e in grid.split("test"))


def test_a_model_that_copies_has_the_figures_of_the_reference(grid: Dataset, copy_last: Known) -> None:
    scores = score_model(copy_last, grid, settings=QUICK)

    assert scores.figures == scores.reference["copy_last"]
    video = [grid.video(episode).astype(float) for episode in grid.split("test")]
    errors = [((frames[2:] - frames[1:-1]) ** 2).mean((1, 2, 3)) for frames in video]
    assert scores.figures["mse"].mean == pytest.approx(np.concatenate(errors).mean())
    assert scores.figures["mse"].std == pytest.approx(np.concatenate(errors).std())
    later = [((frames[5:] - frames[1:-4]) ** 2).mean((1, 2, 3)) for frames in video]
    starts = [0, 3, 5, 8]  # of 14 frames: frames 1 ... 9 can begin a rollout of 4 steps
    assert scores.figures["rollout_mse[4]"].mean == pytest.approx(np.mean([error[starts] for error in later]))


def test_an_object_that_is_never_drawn_is_missed_by_its_distance_to_the_corner(
    grid: Dataset, without_red: Oracle
) -> None:
    figures = score_model(without_red, grid, metrics=("prediction",), settings=QUICK).figures

    missed, missed_objects, charged, found = [], [], [], []
    for episode in grid.split("test"):
        objects = grid.labels(episode).objects
        for place in range(2, FRAMES):
            there = objects.visible[place] > 0
            red = objects.pixel[place, 0] if there[0] else None
            missed.append((red is not None) / (1 + there.sum()))
            missed_objects.append((red is not None) / there.sum() if there.any() else np.nan)
            charged.append(0 if red is None else np.hypot(*(red + 1)) / (1 + there.sum()))
            found.append(1 + there.sum() - (red is not None) > 0)
    assert figures["miss_rate"].mean == pytest.approx(np.mean(missed))
    assert figures["miss_rate_objects"].mean == pytest.approx(np.nanmean(missed_objects))
    assert figures["position_error_paper"].mean == pytest.approx(np.mean(charged), rel=1e-5)
    assert figures["position_error"].mean == 0
    assert figures["position_error"].n == sum(found)
    assert np.mean(missed) > 0.1


def test_the_samples_say_which_object_was_not_found(grid: Dataset, without_red: Oracle) -> None:
    samples = score_model(without_red, grid, metrics=("prediction",), settings=QUICK).samples
    mine = samples.filter(pc.equal(samples["predictor"], "model")).to_pylist()

    for row in mine:
        visible = grid.labels(row["episode"]).objects.visible[row["step"] + 1] > 0
        assert row["found_truth"] == [*visible.tolist(), True]
        assert row["found"] == [False, *visible[1:].tolist(), True]
        assert row["distance"][0] is None
        assert row["distance"][-1] == 0


@pytest.mark.parametrize("version", [1, 2])
def test_agent_moves_is_the_agent_drawn_in_its_next_cell(tmp_path: Path, version: Version) -> None:
    """But for version 2's pixels 102, on the border of cells 3 and 4: there a pushed object may hide the agent."""
    grid = write_dataset(tmp_path / "grid", version=version)
    own = np.arange(128) != (102 if version == 2 else -1)
    for batch in HeldOut(grid, "test").batches(8):
        predicted = agent_moves(batch)
        for row in range(len(batch)):
            labels, step = grid.labels(int(batch.episode[row])), int(batch.step[row])
            agent = labels.agent.position[step + 1, :, :2]
            objects = np.nan_to_num(labels.objects.position[step, :, :2], nan=-1)
            there = (objects >= 0).all(1) & (objects != agent).any(1)  # what it steps on it covers
            cells = np.concatenate([agent, objects]).astype(int)
            drawn = draw(cells[None], np.concatenate([[True], there])[None], version).frames[0]
            np.testing.assert_array_equal(predicted[row][own][:, own], drawn[own][:, own])
            if not batch.pushed[row]:
                np.testing.assert_array_equal(predicted[row], drawn)


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 2])
def test_references_are_where_they_were_measured(version: Version) -> None:
    """On 2,100 triplets: copying 1848 +- 438 and 6.3 px, the agent alone 65 +- 270 and 1.6 px, all black 3666."""
    measures, figures = FrameMeasures(FACTS), dict[str, list[dict[str, Tensor]]]()
    seeds = [episode_seed(11, number) for number in range(40)]
    for episode in GridWorld.generate(seeds, frames=32, policy="random", parameters={"version": version}):
        batch = _transitions(episode.frames, episode.labels.masks)
        truth = torch.from_numpy(batch.frames[:, 2])
        for name, predicted in (
            ("copy", copy_last(batch)),
            ("agent", agent_moves(batch)),
            ("black", np.zeros_like(batch.frames[:, 2])),
        ):
            compared = measures.compare(torch.from_numpy(predicted), truth, measures.positions(truth), similarity=False)
            figures.setdefault(name, []).append(compared)

    def mean(name: str, figure: str) -> float:
        return torch.cat([one[figure] for one in figures[name]]).double().mean().item()

    assert mean("copy", "mse") == pytest.approx(1848, rel=0.03)
    assert mean("copy", "position_error_paper") == pytest.approx(6.3, abs=0.3)
    assert mean("agent", "mse") == pytest.approx(
        65, abs=25
    )  # few triplets are pushes: 9 is its own standard error here
    assert mean("agent", "position_error_paper") == pytest.approx(1.6, abs=0.35)
    assert mean("black", "mse") == pytest.approx(3666, rel=0.06)


def _transitions(frames: np.ndarray, masks: np.ndarray) -> TransitionBatch:
    count = len(frames) - 2
    return TransitionBatch(
        episode=np.zeros(count, np.int64),
        step=np.arange(1, count + 1),
        frames=np.stack([frames[:-2], frames[1:-1], frames[2:]], axis=1),
        action=np.zeros(count, np.int64),
        pushed=np.zeros(count, bool),
        masks=(np.stack([masks[1:-1], masks[2:]], axis=1) == MASK_AGENT).astype(np.uint8),
        shifts=np.zeros((count, 1, 2)),
    )


@pytest.mark.slow
def test_predictions_are_rounded_to_pixels_before_they_are_compared(grid: Dataset, copy_last: Known) -> None:
    expected = score_model(copy_last, grid, metrics=("prediction",), settings=QUICK).figures

    copy_last.offset += 0.4 / 127.5  # less than half a grey level

    assert score_model(copy_last, grid, metrics=("prediction",), settings=QUICK).figures == expected


def test_what_is_no_frame_is_refused(grid: Dataset, copy_last: Known) -> None:
    class Small(Known):
        def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
            return current[..., :64]

    with pytest.raises(ModelContractBroken, match=r"Small predicted frames of shape .*64.*asks for"):
        score_model(Small(copy_last.config, copy_last.inputs), grid, metrics=("prediction",), settings=QUICK)
    copy_last.offset += torch.nan
    for metric in ("prediction", "rollout"):
        with pytest.raises(ModelContractBroken, match="diverged"):
            score_model(copy_last, grid, metrics=(metric,), settings=QUICK)


@pytest.mark.slow
def test_bf16_is_asked_of_the_model_and_stays_with_it(grid: Dataset, copy_last: Known) -> None:
    seen = []

    class Watching(Known):
        def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
            seen.append(torch.is_autocast_enabled("cpu"))
            return current

    model = Watching(copy_last.config, copy_last.inputs)
    for precision in ("float32", "bf16"):
        settings = ScoreSettings(resamples=100, precision=precision)
        score_model(model, grid, metrics=("prediction",), settings=settings)

    assert seen == [False, True]
    assert not torch.is_autocast_enabled("cpu")


def test_a_model_without_frames_has_no_figures_of_frames(grid: Dataset, copy_last: Known) -> None:
    class Blind(Known):
        needs_pixels = False

        def predict(self, previous: Tensor, current: Tensor, action: Tensor) -> Tensor:
            raise AssertionError("asked for a frame")

    assert score_model(Blind(copy_last.config, copy_last.inputs), grid, settings=QUICK).figures == {}


@pytest.mark.slow
def test_a_models_single_steps_decode_no_masks(grid: Dataset, oracle: Oracle, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(self: Dataset, episode: int) -> None:
        raise AssertionError(f"the masks of episode {episode} were decoded")

    held_out, how = HeldOut(grid, "test"), Execution(batch_size=16)
    expected = score_steps(oracle, held_out, how)
    monkeypatch.setattr(Dataset, "labels", refuse)
    assert score_steps(oracle, held_out, how) == expected
    with pytest.raises(AssertionError, match="were decoded"):
        score_reference_steps(held_out, how)
