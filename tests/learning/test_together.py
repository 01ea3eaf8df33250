"""Several processes train as one does: the same weights, the same checkpoints, one end for all."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given, settings
from hypothesis import strategies as st
from training_together import lose, talk, together, train_asking, train_exact
from walking_square import record_walks

from dmotion_bench.errors import UsageError
from dmotion_bench.execution.processes import INTERRUPTIONS, LOST, Place, _say_why, place
from dmotion_bench.learning.data.triplets import BatchOrder
from dmotion_bench.learning.runs import checkpoint
from dmotion_bench.learning.training.randomness import seeded

SETTINGS = ("batch_size=7", "epochs=3", "validations=3", "ema=0.9", "hard_share=0.4", "precision=float32")
TOLERANCE = 1e-9
"""Between weights in float64, which are about 0.1: gradients are summed in another order."""


@pytest.fixture(scope="module")
def data(tmp_path_factory) -> Path:
    return record_walks(tmp_path_factory.mktemp("data") / "walk-test")


@pytest.fixture(scope="module")
def alone(data, tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("runs") / "alone"
    together(1, train_exact, data, folder, SETTINGS)
    return folder


def _within(name: str) -> float:
    return 1e-6 if name.startswith("hardness") else TOLERANCE  # losses of triplets are kept in float32


def _require_same_training(folder: Path, other: Path) -> None:
    for name in ("best.safetensors", "last.safetensors"):
        (found, facts), (expected, wanted) = (checkpoint.load(path / name) for path in (folder, other))
        assert facts["step"] == wanted["step"]
        assert found.keys() == expected.keys()
        for key, tensor in expected.items():
            torch.testing.assert_close(found[key], tensor, rtol=0, atol=_within(key), equal_nan=True)
    rows, wanted_rows = (
        [json.loads(line) for line in (path / "metrics.jsonl").read_text().splitlines()] for path in (folder, other)
    )
    timeless = [{k: v for k, v in row.items() if k not in ("seconds", "triplets_per_s")} for row in rows]
    for row, wanted in zip(timeless, wanted_rows, strict=True):
        assert row == pytest.approx({key: wanted[key] for key in row}, rel=1e-6)


@pytest.mark.slow
def test_processes_that_share_batches_of_seven_learn_the_weights_of_one(data, alone, tmp_path) -> None:
    """Parts of unequal size, groups of moments, frozen phases, averages, losses that choose the next triplets."""
    together(2, train_exact, data, tmp_path / "run", SETTINGS)
    _require_same_training(tmp_path / "run", alone)
    assert json.loads((tmp_path / "run" / "run.json").read_text())["result"]["processes"] == 2


@pytest.mark.slow
def test_a_run_goes_on_with_other_numbers_of_processes(data, alone, tmp_path) -> None:
    """Ctrl-C reaches one process of several, and all stop after the same step."""
    folder = tmp_path / "run"
    for world, stop_at in ((2, 5), (1, 14), (3, 22)):
        together(world, train_exact, data, folder, SETTINGS, stop_at)
        assert {path.name for path in folder.glob("interrupted-*")} == {f"interrupted-{n}" for n in range(world)}
        assert checkpoint.load(folder / "last.safetensors")[1]["step"] in (stop_at, stop_at + 1)
        for path in folder.glob("interrupted-*"):
            path.unlink()
    together(2, train_exact, data, folder, SETTINGS)
    _require_same_training(folder, alone)


@pytest.mark.slow
def test_rows_of_the_log_that_a_stop_cuts_are_those_of_one_process(data, tmp_path) -> None:
    rows = 4
    together(1, train_exact, data, tmp_path / "alone", SETTINGS, None, rows)
    for world, stop_at in ((2, 5), (3, 14), (1, 22), (2, None)):
        together(world, train_exact, data, tmp_path / "run", SETTINGS, stop_at, rows)
    _require_same_training(tmp_path / "run", tmp_path / "alone")


@pytest.mark.slow
def test_a_model_that_asks_the_other_processes_is_measured_in_all_of_them(data, tmp_path) -> None:
    together(2, train_asking, data, tmp_path / "run")
    settled = json.loads((tmp_path / "run" / "run.json").read_text())
    assert set(settled["conditions"]["probe"]) == {"bf16", "float32"}
    assert settled["result"]["processes"] == 2


@pytest.mark.slow
def test_processes_understand_each_other(tmp_path) -> None:
    together(2, talk, tmp_path)
    first, second = ((tmp_path / f"{rank}.txt").read_text().splitlines() for rank in (0, 1))
    assert first[:6] == second[:6] == ["[{'rank': 0}, {'rank': 1}]", "True", "False", "by 0", "[0.0, 0.0]", "None"]
    assert first[6] == second[6]
    assert first[6] == first[7] == second[7]
    assert "do not see the same answer; the run's folder must be one that all machines share" in first[6]
    assert first[8].startswith("ValueError: invalid literal")
    assert second[8].startswith("ProcessLost: process 0 of this training ends because another one has ended.")


@pytest.mark.slow
def test_a_process_notices_that_another_one_is_gone(tmp_path) -> None:
    together(2, lose, tmp_path)
    assert (tmp_path / "0.txt").read_text().startswith("ProcessLost: process 0 of this training ends because")


@settings(deadline=None, derandomize=True)
@given(size=st.integers(1, 40), world=st.integers(1, 9), group=st.sampled_from([1, 2, 4, 16]))
def test_shares_make_up_the_batch_and_keep_groups_together(size: int, world: int, group: int) -> None:
    episode = np.arange(200) // 20
    order = BatchOrder(200, size, seed=3, episode=episode, together=group)
    batch = order.batch(5)
    if len(batch) < world:
        return
    shares = [order.share(batch, rank, world) for rank in range(world)]
    assert np.array_equal(np.concatenate(shares), batch)
    assert all(len(share) for share in shares)
    if size // group >= world:
        assert all(len(share) % group == 0 for share in shares[:-1])
        assert max(map(len, shares[:-1]), default=0) - min(map(len, shares)) <= group


def test_processes_draw_other_noise_and_the_first_that_of_one_alone() -> None:
    def noise(*rank: int) -> torch.Tensor:
        with seeded(1, 2, torch.device("cpu"), *rank):
            return torch.rand(4)

    assert torch.equal(noise(), noise(0))
    assert not torch.equal(noise(0), noise(1))
    assert not torch.equal(noise(1), noise(2))


TWO_OF_FOUR = {"RANK": "2", "WORLD_SIZE": "4", "LOCAL_RANK": "0", "LOCAL_WORLD_SIZE": "2"}


def test_the_place_is_what_torchrun_says() -> None:
    assert place({}) == Place()
    assert place({"RANK": "3"}) == Place()
    assert place(TWO_OF_FOUR) == Place(rank=2, world=4, local_rank=0, local_world=2)
    assert place(TWO_OF_FOUR).nodes == 2


@pytest.mark.parametrize("change", [{"RANK": "4"}, {"LOCAL_WORLD_SIZE": "3"}, {"WORLD_SIZE": "x"}, {"LOCAL_RANK": ""}])
def test_a_place_that_cannot_be_costs_a_sentence(change: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="Start them with '--devices N --nodes M' or with torchrun"):
        place(TWO_OF_FOUR | change)


@pytest.mark.parametrize(
    ("codes", "kind", "says"),
    [
        ({0: -15, 1: -9}, "RunError", "process 1 of the 2 that train together was killed (SIGKILL)"),
        ({0: LOST, 1: -9}, "RunError", "process 1 of the 2"),
        ({0: 2, 1: LOST}, "SystemExit", "2"),
        ({0: 130, 1: LOST}, "KeyboardInterrupt", ""),
        ({0: LOST, 1: -15}, "RunError", "a process on another machine has ended"),
    ],
)
def test_the_end_of_all_says_what_ended_the_first(codes: dict[int, int], kind: str, says: str) -> None:
    assert 130 in INTERRUPTIONS
    with pytest.raises(BaseException) as raised:  # noqa: PT011 (an exit is no Exception)
        _say_why(codes, 2)
    assert type(raised.value).__name__ == kind
    assert says in str(raised.value)
