"""An environment of another package is recorded a second time in part, unless it says that it is exact."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

from dmotion_bench.errors import DmbenchError, InvalidSetting, RecordingFailed, UsageError
from dmotion_bench.recording import session
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.registry import register_environment
from dmotion_bench.specs import DatasetRecipe, ObjectStates
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import Replay
from recorders.grid_world import GridWorld


class Own(GridWorld):
    """Repeats."""


class Forgetful(GridWorld):
    """Takes no notice of its seed."""

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed=int(np.random.default_rng().integers(2**31)), options=options)


class Sure(Forgetful):
    """Says that it is exact, and is believed."""

    unproven = False


class Still(GridWorld):
    """Takes another step than the world that it is made of, which makes many episodes at once."""

    def step(self, action: int) -> Any:
        return self.render(), 0.0, False, False, {}


class Unmade(GridWorld):
    """Cannot be made."""

    def __init__(self) -> None:
        raise ValueError("no licence")


class Factless(GridWorld):
    """Says nothing of itself."""

    def __init__(self) -> None:
        super().__init__()
        del self.facts


class Drifting(GridWorld):
    """Draws the same again, and tells other places."""

    def objects(self) -> ObjectStates:
        told = super().objects()
        return replace(told, position=told.position + np.random.default_rng().uniform(0, 1e-3))


class Masked(GridWorld):
    """Draws the same again, with another mask."""

    def masks(self) -> Any:
        return np.random.default_rng().integers(0, 2, (self.facts.height, self.facts.width), np.uint8)


class Undecided(GridWorld):
    """Says of each thing whether the episode is over."""

    def step(self, action: int) -> Any:
        frame, reward, _, truncated, info = super().step(action)
        return frame, reward, np.zeros(2, np.bool_), truncated, info


class Invariable(GridWorld):
    """Names a factor that it cannot vary."""

    factors: ClassVar[Any] = {"light": "its own"}

    def reset(self, *, seed: int | None = None, options: dict[str, Any] | None = None) -> Any:
        return super().reset(seed=seed, options=options and {}[options["vary"][0]])


class Wrong(GridWorld):
    """Its policy chooses what there is not."""

    policies: ClassVar[Any] = {"random": lambda: lambda env, generator: 9}


@pytest.fixture(autouse=True)
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    for kind in (Own, Forgetful, Sure, Still, Unmade, Factless, Drifting, Masked, Undecided, Invariable, Wrong):
        register_environment(kind.__name__.lower(), kind)


def replay_of(environment: str, path: Path) -> Replay | None:
    record_dataset(path, DatasetRecipe(environment=environment, episodes=5, frames=6, tasks=1, shard_episodes=3))
    return Dataset.open(path).manifest.replay


def test_one_that_repeats_is_found_to(tmp_path: Path) -> None:
    assert replay_of("own", tmp_path / "d") == Replay(episodes=(0, 2, 4), differs="")


def test_one_that_does_not_has_no_tasks(tmp_path: Path) -> None:
    assert replay_of("forgetful", tmp_path / "d") == Replay(episodes=(0, 2, 4), differs="frame 0 of episode 0")
    assert Dataset.open(tmp_path / "d").tasks() == []


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ("drifting", "what the environment tells of its state at frame 0 of episode 0"),
        ("masked", "the mask of frame 0 of episode 0"),
    ],
)
def test_one_that_tells_something_else_of_the_same_picture_does_not_repeat(
    environment: str, said: str, tmp_path: Path
) -> None:
    assert replay_of(environment, tmp_path / "d") == Replay(episodes=(0, 2, 4), differs=said)
    assert Dataset.open(tmp_path / "d").tasks() == []


def test_the_version_of_its_package_stands_in_the_data_set(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(session, "owners", lambda group, name: {"pytest"})
    replay_of("own", tmp_path / "d")
    assert Dataset.open(tmp_path / "d").manifest.versions["pytest"] == pytest.__version__


@pytest.mark.parametrize("environment", ["sure", "grid_world"])
def test_one_that_is_exact_is_not_asked(environment: str, tmp_path: Path) -> None:
    assert replay_of(environment, tmp_path / "d") is None


def test_its_own_steps_are_recorded(tmp_path: Path) -> None:
    assert replay_of("still", tmp_path / "d") == Replay(episodes=(0, 2, 4), differs="")
    video = Dataset.open(tmp_path / "d").video(0)
    assert np.array_equal(video, np.broadcast_to(video[:1], video.shape))


@pytest.mark.parametrize(
    ("environment", "said"),
    [
        ("unmade", "'unmade' cannot be made: ValueError: no licence."),
        ("factless", "'factless' has no 'facts'"),
        ("undecided", "raised ValueError in 'step' at step 0 of the episode with seed"),
        ("wrong", "the policy 'random' chose action 9; there are 4"),
        (GridWorld, "is not the name of an environment; .* register_environment"),
    ],
)
def test_what_is_wrong_with_it_is_a_sentence(environment: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(DmbenchError, match=said):
        replay_of(environment, tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_factor_that_it_cannot_vary_is_a_sentence(tmp_path: Path) -> None:
    recipe = DatasetRecipe(environment="invariable", episodes=5, frames=6, tasks=1, shard_episodes=3, vary=("light",))
    with pytest.raises(RecordingFailed, match="'invariable' raised KeyError in 'reset' with the seed 0"):
        record_dataset(tmp_path / "d", recipe)


@pytest.mark.parametrize("policy", ["Needy", "Failing"])
def test_a_policy_that_cannot_be_made_is_a_sentence(policy: str, tmp_path: Path) -> None:
    recipe = DatasetRecipe(environment="own", policy=f"own_policies:{policy}", episodes=5, frames=6, shard_episodes=3)
    with pytest.raises(RecordingFailed, match=f"the policy 'own_policies:{policy}' raised .*; a class is made anew"):
        record_dataset(tmp_path / "d", recipe)
    assert not (tmp_path / "d").exists()


def test_a_class_that_is_no_environment_is_told_what_it_lacks() -> None:
    with pytest.raises(UsageError, match="has no 'recording', 'policies', 'default_policy', 'legal_actions'; see"):
        register_environment("mine", gymnasium.Env)


def test_a_policy_is_named_and_not_given() -> None:
    with pytest.raises(InvalidSetting, match="name it as 'MODULE:FUNCTION'"):
        recipe_for("own", policy=print)  # type: ignore[arg-type]
