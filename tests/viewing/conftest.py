"""A made-up world for the viewer: squares that an agent pushes about, and a model that is almost right."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest
from jaxtyping import Int, UInt8

from dmotion_bench.errors import LabelsNotAvailable
from dmotion_bench.specs import (
    DatasetRecipe,
    EnvSpec,
    Episode,
    EpisodeLabels,
    ObjectSpec,
    ObjectStates,
    SplitName,
)

SIZE, SIDE = 64, 9
SPEC = EnvSpec(
    id="made_up",
    actions=("up", "down", "left", "right"),
    agent=ObjectSpec(name="green_square", shape="square", color=(0, 200, 0)),
    objects=(
        ObjectSpec(name="red_square", shape="square", color=(230, 30, 30)),
        ObjectSpec(name="blue_square", shape="square", color=(40, 80, 255)),
    ),
    height=SIZE,
    width=SIZE,
    agent_has_color=True,
)


def made_up_episode(seed: int, frames: int = 12) -> Episode:
    """The agent walks at random; the red square is swept along from the middle on, the blue one then vanishes."""
    generator = np.random.default_rng(seed)
    actions = generator.integers(4, size=frames - 1)
    step = np.array([[0, -3], [0, 3], [-3, 0], [3, 0]])[actions]
    agent = np.clip(np.vstack([[32, 32], 32 + np.cumsum(step, axis=0)]), SIDE, SIZE - SIDE)[:, None].astype(float)
    half = frames // 2
    objects = np.tile(np.array([[12.0, 12.0], [50.0, 20.0]]), (frames, 1, 1))
    objects[half:, 0] += agent[half:, 0] - agent[half - 1, 0]
    objects[-2:, 1] = np.nan
    masks = np.zeros((frames, SIZE, SIZE), np.uint8)
    palette = np.zeros((4, 3), np.uint8)
    palette[1], palette[2:] = SPEC.agent.color, [it.color for it in SPEC.objects]
    for frame in range(frames):
        for value, place in ((2, objects[frame, 0]), (3, objects[frame, 1]), (1, agent[frame, 0])):
            if np.isfinite(place).all():
                x, y = np.round(place).astype(int)
                masks[frame, max(0, y - SIDE // 2) : y + SIDE // 2 + 1, max(0, x - SIDE // 2) : x + SIDE // 2 + 1] = (
                    value
                )
    moved = np.abs(np.diff(np.nan_to_num(objects, nan=-1), axis=0)).max((1, 2)) > 0
    labels = EpisodeLabels(actions=actions, pushed=moved, agent=_states(agent), objects=_states(objects), masks=masks)
    return Episode(frames=palette[masks], labels=labels, seed=seed, ended="truncated")


def _states(pixel: np.ndarray) -> ObjectStates:
    height = np.zeros((*pixel.shape[:2], 1))
    gone = ~np.isfinite(pixel).all(-1)
    return ObjectStates(
        position=np.concatenate([pixel / 100, np.where(gone[..., None], np.nan, height)], axis=-1),
        orientation=np.where(gone[..., None], np.nan, np.array([0.0, 0.0, 0.0, 1.0])),
        pixel=pixel,
        visible=np.where(gone, 0.0, 1.0),
    )


class MadeUpDataset:
    """Behaves as ``storage.dataset.Dataset`` does, from memory."""

    def __init__(self, episodes: Sequence[Episode], labelled: bool = True) -> None:
        self.episodes, self.labelled = episodes, labelled
        self.name, self.spec = "made_up-tiny", SPEC
        self.recipe = DatasetRecipe(environment="made_up", episodes=len(episodes), frames=len(episodes[0].frames))

    def __len__(self) -> int:
        return len(self.episodes)

    def video(self, episode: int) -> UInt8[np.ndarray, "t h w 3"]:
        return self.episodes[episode].frames

    def labels(self, episode: int) -> EpisodeLabels:
        if not self.labelled:
            raise LabelsNotAvailable("made up without labels")
        return self.episodes[episode].labels

    def split(self, name: SplitName) -> Int[np.ndarray, " n"]:
        return {"test": np.array([0]), "validation": np.array([1])}.get(name, np.arange(2, len(self)))


@pytest.fixture(scope="session")
def dataset() -> MadeUpDataset:
    return MadeUpDataset([made_up_episode(seed) for seed in range(4)])


@pytest.fixture(scope="session")
def unlabelled(dataset: MadeUpDataset) -> MadeUpDataset:
    return MadeUpDataset(dataset.episodes, labelled=False)
