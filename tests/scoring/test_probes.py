"""Probes of latents whose content is known: what is in them is found, what is not is at chance, as the controls are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import torch
from known_model import Known, NoConfig
from torch import Tensor

from dmotion_bench.actions import Discrete
from dmotion_bench.learning.images import to_pixels
from dmotion_bench.learning.model import ModelInputs
from dmotion_bench.recording.rollout import record_episodes
from dmotion_bench.scoring.figures import figures_of
from dmotion_bench.scoring.identification import codebook_use
from dmotion_bench.scoring.probes import (
    FOLDS,
    MOST_PROBED,
    PROBES,
    SHUFFLED,
    Factor,
    beyond_actions,
    probe,
    probe_scores,
)
from dmotion_bench.scoring.samples import read_samples, write_samples
from dmotion_bench.scoring.score import Scores, score_model
from dmotion_bench.scoring.settings import ScoreSettings
from dmotion_bench.scoring.statistics import EpisodeBootstrap, Estimate
from dmotion_bench.scoring.true_factors import FACTORS
from dmotion_bench.specs import DatasetRecipe
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.writer import DatasetWriter
from recorders.grid_things import FACTS
from recorders.grid_world import GridWorld

ROWS, LONG = 400, 20
EPISODE = np.arange(ROWS) // LONG
ACTION = np.random.default_rng(0).integers(0, 4, ROWS)
NAMED = np.eye(4)[ACTION]
NUMBERS = np.random.default_rng(1).normal(size=(ROWS, 2)) * (3, 0.01) + (7, 0)
KNOWN = {"action": Factor(names=ACTION), "background": Factor(numbers=NUMBERS)}


def scores(latent: np.ndarray, factors: dict[str, Factor] = KNOWN) -> dict[str, dict[str, Estimate]]:
    bootstrap = EpisodeBootstrap(EPISODE, resamples=500)
    return {name: probe_scores(one, bootstrap) for name, one in probe(latent, factors, EPISODE).items()}


@pytest.fixture(scope="module")
def of_action() -> dict[str, dict[str, Estimate]]:
    return scores(NAMED)


@pytest.fixture(scope="module")
def of_background() -> dict[str, dict[str, Estimate]]:
    return scores(NUMBERS @ np.array([[1.0, 2.0, 0.1], [50.0, -20.0, 3.0]]))


@pytest.mark.slow
def test_a_latent_that_is_the_action_holds_it_and_nothing_else(of_action: dict[str, dict[str, Estimate]]) -> None:
    found = of_action
    for name in PROBES:
        assert found["action"][name].mean == 1.0
        assert -0.04 < found["background"][name].mean < 0.02


@pytest.mark.slow
def test_a_latent_that_is_the_background_holds_it_and_no_action(of_background: dict[str, dict[str, Estimate]]) -> None:
    found = of_background
    for name in PROBES:
        assert found["background"][name].mean > 0.98
        assert found["action"][name].mean == pytest.approx(0.25, abs=0.05)


@pytest.mark.slow
def test_a_random_latent_and_all_controls_sit_at_chance(
    of_action: dict[str, dict[str, Estimate]], of_background: dict[str, dict[str, Estimate]]
) -> None:
    random = scores(np.random.default_rng(10).normal(size=(ROWS, 6)))
    for name in PROBES:
        for one in (
            random["action"][name],
            *(found["action"][name + SHUFFLED] for found in (of_action, of_background)),
        ):
            assert one.mean == pytest.approx(0.25, abs=0.06)
            assert one.low is not None
            assert one.high is not None
            assert one.low - 0.02 < 0.25 < one.high + 0.02
        for one in (
            random["background"][name],
            *(found["background"][name + SHUFFLED] for found in (of_action, of_background)),
        ):
            assert -0.04 < one.mean < 0.02


@pytest.mark.slow
def test_only_the_small_network_reads_what_is_not_linear() -> None:
    size = {"size": Factor(numbers=np.abs(NUMBERS[:, :1] - NUMBERS[:, :1].mean()))}
    found = scores(NUMBERS, size)["size"]
    assert found["linear"].mean < 0.05
    assert found["mlp"].mean > 0.8


@pytest.mark.slow
def test_the_score_of_numbers_is_r_squared_and_units_change_nothing() -> None:
    """A latent of which half the variance is noise leaves half of the variance unread."""
    noise = np.random.default_rng(2).normal(size=ROWS)
    signal = np.random.default_rng(3).normal(size=ROWS)
    latent = ((signal + noise) * 1e-3)[:, None]
    found = scores(latent, {"background": Factor(numbers=(40 * signal - 9)[:, None])})["background"]
    assert found["linear"].mean == pytest.approx(np.corrcoef(signal, signal + noise)[0, 1] ** 2, abs=0.02)
    again = scores(latent * 1e6 + 5, {"background": Factor(numbers=signal[:, None])})["background"]
    for name in PROBES:
        assert again[name].mean == pytest.approx(found[name].mean, abs=1e-6)


@pytest.mark.slow
def test_an_episode_is_not_in_its_own_fit() -> None:
    """Each episode has a code of its own for the action: nothing can be read from others'."""
    generator = np.random.default_rng(4)
    codes = generator.normal(size=(EPISODE.max() + 1, 4, 3))
    found = scores(codes[EPISODE, ACTION], {"action": Factor(names=ACTION)})["action"]
    assert found["linear"].mean < 0.35
    assert found["mlp"].mean < 0.35


@pytest.mark.slow
def test_what_cannot_be_asked_has_no_figure() -> None:
    one_value, unknown = np.ones((ROWS, 2)), np.full((ROWS, 2), np.nan)
    factors = {
        "action": Factor(names=np.zeros(ROWS, int)),
        "camera": Factor(numbers=one_value),
        "movers": Factor(numbers=unknown),
        "background": Factor(numbers=np.concatenate([NUMBERS, one_value], axis=1)),  # one column alone never changes
    }
    assert list(probe(NAMED, factors, EPISODE)) == ["background"]
    assert probe(NAMED, KNOWN, np.zeros(ROWS)) == {}


@pytest.mark.slow
def test_rows_without_a_value_and_beyond_the_most_are_left_out() -> None:
    partly = NUMBERS.copy()
    partly[::3] = np.nan
    columns = probe(NUMBERS, {"background": Factor(numbers=partly)}, EPISODE)["background"]
    np.testing.assert_array_equal(np.isfinite(columns).all(axis=1), np.isfinite(partly).all(axis=1))

    many = np.random.default_rng(0).integers(0, 2, MOST_PROBED + 500)
    columns = probe(many[:, None] * 1.0, {"action": Factor(names=many)}, np.arange(len(many)) % (2 * FOLDS))["action"]
    assert np.isfinite(columns[:, 0]).sum() == MOST_PROBED


def test_what_actions_tell_of_a_place_is_taken_out() -> None:
    place = NAMED @ np.array([[3.0, 0], [0, 2], [1, 1], [-4, 0]])
    np.testing.assert_allclose(beyond_actions(place, ACTION), 0, atol=1e-12)
    np.testing.assert_allclose(beyond_actions(place + NUMBERS, ACTION).std(0), NUMBERS.std(0), rtol=0.02)
    continuous = np.random.default_rng(5).uniform(-1, 1, (ROWS, 2))
    np.testing.assert_allclose(beyond_actions(continuous @ [[1.0], [2.0]] + 3, continuous), 0, atol=1e-4)
    assert np.isnan(beyond_actions(np.full((4, 1), np.nan), np.zeros(4, int))).all()


def test_codebook_use_counts_codes_by_their_shares() -> None:
    even = codebook_use(np.tile(np.arange(4), 6).reshape(12, 2), 8)
    assert even["codebook_perplexity"].mean == pytest.approx(4)
    assert even["codebook_used"].mean == pytest.approx(0.5)
    one = codebook_use(np.full((12, 2), 3), 8)
    assert one["codebook_perplexity"].mean == pytest.approx(1)
    uneven = codebook_use(np.array([[0, 0], [0, 1]]), 2)
    assert uneven["codebook_perplexity"].mean == pytest.approx(np.exp(-0.75 * np.log(0.75) - 0.25 * np.log(0.25)))


@pytest.fixture(scope="module")
def distracted(tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    """Grid World with everything that distracts, and one test episode in ten."""
    recipe = DatasetRecipe(
        environment="grid_world", parameters={"version": 2, "scene": "distracted"}, seed=4, episodes=60, frames=22
    )
    folder = tmp_path_factory.mktemp("data") / "distracted"
    with DatasetWriter.create_or_resume(folder, recipe, FACTS) as writer:
        for shard in writer.missing:
            writer.write_shard(shard, record_episodes(GridWorld, recipe, writer.episodes_of(shard)))
        writer.finish()
    return Dataset.open(folder)


class Holds(Known):
    """Its latent is what a table says of each frame."""

    def __init__(self, table: dict[bytes, np.ndarray]) -> None:
        super().__init__(NoConfig(), ModelInputs(height=128, width=128, actions=Discrete.numbered(4)))
        self.table = table

    def latent_action(self, previous: Tensor, current: Tensor, following: Tensor) -> Tensor:
        rows = [self.table[frame.tobytes()] for frame in to_pixels(current).numpy()]
        return torch.from_numpy(np.stack(rows)).float()

    def predict_with_latent(self, previous: Tensor, current: Tensor, latent: Tensor) -> Tensor:
        return current


def holding(dataset: Dataset, what: str) -> Holds:
    """A model whose latent is the true action, or how the background moves."""
    env, table = GridWorld(**dataset.recipe.parameters), dict[bytes, np.ndarray]()
    for episode in dataset.split("test").tolist():
        frames, actions = dataset.video(episode), dataset.states(episode).actions
        motions = env.distracting_motions(dataset.rows[episode].seed, (), len(actions))
        known = np.eye(4)[actions] if what == "action" else motions["background"]
        table |= {frame.tobytes(): row for frame, row in zip(frames, known, strict=False)}
    return Holds(table)


@pytest.fixture(scope="module")
def background_scored(distracted: Dataset) -> Scores:
    return scored(distracted, "background")


def scored(dataset: Dataset, what: str) -> Scores:
    model, settings = holding(dataset, what), ScoreSettings(resamples=100)
    return score_model(model, dataset, metrics=("prediction",), settings=settings)


@pytest.mark.slow
def test_a_report_tells_a_model_of_the_action_from_one_of_the_background(
    distracted: Dataset, background_scored: Scores
) -> None:
    by_action, by_background = scored(distracted, "action").figures, background_scored.figures
    assert {name for name in by_action if name.startswith("probe_")} == {
        f"probe_{probe}{control}[{factor}]" for factor in FACTORS for probe in PROBES for control in ("", SHUFFLED)
    }
    assert by_action["probe_linear[action]"].mean == 1
    assert by_action["probe_linear[agent_motion]"].mean > 0.97
    assert by_background["probe_linear[background]"].mean > 0.97
    assert by_background["probe_linear[action]"].mean < 0.4
    assert by_background["probe_linear[agent_motion]"].mean < 0.1
    for factor in ("agent_place", "camera", "background", "movers"):
        assert by_action[f"probe_linear[{factor}]"].mean < 0.1, factor


@pytest.mark.slow
def test_an_environment_that_tells_nothing_of_distractors_has_none_of_their_figures(grid: Dataset) -> None:
    figures = scored(grid, "action").figures
    told = {name.partition("[")[2].rstrip("]") for name in figures if name.startswith("probe_")}
    assert told == {"action", "agent_motion", "agent_place"}
    assert not any(name.startswith("codebook_") for name in figures)


@pytest.mark.slow
def test_probes_are_of_the_samples_that_are_stored(
    distracted: Dataset, background_scored: Scores, tmp_path: Path
) -> None:
    """The same figures come from the samples' file, and a second scoring comes to the same bits."""
    write_samples(tmp_path / "samples.parquet", background_scored.samples)
    again = figures_of(read_samples(tmp_path / "samples.parquet"), "model", resamples=100)
    assert again == background_scored.figures
    assert scored(distracted, "background").figures == background_scored.figures
