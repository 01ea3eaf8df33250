"""What distracts in a video: it stays off agent and objects, moves what it says, and changes no state."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from jaxtyping import Float
from noise_world import files_of

from dmotion_bench.environment import Environment
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.planning.tasks import World, load_problems, task_environment
from dmotion_bench.positions import NOTHING, PositionFinder
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.specs import DatasetRecipe, Episode
from dmotion_bench.storage.dataset import Dataset
from recorders.distractors import FACTORS, SCENES
from recorders.distractors.movers import FAMILIES, MARGIN, STEP, mover_colors
from recorders.distractors.noise import Noise
from recorders.distractors.shake import Shake, cut_off, shifted
from recorders.distractors.streams import stream
from recorders.grid_world import GridWorld
from recorders.planar_push import PlanarPush
from recorders.robot_push import RobotPush

KINDS: dict[str, Callable[..., Any]] = {"grid_world": GridWorld, "planar_push": PlanarPush, "robot_push": RobotPush}
NAMES = [factor.name for factor in FACTORS]
STRONG = {"background": 0.7, "movers": 4, "correlated": 0.6, "shake": 6, "noise": 6.0, "delay": 2}
SEED, FRAMES = 5, 10


@pytest.fixture(scope="module", params=KINDS)
def kind(request: pytest.FixtureRequest) -> Callable[..., Any]:
    return KINDS[request.param]


@pytest.fixture(scope="module")
def plain(kind: Callable[..., Any]) -> Episode:
    return made(kind)


@pytest.fixture(scope="module")
def world(kind: Callable[..., Any]) -> Iterator[Any]:
    """One environment for all; what distracts is given to ``reset``."""
    env = kind()
    yield env
    env.close()


def made(kind: Callable[..., Any], frames: int = FRAMES, seed: int = SEED, **settings: Any) -> Episode:
    """An episode of an environment with these settings, by its usual policy."""
    env = kind(**settings)
    try:
        return record_episode(env, env.policies[env.default_policy](), seed, frames)
    finally:
        env.close()


def seen_with(env: Environment, like: Episode, **options: float) -> Episode:
    """The same actions in an environment where something distracts."""

    class Replayed:
        def __init__(self) -> None:
            self._actions = iter(like.labels.actions)

        def __call__(self, env: Environment, generator: np.random.Generator) -> Any:
            return next(self._actions)

    class WithOptions:
        def __getattr__(self, name: str) -> Any:
            return getattr(env, name)

        def reset(self, *, seed: int, options: Any) -> Any:
            return env.reset(seed=seed, options=given)

    given = options
    return record_episode(WithOptions(), Replayed(), like.seed, len(like.frames))  # type: ignore[arg-type]


def replaying(like: Episode) -> Callable[..., Any]:
    actions = iter(like.labels.actions)
    return lambda env, generator: next(actions)


def states_of(episode: Episode) -> tuple[Float[np.ndarray, "..."], ...]:
    labels = episode.labels
    return (labels.actions, labels.pushed, labels.agent.position, labels.objects.position, labels.objects.orientation)


@pytest.mark.parametrize("factor", NAMES)
def test_a_factor_changes_what_is_seen_and_no_state(world: Any, plain: Episode, factor: str) -> None:
    shown = seen_with(world, plain, **{factor: STRONG[factor]})
    for one, other in zip(states_of(plain), states_of(shown), strict=True):
        np.testing.assert_array_equal(one, other)
    assert (shown.frames != plain.frames).any()
    assert shown.labels.factors[factor] == STRONG[factor]


@pytest.mark.parametrize("factor", ["background", "movers", "correlated"])
def test_agent_and_objects_stay_in_front_pixel_for_pixel(world: Any, plain: Episode, factor: str) -> None:
    shown = seen_with(world, plain, **{factor: STRONG[factor]})
    np.testing.assert_array_equal(shown.labels.masks, plain.labels.masks)
    own = plain.labels.masks != 0
    np.testing.assert_array_equal(shown.frames[own], plain.frames[own])
    np.testing.assert_array_equal(shown.labels.objects.pixel, plain.labels.objects.pixel)
    changed = (shown.frames != plain.frames).any(axis=-1)[~own].mean()
    assert changed > 0.9 if factor == "background" else 0.003 < changed < 0.2
    assert (shown.frames[0] != shown.frames[-1]).any(axis=-1)[~own[0] & ~own[-1]].mean() > 0.003  # it moves


def test_what_is_told_of_the_cameras_motion_is_what_the_centres_do(kind: Callable[..., Any], plain: Episode) -> None:
    env = kind(shake=6, delay=2)
    try:
        shown = record_episode(env, replaying(plain), plain.seed, FRAMES)
        told = env.distracting_motions(plain.seed, (), len(shown.frames) - 1)
    finally:
        env.close()
    assert list(told) == ["camera"]
    lagging = np.maximum(np.arange(len(shown.frames)) - 2, 0)  # a frame shows an earlier moment
    shift = shown.labels.agent.pixel[:, 0] - plain.labels.agent.pixel[lagging, 0]
    np.testing.assert_allclose(told["camera"], np.diff(shift, axis=0), atol=1e-3)
    assert np.abs(told["camera"]).max() >= 3


def test_what_is_told_of_a_factor_that_varies_is_of_the_episodes_own_values() -> None:
    env = GridWorld()
    by_seed = {seed: env.distracting_motions(seed, ("shake", "movers"), 5) for seed in range(8)}
    for seed, told in by_seed.items():
        env.reset(seed=seed, options={"vary": ["shake", "movers"]})
        values = env.reset(seed=seed, options={"vary": ["shake", "movers"]})[1]["factors"]
        assert set(told) == ({"camera"} if values["shake"] else set()) | ({"movers"} if values["movers"] else set())
    assert len({tuple(sorted(told)) for told in by_seed.values()}) > 1
    env.reset(seed=1)
    before = env.render()
    env.distracting_motions(2, ("movers",), 5)
    np.testing.assert_array_equal(env.render(), before)
    assert GridWorld().distracting_motions(0, (), 5) == {}


def test_the_camera_moves_picture_masks_and_centres_together(world: Any, plain: Episode) -> None:
    shown, most = seen_with(world, plain, shake=6), 0
    for moment in range(len(plain.frames)):
        x, y = np.rint(shown.labels.agent.pixel[moment, 0] - plain.labels.agent.pixel[moment, 0]).astype(int)
        assert max(abs(x), abs(y)) <= 6
        most = max(most, abs(x), abs(y))
        inner = (slice(8, -8), slice(8, -8))
        for one, other in (
            (shown.frames[moment], plain.frames[moment]),
            (shown.labels.masks[moment], plain.labels.masks[moment]),
        ):
            np.testing.assert_array_equal(one[inner], np.roll(other, (y, x), axis=(0, 1))[inner])
        np.testing.assert_allclose(
            shown.labels.objects.pixel[moment] - plain.labels.objects.pixel[moment],
            np.where(np.isnan(plain.labels.objects.pixel[moment]), np.nan, (x, y)),
        )
    assert most >= 3


def test_what_a_shift_cuts_off_is_not_visible() -> None:
    masks = np.zeros((6, 6), np.uint8)
    masks[0:2, 0:2], masks[3, 3:6] = 1, 2
    np.testing.assert_array_equal(shifted(masks, (1, -1), 0)[0], [0, 1, 1, 0, 0, 0])
    np.testing.assert_allclose(cut_off(masks, (1, -1), 2), [0.5, 2 / 3])
    assert cut_off(masks, (0, 1), 2) is None
    np.testing.assert_array_equal(shifted(shifted(masks, (2, 1), 0), (-2, -1), 0)[:5, :4], masks[:5, :4])


def test_a_delayed_frame_is_the_earlier_one_and_its_masks_too(world: Any, plain: Episode) -> None:
    shown = seen_with(world, plain, delay=2)
    for moment in range(len(plain.frames)):
        earlier = max(0, moment - 2)
        np.testing.assert_array_equal(shown.frames[moment], plain.frames[earlier])
        np.testing.assert_array_equal(shown.labels.masks[moment], plain.labels.masks[earlier])
        np.testing.assert_array_equal(shown.labels.agent.pixel[moment], plain.labels.agent.pixel[earlier])
        np.testing.assert_array_equal(shown.labels.objects.visible[moment], plain.labels.objects.visible[earlier])


def test_a_delay_delays_all_that_moves_but_not_the_noise(world: Any, plain: Episode) -> None:
    moving = {"background": 0.7, "movers": 3, "correlated": 0.6, "shake": 3}
    at_once, late = seen_with(world, plain, **moving), seen_with(world, plain, **moving, delay=1)
    np.testing.assert_array_equal(late.frames[1:], at_once.frames[:-1])
    noisy = seen_with(world, plain, delay=1, noise=5.0)
    assert (noisy.frames[0] != noisy.frames[1]).mean() > 0.3  # the same moment, other noise


def test_noise_has_the_stated_deviation_and_is_new_in_each_frame() -> None:
    grey, noise = np.full((128, 128, 3), 128, np.uint8), Noise(np.random.default_rng(1), 7.0)
    first, second = (noise.on(grey, moment).astype(float) - 128 for moment in (0, 1))
    assert abs(first.std() - 7) < 0.1
    assert abs(first.mean()) < 0.15
    assert abs(np.corrcoef(first.ravel(), second.ravel())[0, 1]) < 0.02
    np.testing.assert_array_equal(noise.on(grey, 0), first + 128)  # as often as it is asked for
    white = np.full((128, 128, 3), 255, np.uint8)
    assert noise.on(white, 3).min() > 200  # nothing wraps around


def test_the_things_of_an_environment_follow_its_actions(world: Any, plain: Episode) -> None:
    """At probability 1 they all go where the action points, so two frames differ by the same step in all."""
    world.reset(seed=SEED, options={"correlated": 1.0})
    follower, ways = world._video._followers, {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}
    for action in plain.labels.actions.tolist():
        before = np.array(follower.places)
        world.step(action)
        moved = (np.array(follower.places) - before + 76) % 152 - 76
        named = np.array(ways[world.facts.actions.names[action]])
        assert ((moved * named).sum(axis=1) > 0.97 * STEP).all()  # the robot's camera sees them at an angle
    assert MARGIN == 12, "152 is 128 and two margins"


@pytest.mark.slow
@pytest.mark.parametrize("name", SCENES)
def test_no_position_finder_takes_what_distracts_for_a_thing(name: str, kind: Callable[..., Any]) -> None:
    """Where the mask says background, no pixel has a thing's colour, but for the mixed ones along the things."""
    for seed in (1, 2, 3):
        episode = made(kind, frames=6, seed=seed, scene=name, **({} if name == "clean" else {"background": 1.0}))
        env = kind()
        labels = PositionFinder(env.facts).labels(torch.from_numpy(episode.frames)).numpy()
        env.close()
        near = episode.labels.masks != 0
        for axis, by in itertools.product((1, 2), (-1, 1)):
            near |= np.roll(near, by, axis)
        assert (labels[~near] != NOTHING).mean() < 1e-4


def test_movers_have_hues_far_from_those_of_all_things(kind: Callable[..., Any]) -> None:
    env = kind()
    things = (env.facts.agent.color, *(one.color for one in env.facts.objects))
    colors = np.array(mover_colors(things), np.uint8)
    finder = PositionFinder(env.facts)
    noisy = colors[:, None] + np.rint(np.random.default_rng(0).normal(0, 5, (len(colors), 500, 3)))
    found = finder.labels(torch.from_numpy(noisy.clip(0, 255).astype(np.uint8))[None])
    env.close()
    assert len(colors) >= 8
    assert (found.numpy() == NOTHING).mean() > 0.999


@pytest.mark.parametrize("scene", ["distracted", "unseen"])
def test_a_scene_has_its_own_textures_and_streams(scene: str, kind: Callable[..., Any], plain: Episode) -> None:
    episodes = [made(kind, frames=4, seed=seed, scene=scene) for seed in range(4)]
    kinds = {episode.labels.factors["background/texture"] for episode in episodes}
    assert kinds <= set(SCENES[scene].textures)
    assert {name: episodes[0].labels.factors[name] for name in SCENES[scene].strengths} == SCENES[scene].strengths
    again = made(kind, scene=scene)
    for one, other in zip(states_of(plain), states_of(again), strict=True):
        np.testing.assert_array_equal(one, other)
    assert not set(SCENES["distracted"].textures) & set(SCENES["unseen"].textures)
    assert not set(FAMILIES[0]) & set(FAMILIES[1])
    numbers = [stream(7, "movers", family).random() for family in (0, 1)]
    assert numbers[0] != numbers[1]


def test_the_clean_scene_is_what_there_was_before(kind: Callable[..., Any], plain: Episode) -> None:
    clean = made(kind, scene="clean")
    np.testing.assert_array_equal(clean.frames, plain.frames)
    assert clean.labels.factors == {}


def test_a_factor_of_a_scene_can_be_given_or_drawn(kind: Callable[..., Any]) -> None:
    env = kind(scene="distracted", movers=1)
    _, info = env.reset(seed=3)
    assert info["factors"]["movers"] == 1
    drawn = {env.reset(seed=seed, options={"vary": ["background"]})[1]["factors"]["background"] for seed in range(3)}
    assert len(drawn) == 3
    _, info = env.reset(seed=3, options={"background/texture": "waves"})
    assert info["factors"]["background/texture"] == "waves"
    with pytest.raises(UnknownName, match="no generator of textures named 'wavs'; did you mean 'waves'"):
        env.reset(seed=3, options={"background/texture": "wavs"})
    env.close()


@pytest.mark.parametrize(
    ("settings", "error", "sentence"),
    [
        ({"scene": "distratced"}, UnknownName, "no scene named 'distratced'; did you mean 'distracted'"),
        ({"textures": "leafs"}, UnknownName, "did you mean 'leaves'"),
        ({"textures": " , "}, InvalidSetting, "names none; known: leaves, clouds, waves, cells"),
        ({"delay": 9}, InvalidSetting, "delay=9 is not possible; it takes a whole number from 0 to 4"),
        ({"background": 1.5}, InvalidSetting, "a number from 0 to 1"),
        ({"noise": "loud"}, InvalidSetting, "is no number"),
    ],
)
def test_what_cannot_be_is_a_sentence(
    kind: Callable[..., Any], settings: dict[str, Any], error: type[Exception], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        kind(**settings)


def test_a_restored_state_shows_what_followed(kind: Callable[..., Any], plain: Episode) -> None:
    env = kind(**STRONG)
    env.reset(seed=SEED)
    actions = plain.labels.actions.tolist()
    for action in actions[:3]:
        env.step(action)
    kept, memory = env.snapshot(), env.memory()
    wanted = [env.step(action)[0] for action in actions[3:6]]
    assert env.memory() != memory
    env.restore(kept)
    assert env.memory() == memory
    env.advance(actions[3])  # without drawing
    for action, frame in zip(actions[4:6], wanted[1:], strict=True):
        differing = (env.step(action)[0] != frame).any(axis=-1)
        assert differing.mean() < (0.005 if kind is RobotPush else 1e-9)  # Bullet restores a pose nearly
    env.close()


def small(environment: str, *settings: str, vary: tuple[str, ...] = ()) -> DatasetRecipe:
    recipe = recipe_for(environment, episodes=3, frames=14, tasks=2, settings=settings, vary=vary)
    return replace(recipe, shard_episodes=2)


@pytest.mark.slow
@pytest.mark.parametrize("environment", ["grid_world", "planar_push"])
def test_any_number_of_workers_records_the_same_bytes(environment: str, tmp_path: Any) -> None:
    recipe = small(environment, "scene=unseen", vary=tuple(NAMES))
    record_dataset(tmp_path / "one", recipe)
    record_dataset(tmp_path / "two", recipe, LocalExecutor(2))
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")


def test_grid_world_makes_at_once_what_stepping_makes() -> None:
    settings = {"scene": "distracted", "noise": 3.0, "delay": 1, "version": 2}
    (at_once,) = GridWorld.generate([SEED], frames=FRAMES, policy="random", parameters=settings)
    stepped = made(GridWorld, **settings)
    np.testing.assert_array_equal(at_once.frames, stepped.frames)
    np.testing.assert_array_equal(at_once.labels.masks, stepped.labels.masks)
    np.testing.assert_array_equal(at_once.labels.objects.pixel, stepped.labels.objects.pixel)
    np.testing.assert_array_equal(at_once.labels.objects.visible, stepped.labels.objects.visible)
    assert at_once.labels.factors == stepped.labels.factors


@pytest.mark.slow
@pytest.mark.parametrize("environment", KINDS)
def test_a_task_replays_bit_for_bit_and_its_goal_is_what_the_picture_shows(environment: str, tmp_path: Any) -> None:
    record_dataset(tmp_path / "d", replace(small(environment, "scene=distracted", "noise=3", "delay=1"), frames=30))
    dataset = Dataset.open(tmp_path / "d")
    problem = load_problems(dataset)[0]
    env = task_environment(dataset.recipe)
    world = World(env, problem)  # refuses another start picture than the recorded one
    actions = dataset.states(problem.task.episode).actions.tolist()[problem.task.start : problem.task.goal]
    shown = []
    for action in actions:
        shown.append(world.distance)
        world.step(action)
    np.testing.assert_array_equal(world.frame, problem.goal_frame)
    assert shown[-1] == 0.0  # a step before the last: that is what the goal's picture shows
    assert shown[0] == pytest.approx(1.0)
    env.close()


def test_a_camera_held_still_moves_nothing_and_one_that_shakes_stays_near() -> None:
    shake = Shake(np.random.default_rng(0), 3)
    shifts = np.array([shake.at(moment) for moment in range(500)])
    assert np.abs(shifts).max() == 3
    assert np.abs(shifts.mean(axis=0)).max() < 0.7
    assert (np.diff(shifts, axis=0) != 0).any(axis=1).mean() > 0.5
