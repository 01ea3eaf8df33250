"""The policies of collection: the same three names in every world, and what sets them apart."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from jaxtyping import Float

from dmotion_bench.actions import Continuous
from dmotion_bench.errors import UnknownName
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.rollout import policy_generator, record_episode
from dmotion_bench.recording.session import environment_facts
from dmotion_bench.specs import Episode
from dmotion_bench.storage.manifest import record_words
from recorders import expert_policy
from recorders.expert_policy import ExpertPolicy
from recorders.grid_world import GridWorld
from recorders.planar_push import PlanarPush
from recorders.policies import RandomPolicy
from recorders.push_policy import PushPolicy
from recorders.robot_push import RobotPush

KINDS: dict[str, Callable[..., Any]] = {"grid_world": GridWorld, "planar_push": PlanarPush, "robot_push": RobotPush}
NAMES = ("random", "object-directed", "expert-correlated")


def episodes(env: Any, policy: Callable[[], Any], count: int, frames: int) -> list[Episode]:
    return [record_episode(env, policy(), seed, frames) for seed in range(count)]


def pushed(recorded: list[Episode]) -> float:
    return float(np.concatenate([episode.labels.pushed for episode in recorded]).mean())


@pytest.mark.parametrize("environment", KINDS)
def test_the_same_names_stand_in_every_world_and_in_the_recipe(environment: str) -> None:
    kind = KINDS[environment]
    assert set(NAMES) <= set(kind.policies)  # type: ignore[attr-defined]
    for name in NAMES:
        recipe = recipe_for(environment, policy=name)
        assert recipe.policy == name
        words = record_words(recipe, "d")  # type: ignore[arg-type]
        assert ("--policy" in words) == (name != kind.default_policy)  # type: ignore[attr-defined]
    with pytest.raises(UnknownName, match="did you mean 'random'"):
        environment_facts(recipe_for(environment, policy="randon"))


def test_the_earlier_name_makes_the_same_episodes() -> None:
    env = PlanarPush()
    one, other = (record_episode(env, env.policies[name](), 3, frames=12) for name in ("push", "object-directed"))
    np.testing.assert_array_equal(one.frames, other.frames)
    env.close()


@pytest.mark.slow
@pytest.mark.parametrize("kind", [GridWorld, PlanarPush])
def test_who_acts_decides_how_much_is_pushed(kind: Callable[..., Any]) -> None:
    env = kind()
    by_chance, directed, expert = (pushed(episodes(env, env.policies[name], 8, 32)) for name in NAMES)
    env.close()
    assert by_chance < 0.16
    assert expert > by_chance + 0.02
    assert directed > by_chance + 0.05


def test_no_step_toward_an_object_pushes_one_off_the_grid(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("recorders.push_policy.TOWARD", 1.0)
    env, left = GridWorld(), list[float]()
    for episode in episodes(env, PushPolicy, 6, 30):
        there = ~np.isnan(episode.labels.objects.position[..., 0])
        left.append(there[-1].sum() / there[0].sum())
    lost_by_chance = [
        np.isnan(episode.labels.objects.position[-1, :, 0]).sum() for episode in episodes(env, RandomPolicy, 6, 30)
    ]
    assert np.mean(left) == 1.0
    assert sum(lost_by_chance) > 0


@pytest.mark.parametrize("actions", ["discrete", "continuous"])
def test_an_undisturbed_expert_brings_objects_to_their_goals(actions: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(expert_policy, "EXPERT", 1.0)
    env = PlanarPush(actions=actions)
    reached, goals = 0, 0
    for seed in range(3):
        env.reset(seed=seed)
        policy, generator, before = ExpertPolicy(), policy_generator(seed), None
        for _ in range(80):
            env.step(policy(env, generator))
            goal = policy._goal
            if goal is not before and before is not None:
                off = np.linalg.norm(env.objects().position - before.position, axis=-1)
                goals, reached = goals + 1, reached + int(np.nanmax(off) < 0.75 * env.lattice.step)
            before = goal
    env.close()
    assert goals >= 5
    assert reached / goals > 0.3  # by chance none: a goal is two to four steps away


def test_about_four_of_five_actions_are_the_scripts() -> None:
    """The expert's generator decides at each step, first of all, whether the script acts."""
    draws = np.random.default_rng(0).random(20_000)
    assert abs((draws < expert_policy.EXPERT).mean() - 0.8) < 0.01
    asked = 0

    class Counting(RandomPolicy):
        def __call__(self, env: Any, generator: np.random.Generator) -> Any:
            nonlocal asked
            asked += 1
            return super().__call__(env, generator)

    env = PlanarPush()
    steps = 0
    for seed in range(4):
        env.reset(seed=seed)
        policy, generator = ExpertPolicy(), policy_generator(seed)
        policy._random = Counting()
        for _ in range(50):
            env.step(policy(env, generator))
            steps += 1
    env.close()
    assert 0.1 < asked / steps < 0.35


def test_random_displacements_fill_the_bounds_and_are_never_cut_short() -> None:
    env = PlanarPush(actions="continuous")
    spec = env.actions
    assert isinstance(spec, Continuous)
    env.reset(seed=0)
    generator, taken = np.random.default_rng(0), list[Float[np.ndarray, "2"]]()
    for _ in range(150):
        action = RandomPolicy()(env, generator)
        assert not env.step(action)[4]["illegal"]
        taken.append(np.asarray(action))
    env.close()
    values = spec.normalise(np.stack(taken))
    assert values.min() < -0.95
    assert values.max() > 0.95
    assert np.abs(values.mean(axis=0)).max() < 0.2
