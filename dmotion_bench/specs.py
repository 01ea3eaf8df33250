"""Data classes that all parts share: facts of an environment, an episode's content, a recipe.

Numpy only: the recorders, the storage and the planner share these without loading torch.
Axis letters: ``t`` time, ``k`` objects, ``h w`` image rows and columns.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.actions import ActionSpec

Scalar = str | int | float | bool
SplitName = Literal["train", "validation", "test"]

IMPORTED = "imported"
"""What stands in the place of an environment's name where recordings come from somewhere else."""

VERSION = "version"
"""The parameter of an environment's constructor that says which of its versions it is; see ``Versioned``."""

SPLIT = "split"
"""The parameter of an import that says whose parts stay on one side of its split; it is missing for episodes."""

SOURCE = "source"
"""The value of ``SPLIT`` for parts of one recording or demonstration."""

DELAY = "delay"
"""The factor of variation that says by how many steps an episode's frames lag behind the states of its world."""

MOST_THREADS = 1024  # that a training computes with
MOST_PROCESSES = 4096  # of a machine, and machines

MASK_BACKGROUND = 0
MASK_AGENT = 1
MASK_FIRST_OBJECT = 2  # object k of EnvSpec.objects has the mask value 2 + k; other agents come after the objects


class Supervision(StrEnum):
    """Which action labels a model is given while it learns."""

    NONE = "none"  # video only; actions are aligned afterwards from demonstrations
    FEW = "few"  # video, and a few demonstrations while it learns from it
    ACTIONS = "actions"  # asks the label budget for the actions of its training triplets


class Preset(StrEnum):
    """The size of recordings and trainings: seconds (tiny), minutes on a laptop (small), or as in the paper."""

    TINY = "tiny"
    SMALL = "small"
    PAPER = "paper"


@dataclass(frozen=True, kw_only=True)
class ObjectSpec:
    """One coloured object, as the position finder and the viewer know it.

    Attributes:
        name: Unique within the environment, such as ``"red_circle"``.
        shape: A word for people: ``"circle"``, ``"box"``.
        color: RGB, 0-255: the object's own colour, before any light falls on it.
    """

    name: str
    shape: str
    color: tuple[int, int, int]


@dataclass(frozen=True, kw_only=True)
class EnvSpec:
    """The facts of an environment that never change.

    Attributes:
        id: The registry's name of it.
        actions: What can be done at each step; None for recordings whose actions are unknown.
        agent: The controllable thing. Its colour finds it in an image only where ``agent_has_color`` says so.
        objects: The things that the agent moves.
        other_agents: Controllable things beside ``agent``, in worlds where an action says what several of them do
            (``Discrete.joint``). Their names differ from those of all other things.
        height, width: Of a frame [px].
        step_ns: Time between two frames [ns].
        agent_has_color: Whether the agent is one patch of ``agent.color``, and so with each of the others.
        shaded: Whether light changes the colours, so that an object is known by its hue, not by its exact RGB.
        push_threshold: An object that moved farther than this in one step counts as pushed [m].
    """

    id: str
    actions: ActionSpec | None
    agent: ObjectSpec
    objects: tuple[ObjectSpec, ...]
    height: int = 128
    width: int = 128
    step_ns: int = 100_000_000
    agent_has_color: bool = False
    shaded: bool = False
    push_threshold: float = 1e-3
    other_agents: tuple[ObjectSpec, ...] = ()

    @property
    def agents(self) -> tuple[ObjectSpec, ...]:
        """All that actions move; part k of a joint action is what agent k does."""
        return (self.agent, *self.other_agents)

    @property
    def agent_masks(self) -> tuple[int, ...]:
        """The mask values of ``agents``: 1 for the first, the others come after the objects."""
        after = MASK_FIRST_OBJECT + len(self.objects)
        return (MASK_AGENT, *range(after, after + len(self.other_agents)))


@dataclass(frozen=True, kw_only=True)
class ObjectStates:
    """Where things are at one moment (leading axis ``k``) or over an episode (``t k``).

    Attributes:
        position: [m], world frame; NaN for an object that no longer exists.
        orientation: Unit quaternion x y z w; NaN likewise.
        pixel: Centre (x, y) in the picture [px], with pixel (0, 0)'s centre at (0, 0); NaN for one that is not shown.
        visible: Fraction of the object's own pixels that nothing hides, 0 for one that is not shown.
    """

    position: Float[np.ndarray, "*t k 3"]
    orientation: Float[np.ndarray, "*t k 4"]
    pixel: Float[np.ndarray, "*t k 2"]
    visible: Float[np.ndarray, "*t k"]


@dataclass(frozen=True, kw_only=True)
class EpisodeLabels:
    """The labels of an episode of ``t`` frames, which are kept apart from its video.

    Attributes:
        actions: ``actions[i]`` is the action taken at frame i, so frame i+1 = step(frame i, actions[i]): its number, or
            the numbers of a continuous action in their units.
        pushed: Whether any object moved between frame i and frame i+1.
        agent: The states of ``EnvSpec.agents``: k = 1 where there is one.
        objects: In the order of ``EnvSpec.objects``.
        masks: 0 background, 1 agent, 2 + k object k, then the other agents (``EnvSpec.agent_masks``).
        factors: The episode's factors of variation, empty by default. With a ``DELAY`` of d, ``pixel``, ``visible`` and
            ``masks`` at frame i are of what the frame shows, the world d steps earlier; all else is of frame i.
    """

    actions: Int[np.ndarray, "t-1"] | Float[np.ndarray, "t-1 a"]
    pushed: Bool[np.ndarray, "t-1"]
    agent: ObjectStates
    objects: ObjectStates
    masks: UInt8[np.ndarray, "t h w"]
    factors: Mapping[str, Scalar] = field(default_factory=dict)


UNPLACED_AGENT = ObjectSpec(name="agent", shape="unknown", color=(0, 0, 0))
"""The agent where nothing says where it is: in imported recordings and in environments of the tier ``pixels``."""


def unplaced_labels(
    actions: Int[np.ndarray, "t-1"] | Float[np.ndarray, "t-1 a"],
    shape: tuple[int, ...],
    factors: Mapping[str, Scalar] | None = None,
) -> EpisodeLabels:
    """Labels with actions alone: no objects, an agent at an unknown place, and masks that show nothing.

    Args:
        actions: Of the episode.
        shape: Frames, rows and columns of its video.
        factors: Its factors of variation.
    """
    return EpisodeLabels(
        actions=actions,
        pushed=np.zeros(len(actions), bool),
        agent=nowhere(shape[0], 1),
        objects=nowhere(shape[0], 0),
        masks=np.zeros(shape, np.uint8),
        factors=factors or {},
    )


def nowhere(t: int, k: int) -> ObjectStates:
    """States of ``k`` things over ``t`` frames that say nothing."""
    return ObjectStates(
        position=np.full((t, k, 3), np.nan),
        orientation=np.full((t, k, 4), np.nan),
        pixel=np.full((t, k, 2), np.nan),
        visible=np.zeros((t, k)),
    )


@dataclass(frozen=True, kw_only=True)
class Episode:
    """One recorded episode: the video, its labels, and how it came about.

    Attributes:
        frames: RGB, 0-255.
        seed: Resetting the environment with it, and the recipe's ``vary`` as an option, and replaying
            ``labels.actions`` gives ``frames`` again.
        ended: ``"truncated"`` at the step limit, ``"terminated"`` by the environment (an object fell).
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    labels: EpisodeLabels
    seed: int
    ended: Literal["truncated", "terminated"]


@dataclass(frozen=True, kw_only=True)
class DatasetRecipe:
    """Everything that decides the bytes of a data set; the same recipe makes the same bytes.

    Attributes:
        environment: Registry name; ``IMPORTED`` for foreign recordings.
        parameters: Keyword arguments of the environment's constructor.
        policy: Name of the recording policy.
        seed: Episode i is seeded by ``episode_seed(seed, i)``.
        episodes: Target total.
        frames: At most so many frames an episode.
        tasks: Control tasks to store.
        shard_episodes: Episodes in a shard, the unit of work and of resuming.
        vary: Factors of variation drawn anew for each episode.
    """

    environment: str
    parameters: Mapping[str, Scalar] = field(default_factory=dict)
    policy: str = "random"
    seed: int = 0
    episodes: int
    frames: int
    tasks: int = 0
    shard_episodes: int = 50
    vary: tuple[str, ...] = ()

    @property
    def version(self) -> int:
        """The version of the environment: its parameter ``version``, 1 where the recipe names none."""
        version = self.parameters.get(VERSION, 1)
        return version if isinstance(version, int) else 1

    @property
    def splits_by_source(self) -> bool:
        """Whether the parts of one recording stay on one side of the split; else it is by episode."""
        return self.environment == IMPORTED and self.parameters.get(SPLIT) == SOURCE


def delay_of(factors: Mapping[str, Scalar]) -> int:
    """By how many steps the frames of an episode with these factors lag; a value that cannot be counts as none."""
    delay = factors.get(DELAY, 0)
    return delay if isinstance(delay, int) and delay > 0 else 0


def episode_seed(seed: int, episode: int) -> int:
    """The seed of one episode: independent of every other, and of how the work is divided."""
    return int(np.random.SeedSequence(seed, spawn_key=(episode,)).generate_state(1, np.uint64)[0] >> 1)
