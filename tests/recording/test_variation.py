"""Recorded variation: labels that hold it, ranges that do not meet, bytes and replays that know it."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from noise_world import files_of

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.rollout import make_environment
from dmotion_bench.recording.session import environment_facts, record_dataset
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import DatasetRecipe, Preset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import Manifest
from recorders.distractors.scenes import NAMES as VIDEO_FACTORS
from recorders.distractors.scenes import TEXTURE
from recorders.planar_push import environment as planar
from recorders.robot_push import scene as robot
from recorders.variation import Factor, Ranges, Variation

FACTORS = {"planar_push": planar.FACTORS, "robot_push": robot.FACTORS}
NAMES = ("camera", "colour", "distractors", "friction", "light", "mass", *VIDEO_FACTORS)
SETTINGS = {"planar_push": ("objects=3", "shapes=square,circle"), "robot_push": ("objects=2", "shapes=cube")}


def small_recipe(environment: str, ranges: str = "in-distribution", seed: int = 0) -> DatasetRecipe:
    recipe = recipe_for(
        environment, episodes=3, frames=9, tasks=0, seed=seed, vary=NAMES, ranges=ranges, settings=SETTINGS[environment]
    )
    return dataclasses.replace(recipe, shard_episodes=2)


@pytest.fixture(scope="module", params=[(name, ranges) for name in FACTORS for ranges in Ranges], ids="-".join)
def recorded(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Dataset:
    environment, ranges = request.param
    path = tmp_path_factory.mktemp("varied") / "d"
    record_dataset(path, small_recipe(environment, ranges))
    return Dataset.open(path)


def is_usual(factor: Factor, value: float) -> bool:
    return factor.low <= value <= factor.high


def is_shifted(factor: Factor, value: float) -> bool:
    return any(low <= value <= high for low, high in factor.shifted)


@pytest.mark.slow
def test_every_episodes_labels_hold_its_factors(recorded: Dataset) -> None:
    recipe = recorded.recipe
    belongs = is_shifted if recipe.parameters.get("ranges") == "shifted" else is_usual
    seen = []
    for episode in range(len(recorded)):
        values = dict(recorded.labels(episode).factors)
        wanted = set[str]()
        for factor in FACTORS[recipe.environment]:
            keys = [f"{factor.name}/{one.name}" for one in recorded.spec.objects] if factor.each else [factor.name]
            wanted.update(keys)
            assert all(belongs(factor, float(values[key])) for key in keys)
        assert set(values) - {TEXTURE} == wanted
        seen.append(values)
    assert seen[0] != seen[1] != seen[2]


@pytest.mark.slow
def test_what_was_recorded_is_made_again_by_the_recipe_the_seed_and_the_actions(recorded: Dataset) -> None:
    recipe = recorded.manifest.recipe  # as it was read from the file
    env = make_environment(environment_class(recipe.environment), recipe)
    for number in range(len(recorded)):
        episode = recorded.episode(number)
        frame, info = env.reset(seed=episode.seed, options={"vary": list(recipe.vary)})
        frames = [frame, *(env.step(int(action))[0] for action in episode.labels.actions)]
        np.testing.assert_array_equal(frames, episode.frames)
        assert info["factors"] == episode.labels.factors
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("environment", FACTORS)
def test_a_shifted_set_has_the_same_scenes_under_other_conditions(environment: str, tmp_path: Path) -> None:
    sets = []
    for ranges in Ranges:
        record_dataset(tmp_path / ranges, dataclasses.replace(small_recipe(environment, ranges), episodes=1))
        sets.append(Dataset.open(tmp_path / ranges))
    usual, shifted = (one.episode(0) for one in sets)
    np.testing.assert_array_equal(usual.labels.objects.position[0], shifted.labels.objects.position[0])
    np.testing.assert_array_equal(usual.labels.agent.position[0], shifted.labels.agent.position[0])
    assert (usual.frames[0] != shifted.frames[0]).any()
    assert sets[0].fingerprint != sets[1].fingerprint


def test_two_workers_record_the_same_variation(tmp_path: Path) -> None:
    """For robot_push, too: two workers that are killed, in ``test_session.py``."""
    recipe = dataclasses.replace(small_recipe("planar_push", "shifted"), episodes=4)
    record_dataset(tmp_path / "one", recipe)
    record_dataset(tmp_path / "two", recipe, LocalExecutor(2))
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")


@pytest.mark.parametrize("factor", [one for both in FACTORS.values() for one in both], ids=lambda one: one.name)
def test_shifted_ranges_lie_outside_of_the_usual_ones_and_are_drawn_from_whole(factor: Factor) -> None:
    assert is_usual(factor, factor.usual)
    assert not any(is_usual(factor, end) for ends in factor.shifted for end in ends)
    draws = [factor.draw(np.random.default_rng(seed), Ranges.SHIFTED) for seed in range(400)]
    assert all(is_shifted(factor, value) and not is_usual(factor, value) for value in draws)
    for low, high in factor.shifted:
        inside = [value for value in draws if low <= value <= high]
        assert min(inside) < low + 0.1 * (high - low) + 1e-9
        assert max(inside) > high - 0.1 * (high - low) - 1e-9
    assert all(is_usual(factor, factor.draw(np.random.default_rng(seed))) for seed in range(400))


def test_ranges_that_meet_are_refused() -> None:
    with pytest.raises(ValueError, match="is not outside of 0 to 1"):
        Factor(name="light", usual=1, low=0, high=1, shifted=((1, 2),), meaning="brightness")
    with pytest.raises(UnknownName, match="no ranges named 'shfted'; did you mean 'shifted'"):
        Variation([], [], "shfted")


def test_a_recipe_without_variation_is_what_it_was() -> None:
    recipe = recipe_for("planar_push", Preset.TINY)
    assert recipe == DatasetRecipe(
        environment="planar_push", policy="push", episodes=6, frames=16, tasks=0, shard_episodes=20
    )
    content = Manifest(recipe=recipe, spec=environment_facts(recipe)).to_json()["recipe"]
    assert (content["parameters"], content["vary"]) == ({}, ())


def test_factors_are_a_set_and_settings_have_their_parameters_types() -> None:
    one = recipe_for("planar_push", vary=["light", " camera", "light", ""], settings=["objects=2", "noise=1"])
    other = recipe_for("planar_push", vary=["camera", "light"], settings=["noise=1.0", "objects=2", "mass=none"])
    assert one == other
    assert one.vary == ("camera", "light")
    assert {key: type(value) for key, value in one.parameters.items()} == {"noise": float, "objects": int}


@pytest.mark.parametrize(
    ("environment", "asked", "error", "sentence"),
    [
        ("planar_push", {"vary": ["colours"]}, UnknownName, "did you mean 'colour'.*camera, colour, .*, mass"),
        ("grid_world", {"vary": ["light"]}, UnknownName, "named 'light'; known: background, correlated"),
        ("robot_push", {"ranges": "shifted"}, InvalidSetting, "name some with '--vary'"),
        ("grid_world", {"settings": ["scene=unsen"]}, InvalidSetting, "it can be clean, distracted, unseen"),
        ("robot_push", {"settings": ["objcts=3"]}, UnknownName, "setting of robot_push named 'objcts'.*'objects'"),
        ("robot_push", {"settings": ["objects=three"]}, InvalidSetting, "it must be a whole number"),
        ("robot_push", {"settings": ["objects=7"]}, InvalidSetting, "1 to 6"),
        ("robot_push", {"settings": ["objects"]}, InvalidSetting, "write --set objects=VALUE"),
        ("robot_push", {"settings": ["vary=light"]}, InvalidSetting, "say '--vary light'"),
        ("planar_push", {"settings": ["shapes=teapot"]}, UnknownName, "no shape named 'teapot'; known: bar"),
        ("planar_push", {"settings": ["light=1"], "vary": ["light"]}, InvalidSetting, "light has one value by '--set'"),
        ("planar_push", {"settings": ["light=7"]}, InvalidSetting, "light=7.0 is not possible.*0.88 to 1.12"),
    ],
)
def test_what_cannot_be_recorded_is_a_sentence(
    environment: str, asked: dict[str, list[str]], error: type[Exception], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        environment_facts(recipe_for(environment, **asked))  # type: ignore[arg-type]
