"""What holds for both pushing environments: exactness, directions, labels that agree with the picture, factors."""

from __future__ import annotations

import colorsys
import dataclasses
import hashlib
import subprocess
import sys
from collections.abc import Iterator

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from jaxtyping import Bool, Float, UInt8

from dmotion_bench.environment import Environment
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.specs import MASK_AGENT, MASK_FIRST_OBJECT, Episode
from recorders.distractors.scenes import NAMES as VIDEO_FACTORS
from recorders.grid_world import GridWorld
from recorders.planar_push import PlanarPush
from recorders.push_policy import PushPolicy
from recorders.pushing import PushingEnvironment
from recorders.robot_push import RobotPush

KINDS = {"robot_push": RobotPush, "planar_push": PlanarPush}
FACTORS = ("friction", "mass", "colour", "light", "camera", "distractors", *VIDEO_FACTORS)
UNSEEN_AT_FIRST = ("friction", "mass", "delay")


@pytest.fixture(scope="module", params=KINDS)
def env(request: pytest.FixtureRequest) -> Iterator[PushingEnvironment]:
    made = KINDS[request.param]()
    yield made
    made.close()


@pytest.fixture(scope="module")
def episodes(env: PushingEnvironment) -> list[Episode]:
    return [record_episode(env, PushPolicy(), seed, frames=101) for seed in range(8)]


@pytest.mark.parametrize("action", [-1, 4])
def test_what_is_no_action_is_refused(env: PushingEnvironment, action: int) -> None:
    env.reset(seed=0)
    with pytest.raises(InvalidSetting, match=f"was given action {action} .*; there are 4, numbered from 0"):
        env.step(action)


def replayed(env: PushingEnvironment, seed: int, actions: Iterator[int]) -> list[UInt8[np.ndarray, "h w 3"]]:
    return [env.reset(seed=seed)[0], *(env.step(action)[0] for action in actions)]


def digest(env: PushingEnvironment, episode: Episode) -> str:
    hashed = hashlib.sha256(b"".join(frame.tobytes() for frame in episode.frames))
    hashed.update(episode.labels.objects.position.tobytes())
    return hashed.hexdigest()


def has_hue_of(pixels: UInt8[np.ndarray, "n 3"], color: tuple[int, int, int]) -> Bool[np.ndarray, " n"]:
    wanted = colorsys.rgb_to_hsv(*(channel / 255 for channel in color))[0]
    hsv = np.array([colorsys.rgb_to_hsv(*pixel) for pixel in pixels / 255]).reshape(-1, 3)
    away = np.abs(hsv[:, 0] - wanted)
    return (np.minimum(away, 1 - away) < 25 / 360) & (hsv[:, 1] > 0.45)


def test_a_restored_state_is_what_is_seen(env: PushingEnvironment) -> None:
    frame, _ = env.reset(seed=3)
    kept, masks, objects = env.snapshot(), env.masks(), env.objects()
    policy, generator = PushPolicy(), np.random.default_rng(0)
    for _ in range(30):
        env.step(policy(env, generator))
    env.restore(kept)
    assert (env.render() == frame).all()
    assert (env.masks() == masks).all()
    np.testing.assert_allclose(env.objects().pixel, objects.pixel, atol=1e-6)


@pytest.mark.parametrize("kind", [GridWorld, PlanarPush, RobotPush])
@pytest.mark.parametrize("shake", [0, 2])
def test_who_is_told_of_states_may_write_into_them(kind: type[GridWorld | PushingEnvironment], shake: int) -> None:
    env = kind(shake=shake)
    env.reset(seed=0)
    for tell in (env.agent, env.objects):
        before = dataclasses.asdict(tell())
        for told in dataclasses.asdict(tell()):
            np.negative(getattr(tell(), told), out=getattr(tell(), told))
            np.testing.assert_array_equal(getattr(tell(), told), before[told])
    env.close()


def test_it_is_an_environment_that_can_be_recorded(env: PushingEnvironment) -> None:
    assert isinstance(env, Environment)
    assert env.default_policy in env.policies
    module, name = type(env).__module__.removesuffix(".environment"), type(env).__name__
    made = gymnasium.make(f"{module}:dmbench/{name}-v0", render_mode="rgb_array")
    check_env(made.unwrapped)  # warnings are errors
    made.close()


@pytest.mark.slow
def test_episodes_come_out_the_same_in_another_order_on_a_used_simulation(
    env: PushingEnvironment, episodes: list[Episode]
) -> None:
    for episode in reversed(episodes[:4]):
        again = record_episode(env, PushPolicy(), episode.seed, frames=101)
        np.testing.assert_array_equal(again.frames, episode.frames)
        np.testing.assert_array_equal(again.labels.objects.position, episode.labels.objects.position)
        np.testing.assert_array_equal(again.labels.objects.orientation, episode.labels.objects.orientation)
        np.testing.assert_array_equal(again.labels.masks, episode.labels.masks)


@pytest.mark.slow
def test_seed_and_actions_give_every_frame_again(env: PushingEnvironment, episodes: list[Episode]) -> None:
    episode = episodes[1]
    frames = replayed(type(env)(), episode.seed, map(int, episode.labels.actions))
    np.testing.assert_array_equal(frames, episode.frames)


@pytest.mark.slow
def test_a_fresh_process_gives_the_same_episode(env: PushingEnvironment, episodes: list[Episode]) -> None:
    script = (
        "import sys; from tests.recorders.test_pushing import *; env = KINDS[sys.argv[1]]();"
        "print(digest(env, record_episode(env, PushPolicy(), 2, frames=101)))"
    )
    here = __file__.rsplit("/tests/", 1)[0]
    answer = subprocess.run(
        [sys.executable, "-c", script, env.facts.id], capture_output=True, text=True, check=True, cwd=here
    )
    assert answer.stdout.strip() == digest(env, episodes[2])
    assert not answer.stderr


def test_an_action_moves_the_agent_its_way(env: PushingEnvironment, episodes: list[Episode]) -> None:
    ways = {"up": (0, -1), "down": (0, 1), "left": (-1, 0), "right": (1, 0)}
    for episode in episodes:
        labels = episode.labels
        moved = np.diff(labels.agent.position[:, 0, :2], axis=0)
        np.testing.assert_allclose(moved, env.moves[labels.actions], atol=1e-9)
        seen = np.diff(labels.agent.pixel[:, 0], axis=0)
        named = np.array([ways[env.facts.actions.names[action]] for action in labels.actions])
        along = (seen * named).sum(axis=-1)
        assert (along > 5).all()
        assert (np.abs(seen).sum(axis=-1) - along < 2).all()


def test_an_illegal_move_changes_nothing(env: PushingEnvironment) -> None:
    env.reset(seed=3, options={"distractors": 2})
    left = env.facts.actions.names.index("left")
    while env.legal_actions()[left]:
        env.step(left)
    before = env.render(), env.masks(), env.objects().position, env.agent().position
    frame, _, _, _, info = env.step(left)
    assert info["illegal"]
    after = frame, env.masks(), env.objects().position, env.agent().position
    for one, other in zip(before, after, strict=True):
        np.testing.assert_array_equal(one, other)


def test_an_object_that_falls_ends_the_episode_and_is_gone(env: PushingEnvironment, episodes: list[Episode]) -> None:
    ended = [episode for episode in episodes if episode.ended == "terminated"]
    assert len(ended) >= len(episodes) / 2
    for episode in ended:
        objects = episode.labels.objects
        gone = np.isnan(objects.position[..., 0])
        assert not gone[:-1].any()
        assert gone[-1].any()
        assert (objects.visible[-1][gone[-1]] == 0).all()
        assert np.isnan(objects.pixel[-1][gone[-1]]).all()
        assert np.isnan(objects.orientation[-1][gone[-1]]).all()
        assert episode.labels.pushed[-1]
        for index in np.flatnonzero(gone[-1]):
            assert not (episode.labels.masks[-1] == MASK_FIRST_OBJECT + index).any()
            assert not has_hue_of(episode.frames[-1].reshape(-1, 3), env.facts.objects[index].color).sum() > 4


def test_the_policy_pushes_in_about_a_third_of_the_steps(episodes: list[Episode]) -> None:
    pushed = np.concatenate([episode.labels.pushed for episode in episodes])
    assert 0.25 < pushed.mean() < 0.5
    assert 20 < np.mean([len(episode.frames) for episode in episodes]) < 70


def test_what_no_one_touches_stays_where_it_is_to_the_last_bit(episodes: list[Episode]) -> None:
    labels = episodes[0].labels
    still = (np.diff(labels.objects.position, axis=0) == 0).all(axis=-1)
    assert still.mean() > 0.7
    assert still[~labels.pushed].mean() > 0.9


@pytest.mark.slow
def test_masks_agree_with_the_colours(env: PushingEnvironment, episodes: list[Episode]) -> None:
    for episode in episodes[:3]:
        frame, mask = episode.frames[0], episode.labels.masks[0]
        for index, one in enumerate(env.facts.objects):
            in_mask = mask == MASK_FIRST_OBJECT + index
            has_color = has_hue_of(frame.reshape(-1, 3), one.color).reshape(mask.shape)
            assert in_mask.sum() > 30
            overlap = (in_mask & has_color).sum() / (in_mask | has_color).sum()
            assert overlap > 0.85
        agent = frame[mask == MASK_AGENT].astype(int)
        assert (np.ptp(agent, axis=-1) < 60).mean() > 0.95  # grey, white, black: no colour


def test_the_pixel_is_the_middle_of_what_is_seen_of_an_unhidden_object(episodes: list[Episode]) -> None:
    compared = 0
    for episode in episodes[:4]:
        labels = episode.labels
        for moment, index in np.argwhere(labels.objects.visible == 1.0):
            y, x = np.nonzero(labels.masks[moment] == MASK_FIRST_OBJECT + index)
            assert np.hypot(*(labels.objects.pixel[moment, index] - (x.mean(), y.mean()))) < 0.5
            compared += 1
    assert compared > 100


@pytest.mark.parametrize("factor", FACTORS)
def test_a_factor_changes_what_it_names_and_nothing_else(env: PushingEnvironment, factor: str) -> None:
    plain_frame, plain_info = env.reset(seed=5)
    plain, place = env.objects().position, env.agent().position
    frame, info = env.reset(seed=5, options={"vary": [factor]})

    assert plain_info["factors"] == {}
    assert {name.split("/")[0] for name in info["factors"]} == {factor}
    np.testing.assert_array_equal(env.objects().position, plain)
    np.testing.assert_array_equal(env.agent().position, place)
    values = list(info["factors"].values())
    differs = bool((frame != plain_frame).any())
    assert differs == (factor not in UNSEEN_AT_FIRST and values != [0])


@pytest.mark.slow
def test_factors_are_drawn_anew_for_each_episode_and_apart_from_each_other(env: PushingEnvironment) -> None:
    alone = [env.reset(seed=seed, options={"vary": ["light"]})[1]["factors"] for seed in range(4)]
    together = [env.reset(seed=seed, options={"vary": FACTORS})[1]["factors"] for seed in range(4)]
    assert len({one["light"] for one in alone}) == 4
    assert [one["light"] for one in alone] == [one["light"] for one in together]


def test_an_episodes_factors_make_it_again(env: PushingEnvironment) -> None:
    first = record_episode(env, PushPolicy(), 11, frames=12, vary=FACTORS)
    frames = [env.reset(seed=11, options=dict(first.labels.factors))[0]]
    frames += [env.step(int(action))[0] for action in first.labels.actions]
    np.testing.assert_array_equal(frames, first.frames)


@pytest.mark.slow
def test_friction_decides_how_objects_move(env: PushingEnvironment) -> None:
    def after(friction: float) -> Float[np.ndarray, "k 3"]:
        env.reset(seed=1, options={"friction": friction})
        for action in record_episode_actions:
            env.step(action)
        return env.objects().position

    record_episode_actions = record_episode(env, PushPolicy(), 1, frames=40).labels.actions.tolist()
    assert np.nanmax(np.abs(after(0.25) - after(0.9))) > 1e-3


def test_distractors_move_and_touch_nothing(env: PushingEnvironment) -> None:
    plain = record_episode(env, PushPolicy(), 6, frames=20)
    env.reset(seed=6, options={"distractors": 3})
    changed = []
    for moment, action in enumerate(plain.labels.actions, start=1):
        frame = env.step(int(action))[0]
        np.testing.assert_array_equal(env.masks(), plain.labels.masks[moment])
        np.testing.assert_array_equal(env.objects().position, plain.labels.objects.position[moment])
        changed.append((frame != plain.frames[moment]).any(axis=-1))
    assert all(one.sum() > 50 for one in changed)
    assert (changed[0] != changed[-1]).any()


@pytest.mark.parametrize(
    ("options", "error", "sentence"),
    [
        ({"vary": ["colours"]}, UnknownName, "did you mean 'colour'"),
        ({"gravity": 1.0}, UnknownName, "no factor of variation named 'gravity'"),
        ({"camera": 90.0}, InvalidSetting, "from -12 to 12"),
        ({"distractors": 1.5}, InvalidSetting, "a whole number from 0 to 6"),
        ({"mass": "heavy"}, InvalidSetting, "is no number"),
    ],
)
def test_options_that_cannot_be_are_refused(
    env: PushingEnvironment, options: dict[str, object], error: type[Exception], sentence: str
) -> None:
    with pytest.raises(error, match=sentence):
        env.reset(seed=0, options=options)


def test_number_and_shapes_of_objects_are_parameters(env: PushingEnvironment) -> None:
    shape = env.facts.objects[0].shape
    few = type(env)(objects=2, shapes=shape, light=env.reset(seed=0, options={"vary": "light"})[1]["factors"]["light"])
    few.reset(seed=0)
    assert [one.name for one in few.facts.objects] == [f"red_{shape}", f"green_{shape}"]
    assert set(np.unique(few.masks())) == {0, 1, 2, 3}
    few.close()
    with pytest.raises(InvalidSetting, match="1 to 6"):
        type(env)(objects=7)
    with pytest.raises(UnknownName, match="no shape named"):
        type(env)(shapes="teapot")
