"""``gym:ID``: frames and actions as Gymnasium gives them, and a sentence for whatever somebody's simulator does."""

from __future__ import annotations

import ctypes.util
import importlib
import json
import random
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import gymnasium
import numpy as np
import pytest
import strange_worlds
from dmbench_command import Outcome, dmbench
from noise_world import files_of
from strange_worlds import SLIDER, SMALL

from dmotion_bench.actions import Continuous, Discrete
from dmotion_bench.environment import ObjectEnvironment, Tier, tier_of
from dmotion_bench.errors import DatasetError, InvalidSetting, RecordingFailed
from dmotion_bench.execution.local_executor import LocalExecutor
from dmotion_bench.planning.tasks import load_problems
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import Preset
from dmotion_bench.storage.dataset import Dataset
from recorders.gymnasium_env import modules
from recorders.gymnasium_env.worlds import WORLDS

Run = Callable[..., Outcome]
strange_worlds.register()


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> Run:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    return lambda *words: dmbench(("record", *words), capsys, monkeypatch)


def recorded(path: Path, environment: str, *, episodes: int = 2, frames: int = 8, **asked: Any) -> Dataset:
    recipe = recipe_for(environment, Preset.TINY, episodes=episodes, frames=frames, **{"size": 24, **asked})
    record_dataset(path, recipe)
    return Dataset.open(path)


def blocks(picture: np.ndarray, rows: int, columns: int) -> np.ndarray:
    """A picture whose sides are whole multiples of the new ones, averaged by numpy."""
    split = picture.reshape(rows, picture.shape[0] // rows, columns, picture.shape[1] // columns, 3)
    return np.floor(split.mean(axis=(1, 3)) + 0.5).astype(np.uint8)


def test_frames_and_actions_are_those_of_gymnasium_itself(tmp_path: Path) -> None:
    dataset = recorded(tmp_path / "data", SLIDER, episodes=3)
    assert dataset.spec.actions == Discrete(("5", "6"))
    assert dataset.spec.step_ns == 50_000_000
    for episode, row in enumerate(dataset.rows):
        direct = strange_worlds.Slider(render_mode="rgb_array")
        direct.reset(seed=row.seed % 2**31)
        seen = [blocks(direct.render(), 24, 24)]
        for action in dataset.states(episode).actions.tolist():
            direct.step(5 + action)
            seen.append(blocks(direct.render(), 24, 24))
        np.testing.assert_array_equal(dataset.video(episode), np.stack(seen))
    labels = dataset.labels(0)
    assert not labels.masks.any()
    assert np.isnan(labels.agent.position).all()
    assert labels.objects.position.shape[1] == 0


def test_continuous_actions_keep_their_shape_and_bounds(tmp_path: Path) -> None:
    dataset = recorded(tmp_path / "data", "gym:Strange/Speed-v0", frames=20)
    spec = dataset.spec.actions
    assert isinstance(spec, Continuous)
    np.testing.assert_allclose([spec.low, spec.high], [(-0.1, -0.1), (0.3, 0.2)], rtol=1e-6)
    actions = np.concatenate([dataset.states(episode).actions for episode in range(2)])
    assert actions.min() < -0.05
    assert actions[:, 0].max() > 0.2


def test_what_a_simulator_writes_into_an_action_is_seen_by_nobody() -> None:
    env: Any = environment_class("gym:Strange/Scribbling-v0")(frame_size=24, action_repeat=2)
    env.reset(seed=0)
    assert env.step(np.array([0.1, 0.15]))[1] == 4.0
    np.testing.assert_allclose(env._inner.unwrapped.last, [[0.1], [0.15]], rtol=1e-6)
    assert env.facts.step_ns == 40_000_000


def test_the_packages_that_may_be_imported_are_looked_up_once(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(modules, "packages_distributions", lambda: asked.append(1) or {"csv": ["minigrid"]})
    monkeypatch.setattr(modules, "distribution", lambda _: SimpleNamespace(requires=["gymnasium>=1"]))
    asked: list[int] = []
    assert modules.import_named("csv", "a test") is modules.import_named("csv", "a test")
    assert asked == [1]


@pytest.mark.slow
def test_the_version_of_the_package_that_registers_an_id_stands_in_the_data_set(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(modules, "distribution", lambda _: SimpleNamespace(requires=["gymnasium"]))
    dataset = recorded(tmp_path / "data", "gym:pytest:Strange/Slider-v0")
    assert dataset.manifest.versions["pytest"] == pytest.__version__


def test_frame_skip_takes_an_action_several_times(tmp_path: Path) -> None:
    own = {"policy": "own_policies:Alternating", "settings": ("places=48",)}
    every = recorded(tmp_path / "every", SLIDER, frames=4, frame_skip=3, **own)
    for episode in range(2):
        moved = strange_worlds.Slider(render_mode="rgb_array", places=48)
        moved.reset(seed=every.rows[episode].seed % 2**31)
        assert every.states(episode).actions.tolist() == [0, 1, 0]
        for frame, action in zip(every.video(episode), (5, 6, 5, None), strict=True):
            np.testing.assert_array_equal(frame, blocks(moved.render(), 24, 24))
            for _ in range(3 if action else 0):
                moved.step(action)
    assert every.spec.step_ns == 150_000_000
    assert every.recipe.parameters["action_repeat"] == 3


def test_a_time_limit_cuts_no_repeat_short() -> None:
    """It ends a recorded episode; a task may go on beyond it, and an action is as much there as before."""
    env: Any = environment_class(SLIDER)(frame_size=24, places=48, action_repeat=3, max_episode_steps=4)
    env.reset(seed=1)
    began = env._inner.unwrapped.place
    ended = [env.step(1)[3] for _ in range(4)]
    assert ended == [False, True, True, True]
    assert env._inner.unwrapped.place == began + 4 * 3


def test_an_episode_that_is_over_stays_as_it_is() -> None:
    env = environment_class(SLIDER)(frame_size=24)
    env.reset(seed=1)
    while not (after := env.step(1))[2]:
        pass
    frame, _, terminated, _, info = env.step(0)
    np.testing.assert_array_equal(frame, after[0])
    assert terminated
    assert info["illegal"]
    assert not env.reset(seed=1)[1]
    assert not env.step(0)[2]


def test_an_episode_ends_where_the_environment_ends_it(tmp_path: Path) -> None:
    dataset = recorded(tmp_path / "data", SLIDER, episodes=4, frames=30, policy="own_policies:right")
    assert {row.ended for row in dataset.rows} == {"terminated"}
    assert (dataset.lengths < 13).all()
    cut = recorded(tmp_path / "cut", SLIDER, settings=("max_episode_steps=3",), frames=30)
    assert cut.lengths.tolist() == [4, 4]
    assert {row.ended for row in cut.rows} == {"truncated"}


def test_what_is_raised_without_a_word_names_the_method(monkeypatch: pytest.MonkeyPatch) -> None:
    def undrawn(world: Any) -> None:
        raise NotImplementedError

    monkeypatch.setattr(strange_worlds.Slider, "render", undrawn)
    said = r"raised NotImplementedError in 'render' at step 0 of the episode with seed 1 \(test_gymnasium_env.py, line"
    with pytest.raises(RecordingFailed, match=said):
        environment_class(SLIDER)().reset(seed=1)


@pytest.mark.parametrize("name", ["Keyed", "Blind"])
def test_what_is_refused_is_closed(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    closed = []
    monkeypatch.setattr(strange_worlds.Slider, "close", lambda world: closed.append(type(world).__name__))

    with pytest.raises(InvalidSetting):
        environment_class(f"gym:Strange/{name}-v0")()

    assert closed == [name]


def test_it_tells_pixels_alone() -> None:
    env = environment_class(SLIDER)()
    assert tier_of(env) is tier_of(type(env)) is Tier.PIXELS
    assert not isinstance(env, ObjectEnvironment)
    assert tier_of(environment_class("grid_world")) is Tier.MASKS


@pytest.mark.slow
def test_the_recipe_says_what_another_gymnasium_might_decide_otherwise(tmp_path: Path) -> None:
    settings = ("places=16", "wrappers=gymnasium.wrappers:Autoreset")
    dataset = recorded(tmp_path / "data", SLIDER, settings=settings, policy="sticky")
    assert dataset.recipe.parameters == {
        "action_repeat": 1,
        "frame_size": 24,
        "fresh": True,
        "max_episode_steps": 40,
        "places": 16,
        "wrappers": "gymnasium.wrappers:Autoreset",
    }
    assert dataset.recipe.policy == "sticky"
    assert dataset.manifest.versions["gymnasium"] == gymnasium.__version__


@pytest.mark.slow
def test_sticky_repeats_and_random_does_not(tmp_path: Path) -> None:
    shares = {}
    for policy in ("sticky", "random"):
        dataset = recorded(tmp_path / policy, SLIDER, episodes=20, frames=12, policy=policy, size=16)
        actions = [dataset.states(episode).actions for episode in range(20)]
        shares[policy] = np.concatenate([one[1:] == one[:-1] for one in actions]).mean()
    assert shares["sticky"] == pytest.approx(0.875, abs=0.06)  # of two actions a new one is the old one half the time
    assert shares["random"] == pytest.approx(0.5, abs=0.1)


def test_what_does_not_repeat_is_recorded_and_said(run: Run, tmp_path: Path) -> None:
    outcome = run("gym:Strange/Unseeded-v0", *SMALL, "--tasks", "3")
    assert outcome.code == 0
    assert "the environment does not repeat: frame 0 of episode 0 differs" in outcome.out
    dataset = Dataset.open(tmp_path / "data" / "gym-Strange-Unseeded-v0-tiny")
    assert dataset.manifest.replay is not None
    assert not dataset.manifest.replay.identical
    assert dataset.tasks() == []
    with pytest.raises(DatasetError, match="none of the 3 control tasks that were asked for: its environment or"):
        load_problems(dataset)
    assert json.loads(run("gym:Strange/Unseeded-v0", *SMALL, "--tasks", "3", "--json").out)["repeats"] is False


def test_json_is_alone_on_stdout_whatever_a_simulator_prints(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("DMBENCH_WORKSPACE", str(tmp_path))
    words = ("record", "gym:Strange/Talking-v0", *SMALL)
    outcome = dmbench((*words, "--json"), capfd, monkeypatch)
    assert json.loads(outcome.out)["episodes"] == 2
    assert {"a step", "another step", "a step in C"} <= {*outcome.err.splitlines()}
    outcome = dmbench((*words, "--out", str(tmp_path / "again")), capfd, monkeypatch)
    assert {"a step", "another step"} <= {*outcome.out.splitlines()}
    assert str(tmp_path / "again") in outcome.out  # stdout is where it was


def test_a_simulator_that_draws_from_shared_generators_repeats_and_leaves_them_alone(tmp_path: Path) -> None:
    dataset = recorded(tmp_path / "data", "gym:Strange/Legacy-v0", episodes=4)
    assert dataset.manifest.replay is not None
    assert dataset.manifest.replay.identical
    assert len({dataset.video(episode).tobytes() for episode in range(4)}) == 4
    before = random.getstate(), np.random.get_state()[1].tolist()  # noqa: NPY002
    env = environment_class("gym:Strange/Legacy-v0")(frame_size=16)
    env.reset(seed=3)
    env.step(0)
    assert (random.getstate(), np.random.get_state()[1].tolist()) == before  # noqa: NPY002


def test_a_simulator_that_remembers_has_a_new_one_for_each_episode(tmp_path: Path) -> None:
    fresh = recorded(tmp_path / "fresh", "gym:Strange/Remembering-v0", episodes=4)
    used = recorded(tmp_path / "used", "gym:Strange/Remembering-v0", episodes=4, settings=("fresh=false",))
    assert fresh.manifest.replay is not None
    assert fresh.manifest.replay.identical
    assert used.manifest.replay is not None
    assert used.manifest.replay.differs == "frame 0 of episode 2"


def test_what_repeats_is_recorded_too_and_known_environments_are_not_asked(run: Run, tmp_path: Path) -> None:
    outcome = run(SLIDER, *SMALL)
    assert "recorded again, 2 episodes have the same bytes" in outcome.out
    written = json.loads((tmp_path / "data" / "gym-Strange-Slider-v0-tiny" / "dataset.json").read_text())
    assert written["replay"] == {"episodes": [0, 1], "differs": ""}
    run("grid_world", "--preset", "tiny", "--episodes", "2", "--workers", "1")
    assert "replay" not in json.loads((tmp_path / "data" / "grid_world-tiny" / "dataset.json").read_text())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "says"),
    [
        (("gym:Strange/Slidr-v0",), "did you mean 'Strange/Slider-v0'?"),
        (("gym:Strange/Slider-v3",), "did you mean 'Strange/Slider-v0'?"),
        (("gym:nothing like it",), "'dmbench list environments' lists some"),
        (("gim:Strange/Slider-v0",), "no family of environments named 'gim'; did you mean 'gym'?"),
        (
            ("gym:Strange/Paintless-v0",),
            "'gym:Strange/Paintless-v0' needs the package 'pygame', which is not installed; install it: "
            "pip install 'dmbench[gym-classic]'",
        ),
        (("Pendulum-v1",), "no environment named 'Pendulum-v1'; did you mean 'gym:Pendulum-v1'?"),
        (("gym:Strange/Blind-v0",), "has no render mode 'rgb_array', so it cannot be recorded; it has 'ansi'."),
        (("gym:Strange/Keyed-v0",), "a space of the kind 'Dict', and only 'Discrete' and bounded 'Box'"),
        (("gym:Strange/Buttons-v0",), "a space of the kind 'MultiBinary'"),
        (("gym:Strange/Boundless-v0",), "gives it others with '--set wrappers=MODULE:CLASS'"),
        (("gym:Strange/Clamped-v0",), "number 1 of the actions of 'gym:Strange/Clamped-v0' can only be 0"),
        (("gym:Strange/Leaving-v0",), "raised SystemExit in 'step' at step 0 of the episode with seed"),
        (("gym:Strange/Growing-v0",), "from 96x48 to 96x96 pixels at step 3 of the episode with seed"),
        (("gym:Strange/Gray-v0",), "an array of uint8 of the shape (48, 96)"),
        (("gym:Strange/Listing-v0",), "drew a NoneType"),
        ((SLIDER, "--set", "fails_at=4"), "raised FloatingPointError in 'step' at step 4 of the episode with seed"),
        ((SLIDER, "--set", "place=4"), "no setting of gym:Strange/Slider-v0 named 'place'; did you mean 'places'?"),
        ((SLIDER, "--set", "places=many"), "places is 'many'; it must be a whole number"),
        ((SLIDER, "--set", "render_mode=human"), "no setting of gym:Strange/Slider-v0 named 'render_mode'"),
        (
            (SLIDER, "--set", "wrappers=os:system"),
            "the module 'os', which 'gym:Strange/Slider-v0' names, is in no",
        ),
        ((SLIDER, "--set", "wrappers=gymnasium.spaces:Box"), "which is no wrapper"),
        ((SLIDER, "--vary", "light"), "dmbench varies nothing in"),
        ((SLIDER, "--policy", "stciky"), "did you mean 'sticky'?"),
        ((SLIDER, "--policy", "nowhere:to_be_found"), "in a folder that PYTHONPATH names"),
        ((SLIDER, "--policy", "own_policies:left"), "has no function 'left'"),
        ((SLIDER, "--policy", "own_policies:clumsy"), "raised KeyError: 'speed'"),
        (
            (SLIDER, "--policy", "own_policies:impossible"),
            "chose action 7; there are 2, numbered from 0; it returns one of",
        ),
        (("gym:os:Slider-v0",), "the module 'os', which 'gym:os:Slider-v0' names, is in no"),
        (("gym:hypothesis.strategies:Slider-v0",), "is of the package 'hypothesis', which does not"),
        (("grid_world", "--set", "version=1"), "grid_world has no setting 'frame_size'; leave out '--size'."),
    ],
)
def test_wrong_input_is_one_sentence_and_leaves_nothing(
    run: Run, words: tuple[str, ...], says: str, tmp_path: Path
) -> None:
    outcome = run(*words, *SMALL)
    assert outcome.code in (1, 2)
    assert says in outcome.sentence()
    assert not [path for path in tmp_path.rglob("*") if path.name != "data"]


def test_a_recording_that_fails_later_leaves_what_was_there_before(run: Run, tmp_path: Path) -> None:
    (folder := tmp_path / "data" / "mine").mkdir(parents=True)
    assert run(SLIDER, *SMALL, "--out", str(folder)).code == 0
    before = files_of(folder)
    outcome = run(SLIDER, *SMALL, "--set", "fails_at=4", "--out", str(folder))
    assert "holds a data set of another recipe" in outcome.sentence()
    assert files_of(folder) == before


def test_a_size_out_of_range_and_a_text_that_could_name_a_file_are_refused() -> None:
    with pytest.raises(InvalidSetting, match="it can be 16 to 1024 pixels"):
        environment_class(SLIDER)(frame_size=3000)
    for text in ("/etc/passwd", "../model.xml", "~/model.xml", "a\\b"):
        with pytest.raises(InvalidSetting, match="could name a file"):
            environment_class(SLIDER)(title=text)


@pytest.mark.slow
def test_the_same_bytes_for_any_number_of_workers(tmp_path: Path) -> None:
    pytest.importorskip("pygame")
    recipe = replace(recipe_for("gym:CartPole-v1", Preset.TINY, episodes=2, frames=5, size=32), shard_episodes=1)
    record_dataset(tmp_path / "one", recipe)
    record_dataset(tmp_path / "two", recipe, LocalExecutor(2))
    assert files_of(tmp_path / "one") == files_of(tmp_path / "two")
    record_dataset(tmp_path / "extended", replace(recipe, episodes=1))
    record_dataset(tmp_path / "extended", recipe)
    assert files_of(tmp_path / "extended") == files_of(tmp_path / "one")


SHIPPED = {
    "CartPole-v1": "pygame",
    "Pendulum-v1": "pygame",
    "MountainCarContinuous-v0": "pygame",
    "MiniGrid-DoorKey-5x5-v0": "minigrid",
    "LunarLander-v3": "Box2D",
    "CarRacing-v3": "Box2D",
    "Reacher-v5": "mujoco",
    "Pusher-v5": "mujoco",
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SHIPPED)
def test_a_world_that_ships_is_recorded_at_preset_tiny(name: str, tmp_path: Path) -> None:
    pytest.importorskip(SHIPPED[name])
    settings: tuple[str, ...] = ()
    if SHIPPED[name] == "mujoco":
        settings = ("width=64", "height=64")
        if ctypes.util.find_library("EGL") is None:
            pytest.skip("MuJoCo draws by EGL: apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri")
    dataset = recorded(tmp_path / "data", f"gym:{name}", episodes=3, frames=6, size=64, settings=settings)
    assert dataset.manifest.replay is not None
    assert dataset.manifest.replay.identical, dataset.manifest.replay
    frames = np.concatenate([dataset.video(episode) for episode in range(3)])
    assert len(np.unique(frames, axis=0)) > 3
    assert len(np.unique(frames.reshape(-1, 3), axis=0)) > 3
    if name.startswith("MiniGrid"):
        assert str(dataset.spec.actions) == "left, right, forward, pickup, drop, toggle, done"


def test_the_worlds_that_are_said_to_work_have_a_documented_command() -> None:
    page = (Path(__file__).parents[2] / "docs" / "gymnasium.md").read_text()
    for name, world in WORLDS.items():
        (row,) = [line for line in page.splitlines() if f"`dmbench record gym:{name}" in line and line.startswith("|")]
        assert f"dmbench[{world.extra}]" in row


def test_a_missing_package_is_named_with_the_extra(monkeypatch: pytest.MonkeyPatch, run: Run) -> None:
    def absent(name: str, package: str | None = None) -> Any:
        raise ModuleNotFoundError(f"No module named {name!r}", name=name)

    monkeypatch.setattr("recorders.gymnasium_env.family.importlib.import_module", absent)
    outcome = run("gym:ALE/Freeway-v5", *SMALL)
    assert "needs the package 'ale-py'" in outcome.sentence()
    assert "pip install 'dmbench[gym-atari]'" in outcome.sentence()
    importlib.invalidate_caches()
