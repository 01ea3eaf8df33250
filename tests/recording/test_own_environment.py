"""An environment of another package is recorded a second time in part, unless it says that it is exact."""

from __future__ import annotations

from pathlib import Path
from typing import Any, ClassVar

import gymnasium
import numpy as np
import pytest

from dmotion_bench.errors import DmbenchError, InvalidSetting, UsageError
from dmotion_bench.recording import session
from dmotion_bench.recording.preset import recipe_for
from dmotion_bench.recording.session import record_dataset
from dmotion_bench.registry import register_environment
from dmotion_bench.specs import DatasetRecipe
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


class Wrong(GridWorld):
    """Its policy chooses what there is not."""

    policies: ClassVar[Any] = {"random": lambda: lambda env, generator: 9}


@pytest.fixture(autouse=True)
def own(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("dmotion_bench.entry_points._ADDED", {})
    for kind in (Own, Forgetful, Sure, Still, Unmade, Factless, Wrong):
        register_environment(kind.__name__.lower(), kind)


def replay_of(environment: str, path: Path) -> Replay | None:
    record_dataset(path, DatasetRecipe(environment=environment, episodes=5, frames=6, tasks=1, shard_episodes=3))
    return Dataset.open(path).manifest.replay


def test_one_that_repeats_is_found_to(tmp_path: Path) -> None:
    assert replay_of("own", tmp_path / "d") == Replay(episodes=(0, 2, 4), differs="")


def test_one_that_does_not_has_no_tasks(tmp_path: Path) -> None:
    assert replay_of("forgetful", tmp_path / "d") == Replay(episodes=(0, 2, 4), differs="frame 0 of episode 0")
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
        ("wrong", "the policy 'random' chose action 9; there are 4"),
        (GridWorld, "is not the name of an environment; .* register_environment"),
    ],
)
def test_what_is_wrong_with_it_is_a_sentence(environment: Any, said: str, tmp_path: Path) -> None:
    with pytest.raises(DmbenchError, match=said):
        replay_of(environment, tmp_path / "d")
    assert not (tmp_path / "d").exists()


def test_a_class_that_is_no_environment_is_told_what_it_lacks() -> None:
    with pytest.raises(UsageError, match="has no 'recording', 'policies', 'default_policy', 'legal_actions'; see"):
        register_environment("mine", gymnasium.Env)


def test_a_policy_is_named_and_not_given() -> None:
    with pytest.raises(InvalidSetting, match="name it as 'MODULE:FUNCTION'"):
        recipe_for("own", policy=print)  # type: ignore[arg-type]
