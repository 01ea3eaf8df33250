"""Probes of states: what they read of models whose states hold all places, one of them, or the episode alone."""

from __future__ import annotations

import hashlib
from collections.abc import Callable

import numpy as np
import pytest
import torch
from known_model import Known, NoConfig
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.errors import ModelContractBroken
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.scoring import state_probes
from dmotion_bench.scoring.samples import STATE_PROBED
from dmotion_bench.scoring.score import score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.state_probes import _fitted, _regression, _summed, probe_states
from dmotion_bench.scoring.transitions import HeldOut
from dmotion_bench.storage.dataset import Dataset

CPU = torch.device("cpu")
Places = tuple[np.ndarray, np.ndarray]


class Embedding(Known):
    """Knows each frame's episode, and where things are in it; what it tells of that is given."""

    def __init__(self, dataset: Dataset, tell: Callable[[int, Places], np.ndarray]) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
        self.known: dict[bytes, np.ndarray] = {}
        for episode in range(len(dataset)):
            states = dataset.states(episode)
            agents, objects = (one.position.reshape(len(one.position), -1) for one in (states.agent, states.objects))
            for frame, *places in zip(dataset.video(episode), agents, objects, strict=True):
                self.known[frame.tobytes()] = tell(episode, tuple(map(np.nan_to_num, places)))

    def embedding(self, state: tuple[Tensor, Tensor]) -> Tensor:
        seen = to_pixels(state[1]).numpy()
        return torch.from_numpy(np.stack([self.known[frame.tobytes()] for frame in seen])).float()


def _scores(model: Known, dataset: Dataset) -> dict[str, float]:
    found = probe_states(model, HeldOut(dataset, "test"), batch_size=7, device=CPU)
    return {name: float(1 - np.nansum(columns[:, 1]) / np.nansum(columns[:, 0])) for name, columns in found.items()}


@pytest.mark.slow
def test_a_state_that_holds_all_places_has_one_and_a_constant_has_nothing(grid: Dataset) -> None:
    mixing = np.random.default_rng(0).normal(size=(100, 100))

    def everything(episode: int, places: Places) -> np.ndarray:
        told = np.concatenate(places)
        return told @ mixing[: len(told), :50]

    assert _scores(Embedding(grid, everything), grid) == pytest.approx(dict.fromkeys(STATE_PROBED, 1.0), abs=0.01)
    nothing = _scores(Embedding(grid, lambda episode, places: np.ones(3)), grid)
    assert nothing == pytest.approx(dict.fromkeys(STATE_PROBED, 0.0), abs=1e-6)


def test_a_state_of_the_agent_alone_says_nothing_of_objects(grid: Dataset) -> None:
    scores = _scores(Embedding(grid, lambda episode, places: places[0]), grid)
    assert scores["agent_place"] == pytest.approx(1, abs=1e-3)
    assert scores["object_place"] < 0.1


@pytest.mark.slow
def test_a_code_of_the_episode_reads_no_layout_that_is_new(grid: Dataset) -> None:
    def code(episode: int, places: Places) -> np.ndarray:
        seed = int.from_bytes(hashlib.sha256(bytes([episode])).digest()[:4], "big")
        return np.concatenate([np.random.default_rng(seed).normal(size=40), places[0]])

    scores = _scores(Embedding(grid, code), grid)
    assert scores["agent_place"] > 0.9
    assert scores["object_place"] < 0.1


def test_models_without_states_and_leaking_splits_have_no_such_figure(grid: Dataset, copy_last: Known) -> None:
    assert probe_states(copy_last, HeldOut(grid, "test"), batch_size=7, device=CPU) == {}
    model = Embedding(grid, lambda episode, places: places[0])
    assert probe_states(model, HeldOut(grid, "test", "paper"), batch_size=7, device=CPU) == {}


@pytest.mark.slow
def test_the_report_has_the_figures_and_their_samples(grid: Dataset) -> None:
    model = Embedding(grid, lambda episode, places: places[0])
    scores = score_model(model, grid, metrics=("prediction",), settings=ScoreSettings(resamples=100))
    figure = scores.figures["state_probe[agent_place]"]
    assert figure.mean == pytest.approx(1, abs=1e-3)
    assert (figure.n, figure.episodes) == (len(HeldOut(grid, "test")), 3)
    assert not any(name.startswith("state_probe") for name in scores.reference["copy_last"])


def test_the_regression_is_that_of_the_textbook() -> None:
    generator = np.random.default_rng(1)
    inputs, places = (generator.normal(size=size) for size in ((30, 8), (30, 3)))
    centred, goal = inputs - inputs.mean(0), places - places.mean(0)
    for penalty, slopes in zip((0.1, 3.0), _regression(inputs, places, np.array([0.1, 3.0])), strict=True):
        wanted = np.linalg.solve(centred.T @ centred + penalty * 30 * np.eye(8), centred.T @ goal)
        np.testing.assert_allclose(slopes, wanted)


def test_a_thing_that_is_seldom_there_is_read_where_it_is() -> None:
    generator = np.random.default_rng(2)
    inputs, fold = generator.normal(size=(200, 4)), np.arange(200) // 40
    places = inputs[:, :3] * 2.0 + 5
    places[::3] = np.nan
    probe = _fitted(inputs, places, fold)
    assert probe is not None
    truth = inputs[:10, :3] * 2.0 + 5
    truth[4] = np.nan
    whole, error = probe.parts(inputs[:10], truth).T
    assert np.isnan([whole[4], error[4]]).all()
    assert np.nanmax(error) < 1e-6 < np.nanmin(whole)
    both = _summed([probe, None], inputs[:10], np.stack([truth, truth], axis=1))
    np.testing.assert_array_equal(both, np.stack([whole, error], axis=1))
    places[40:] = np.nan
    assert _fitted(inputs, places, fold) is None


@pytest.mark.slow
def test_of_a_long_state_the_principal_components_are_probed(grid: Dataset, monkeypatch: pytest.MonkeyPatch) -> None:
    mixing = np.random.default_rng(0).normal(size=(100, 300))

    def everything(episode: int, places: Places) -> np.ndarray:
        told = np.concatenate(places)
        return told @ mixing[: len(told)]

    monkeypatch.setattr(state_probes, "MOST_NUMBERS", 40)
    assert _scores(Embedding(grid, everything), grid) == pytest.approx(dict.fromkeys(STATE_PROBED, 1.0), abs=0.01)
    monkeypatch.setattr(state_probes, "MOST_NUMBERS", 1)
    assert _scores(Embedding(grid, everything), grid)["object_place"] < 0.5


def test_states_that_are_no_numbers_are_refused(grid: Dataset) -> None:
    with pytest.raises(ModelContractBroken, match="the states of Embedding hold NaN"):
        _scores(Embedding(grid, lambda episode, places: np.array([np.nan])), grid)
