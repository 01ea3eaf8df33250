"""PushT: the motion, coverage and success of ``gym-pusht``, exactness, labels that agree with the picture, policies."""

from __future__ import annotations

import json
import math
import warnings
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from dmotion_bench.environment import Environment, Judging, Restorable, Undrawn
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.execution.executors import make_executor
from dmotion_bench.planning.agents import make_reference
from dmotion_bench.planning.choices import make_solver
from dmotion_bench.planning.mpc import ControlSettings, control
from dmotion_bench.planning.tasks import World, load_problems, measure_of, task_environment
from dmotion_bench.recording.rollout import record_episode
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.scoring.figures import SUCCESS
from dmotion_bench.specs import MASK_AGENT, MASK_FIRST_OBJECT, DatasetRecipe, Episode
from dmotion_bench.storage.dataset import Dataset
from recorders.push_t import PushT
from recorders.push_t.drawing import background, tee_stamp
from recorders.push_t.measure import SUCCESS_COVERAGE, SUCCESS_DISTANCE, GoalCoverage, pose_of
from recorders.push_t.policies import Pushing, Wandering
from recorders.push_t.tee import AREA, CENTRE, GOAL, OUTLINE, Pose, clearance, coverage

REFERENCE: dict[str, Any] = json.loads(Path(__file__).with_name("push_t_reference.json").read_text())
"""What gym-pusht did; push_t_reference.py wrote it."""


@pytest.fixture(scope="module")
def episodes() -> list[Episode]:
    return [record_episode(PushT(), Pushing(), seed, frames=101) for seed in range(8)]


def state_of(env: PushT) -> list[float]:
    return [*env.disc, *env.tee]


@pytest.mark.parametrize("number", range(len(REFERENCE["episodes"])))
def test_it_moves_as_gym_pusht_does(number: int) -> None:
    env, recorded = PushT(), REFERENCE["episodes"][number]
    env.reset(seed=0, options={"state": recorded["start"]})
    touched = 0
    for row in recorded["steps"]:
        action, state, covered, reward, contacts = row[:2], row[2:7], row[7], row[8], row[9]
        _, own_reward, terminated, _, info = env.step(np.array(action))
        touched += contacts > 0
        # to 1e-13 mm where it was tried; another processor may round otherwise, and pushes multiply that
        np.testing.assert_allclose(state_of(env)[:2], state[:2], atol=1e-9)
        np.testing.assert_allclose(state_of(env)[2:], state[2:], atol=0.5 if touched else 0)
        assert info["coverage"] == pytest.approx(covered, abs=0.02 if touched else 1e-12)
        assert own_reward == pytest.approx(reward, abs=0.02 if touched else 1e-12)
        assert not terminated
    assert touched >= 20 or number == len(REFERENCE["episodes"]) - 1


def test_coverage_is_gym_pushts() -> None:
    shares = np.array([share for *_, share in REFERENCE["coverages"]])
    assert (shares == 0).any()
    assert (shares > 0.8).sum() >= 5
    np.testing.assert_allclose([coverage(Pose(*pose), GOAL) for *pose, _ in REFERENCE["coverages"]], shares, atol=1e-12)


def test_an_episode_with_the_fixed_goal_ends_where_gym_pushts_does() -> None:
    env, ended = PushT(goal="fixed"), [bool(end[-1]) for end in REFERENCE["ends"]]
    assert {True, False} == set(ended)
    for x, y, angle, covered, reward, end in REFERENCE["ends"]:
        env.reset(seed=0, options={"state": [450, 450, x, y, angle]})
        _, own_reward, terminated, _, info = env.step(np.array([450.0, 450.0]))
        assert (info["coverage"], own_reward) == pytest.approx((covered, reward), abs=1e-12)
        assert terminated == bool(end)
        later = PushT()
        later.reset(seed=0, options={"state": [450, 450, x, y, angle]})
        assert not later.step(np.array([450.0, 450.0]))[2]


def test_coverage_is_the_area_that_two_pictures_share() -> None:
    generator = np.random.default_rng(1)
    for _ in range(10):
        pose = Pose(*generator.normal(256, 30, 2), generator.uniform(-3, 3))
        points = generator.uniform(150, 350, (4_000, 2)).tolist()
        in_goal = [point for point in points if clearance(GOAL, *point) < 0]
        share = np.mean([clearance(pose, *point) < 0 for point in in_goal])
        assert coverage(pose, GOAL) == pytest.approx(share, abs=0.08)
        assert len(in_goal) * 200**2 / 4_000 == pytest.approx(AREA, rel=0.15)
    assert coverage(GOAL, GOAL) == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("parameters", [{}, {"goal": "fixed"}, {"actions": "displacement"}])
def test_gymnasium_finds_nothing_wrong(parameters: dict[str, Any]) -> None:
    made = gymnasium.make("recorders.push_t:dmbench/PushT-v0", render_mode="rgb_array", **parameters)
    with warnings.catch_warnings():  # others are errors
        warnings.filterwarnings("ignore", message=".*we recommend using a symmetric and normalized space")
        check_env(made.unwrapped)
    env = made.unwrapped
    assert isinstance(env, Environment)
    assert isinstance(env, Restorable)
    assert isinstance(env, Undrawn)
    assert isinstance(env, Judging)
    made.close()


@pytest.mark.slow
def test_seed_and_actions_give_every_frame_again(episodes: list[Episode]) -> None:
    env = PushT()
    for episode in reversed(episodes):
        frames = [env.reset(seed=episode.seed)[0], *(env.step(action)[0] for action in episode.labels.actions)]
        np.testing.assert_array_equal(frames, episode.frames)
        np.testing.assert_array_equal(env.objects().position, episode.labels.objects.position[-1])
        np.testing.assert_array_equal(env.masks(), episode.labels.masks[-1])


def test_any_number_of_workers_records_the_same_bytes(tmp_path: Path) -> None:
    recipe = DatasetRecipe(environment="push_t", policy="push", episodes=4, frames=12, shard_episodes=2, tasks=1)
    record_dataset(tmp_path / "one", recipe)
    record_dataset(tmp_path / "two", recipe, executor=make_executor("local", 2))
    assert Dataset.open(tmp_path / "one").fingerprint == Dataset.open(tmp_path / "two").fingerprint
    for file in sorted((tmp_path / "one" / "labels").iterdir()):
        assert file.read_bytes() == (tmp_path / "two" / "labels" / file.name).read_bytes()


def test_at_the_start_nothing_overlaps() -> None:
    env = PushT()
    for seed in range(100):
        env.reset(seed=seed)
        assert clearance(env.tee, *env.disc) > 15
        corners = np.array([env.tee.place(*corner) for corner in OUTLINE])
        assert corners.min() > 7
        assert corners.max() < 504
        before = env.tee
        env.step(np.array(env.disc))
        np.testing.assert_allclose(env.tee, before, rtol=1e-14)  # the centre of gravity is added and taken away


def test_a_given_state_is_had_exactly() -> None:
    env, state = PushT(), [100.5, 120.25, 300.0, 310.0, 12.0]
    env.reset(seed=0, options={"state": state})
    assert state_of(env) == state
    with pytest.raises(InvalidSetting, match="it takes five numbers: the disc's x and y"):
        env.reset(options={"state": [1.0, 2.0]})


@pytest.mark.slow
def test_a_restored_state_goes_on_exactly_as_it_did(episodes: list[Episode]) -> None:
    other, repeated = PushT(), 0
    other.reset(seed=99)
    for episode in episodes:
        env, snapshots, states = PushT(), [], []
        env.reset(seed=episode.seed)
        for action in episode.labels.actions:
            snapshots.append(env.snapshot())
            states.append(state_of(env))
            env.advance(action)
        states.append(state_of(env))
        for step in range(0, 95, 7):
            other.restore(snapshots[step])
            repeated += len(snapshots[step].since) > 0
            assert state_of(other) == states[step]
            for ahead in range(step, step + 5):
                other.advance(episode.labels.actions[ahead])
                assert state_of(other) == states[ahead + 1]
    assert repeated > 30  # states in the midst of a push
    other.restore(env.snapshot())
    np.testing.assert_array_equal(other.render(), env.render())


def test_what_is_advanced_without_drawing_is_drawn_when_asked(episodes: list[Episode]) -> None:
    env, episode = PushT(), episodes[0]
    env.reset(seed=episode.seed)
    for action in episode.labels.actions:
        env.advance(action)
    np.testing.assert_array_equal(env.render(), episode.frames[-1])
    np.testing.assert_array_equal(env.masks(), episode.labels.masks[-1])


def test_labels_agree_with_the_picture(episodes: list[Episode]) -> None:
    away: dict[int, list[float]] = {MASK_AGENT: [], MASK_FIRST_OBJECT: []}
    for episode in episodes:
        labels = episode.labels
        for mask, states in ((MASK_AGENT, labels.agent), (MASK_FIRST_OBJECT, labels.objects)):
            np.testing.assert_allclose(states.pixel, states.position[..., :2] * 250 - 0.5)
            for moment in np.flatnonzero(states.visible[:, 0] == 1)[::10]:
                y, x = np.nonzero(labels.masks[moment] == mask)
                away[mask].append(float(math.dist((x.mean(), y.mean()), states.pixel[moment, 0])))
    for distances in away.values():
        assert np.median(distances) < 0.1
        assert np.percentile(distances, 90) < 0.4


def test_a_drawn_tee_covers_its_area_without_a_seam() -> None:
    for angle in np.linspace(0, 3, 9):
        drawn = tee_stamp(Pose(250.3, 240.7, float(angle)))
        assert drawn is not None
        assert drawn.coverage.sum() / 256 == pytest.approx(AREA / 16, rel=0.01)
        y, x = np.indices(drawn.coverage.shape)
        weight = drawn.coverage / drawn.coverage.sum()
        middle = (x * weight).sum() + drawn.window[1].start, (y * weight).sum() + drawn.window[0].start
        np.testing.assert_allclose(middle, np.array(Pose(250.3, 240.7, float(angle)).centre) / 4 - 0.5, atol=0.1)
    upright = tee_stamp(Pose(256.0, 200.0, 0.0))
    assert upright is not None
    seam = round(230 / 4 - 0.5) - upright.window[0].start
    assert (upright.coverage[seam - 1 : seam + 2, upright.coverage.shape[1] // 2] == 256).all()


def test_a_disc_under_the_tee_is_seen_as_far_as_its_mask_says() -> None:
    env = PushT()
    for x in (200.0, 188.0, 180.0, 170.0):
        env.reset(seed=0, options={"state": [x, 215.0, 256.0, 200.0, 0.0]})
        env_alone = (env.masks() == MASK_AGENT).sum()
        env.reset(seed=0, options={"state": [x, 215.0, 256.0, 400.0, 0.0]})
        alone = (env.masks() == MASK_AGENT).sum()
        env.reset(seed=0, options={"state": [x, 215.0, 256.0, 200.0, 0.0]})
        assert env.agent().visible[0] == pytest.approx(env_alone / alone)
        assert env.objects().visible[0] == 1


def test_the_zone_is_part_of_the_background(episodes: list[Episode]) -> None:
    still = background()
    for episode in episodes[:2]:
        away = episode.labels.masks[50] == 0
        same = (episode.frames[50] == still).all(axis=-1)
        assert same[away].mean() > 0.98  # the rest are edges of the disc and the T
    assert (still == (144, 238, 144)).all(axis=-1).sum() > 0.8 * AREA / 16


def test_push_moves_the_tee_often_and_random_seldom(episodes: list[Episode]) -> None:
    pushed = np.mean([episode.labels.pushed.mean() for episode in episodes])
    wandered = np.mean([record_episode(PushT(), Wandering(), seed, 101).labels.pushed.mean() for seed in range(4)])
    assert 0.3 < pushed < 0.5
    assert wandered < 0.3
    assert PushT.policies[PushT.default_policy] is Pushing


@pytest.mark.parametrize("policy", [Pushing, Wandering])
def test_displacements_lead_where_targets_do(policy: type[Wandering]) -> None:
    one, other = PushT(), PushT(actions="displacement")
    with_targets = record_episode(one, policy(), 3, 60).labels
    with_displacements = record_episode(other, policy(), 3, 60).labels
    np.testing.assert_allclose(with_displacements.agent.position, with_targets.agent.position, atol=1e-9)
    assert np.abs(with_displacements.actions).max() <= 100


def test_a_displacement_out_of_the_square_ends_at_its_edge() -> None:
    env, other = PushT(actions="displacement"), PushT()
    for made in (env, other):
        made.reset(seed=0, options={"state": [30.0, 256.0, 300.0, 256.0, 0.0]})
    assert env.step(np.array([-100.0, 0.0]))[4]["illegal"]
    assert not other.step(np.array([0.0, 256.0]))[4]["illegal"]
    assert state_of(env) == state_of(other)
    assert not env.step(np.array([50.0, 0.0]))[4]["illegal"]


@pytest.mark.parametrize("wrong", [(513.0, 0.0), (np.nan, 0.0), (1.0,)])
def test_an_action_that_cannot_be_is_a_sentence_and_changes_nothing(wrong: tuple[float, ...]) -> None:
    env = PushT()
    env.reset(seed=1)
    before = state_of(env)
    with pytest.raises(InvalidSetting, match=r"'push_t' was given .* an action is x"):
        env.step(np.array(wrong))
    assert state_of(env) == before


def test_unknown_kinds_are_refused() -> None:
    with pytest.raises(UnknownName, match="no kind of goal named 'fixd'; did you mean 'fixed'"):
        PushT(goal="fixd")
    with pytest.raises(UnknownName, match="no kind of actions named 'targets'; did you mean 'target'"):
        PushT(actions="targets")


def test_the_judged_distance_has_the_published_rule_at_the_share_that_counts_as_solved() -> None:
    assert SUCCESS_DISTANCE == SUCCESS
    env, start = PushT(), Pose(300.0, 256.0, math.pi / 4)
    env.reset(seed=0, options={"state": [450, 450, *start]})
    at_start = env.objects()
    env.reset(seed=0, options={"state": [450, 450, *GOAL]})
    measure, before = env.task_measure(at_start, env.objects()), []
    for x in np.linspace(start.x, GOAL.x, 200):
        pose = Pose(float(x), GOAL.y, GOAL.angle)
        env.reset(seed=0, options={"state": [450, 450, *pose]})
        distance = measure.distance(env)
        assert (distance < SUCCESS) == (coverage(pose, GOAL) > SUCCESS_COVERAGE)
        before.append((distance, measure.cost(env)))
    distances, costs = np.array(before).T
    assert distances[0] == 1
    assert distances[-1] == 0
    assert (np.diff(distances) <= 1e-12).all()
    assert (np.diff(costs) < 0).all()
    assert costs[-1] == pytest.approx(0, abs=1e-15)
    assert costs[0] == pytest.approx(0.044**2)  # all corners are 44 mm off


def test_a_start_at_the_goal_is_judged_by_how_much_less_is_left_open() -> None:
    env, near = PushT(), Pose(GOAL.x + 1.0, GOAL.y, GOAL.angle)
    measure = GoalCoverage(near, GOAL)
    assert 0 < measure.uncovered(near) < 1 - SUCCESS_COVERAGE
    for pose, distance in ((near, 1.0), (GOAL, 0.0), (Pose(GOAL.x + 2.0, GOAL.y, GOAL.angle), 2.0)):
        env.reset(seed=0, options={"state": [450, 450, *pose]})
        assert measure.distance(env) == pytest.approx(distance, rel=0.02)
        assert GoalCoverage(GOAL, GOAL).distance(env) == 1


def test_the_oracle_sees_how_the_tee_is_turned() -> None:
    env, measure = PushT(), GoalCoverage(Pose(300.0, 256.0, 0.0), GOAL)
    costs = []
    for turn in (0.0, 0.5, 1.0, 2.0, 3.0):
        env.reset(seed=0, options={"state": [450, 450, *Pose.of_centre(*GOAL.centre, GOAL.angle + turn)]})
        costs.append(measure.cost(env))
    assert costs == sorted(costs)
    assert costs[1] > 5e-4
    assert measure.lost(env) == 0


def test_the_centre_is_that_of_the_area() -> None:
    points = np.random.default_rng(0).uniform((-70, -10), (70, 130), (200_000, 2))
    u, v = points.T
    inside = ((np.abs(u) < 60) & (v > 0) & (v < 30)) | ((np.abs(u) < 15) & (v >= 30) & (v < 120))
    np.testing.assert_allclose(points[inside].mean(0), CENTRE, atol=0.5)
    assert inside.mean() * 140 * 140 == pytest.approx(AREA, rel=0.02)


@pytest.mark.parametrize("goal", ["later", "fixed"])
def test_a_tasks_goal_is_a_later_frame_or_the_zone(tmp_path: Path, goal: str) -> None:
    recipe = DatasetRecipe(
        environment="push_t", parameters={"goal": goal}, policy="push", episodes=3, frames=40, tasks=2
    )
    record_dataset(tmp_path / "data", recipe)
    dataset = Dataset.open(tmp_path / "data")
    env = task_environment(recipe)
    assert isinstance(env, PushT)
    for problem in load_problems(dataset):
        recorded = dataset.video(problem.task.episode)[problem.task.goal]
        assert np.array_equal(problem.goal_frame, recorded) == (goal == "later")
        if goal == "fixed":
            shown, _ = env.reset(seed=0, options={"state": [256.0, 400.0, *GOAL]})
            np.testing.assert_array_equal(problem.goal_frame, shown)
            assert measure_of(env, problem).distance(env) == 0
        world = World(env, problem)
        assert world.distance == 1
        assert pose_of(problem.goal_objects).x == pytest.approx(256) or goal == "later"


@pytest.mark.slow
def test_the_oracle_brings_the_tee_to_where_it_was_later(tmp_path: Path) -> None:
    record_dataset(
        tmp_path / "data", DatasetRecipe(environment="push_t", policy="push", episodes=4, frames=40, tasks=1)
    )
    dataset = Dataset.open(tmp_path / "data")
    solver = make_solver("icem", ("samples=12", "iterations=2", "horizon=6"))
    oracle = make_reference("oracle", dataset.spec, solver=solver, make_env=lambda: task_environment(dataset.recipe))
    result = control(
        oracle, load_problems(dataset), lambda: task_environment(dataset.recipe), ControlSettings(steps=10)
    )
    assert result.distance[0, -1] < 0.5
    assert result.lost.sum() == 0
