"""The interface that recording and control need of an environment, beyond Gymnasium.

An environment is a ``gymnasium.Env`` (passing ``check_env``) that also answers the questions below. It is named by an
entry point of the group ``dmbench.environments`` whose value is the class; the class is built with the recipe's
parameters as keyword arguments. A family of environments, such as ``gym:ID``, is named by an entry point of the group
``dmbench.environment_families``.

What an environment can tell is its tier, and decides which figures it gets:

=========  =======================  ==================================================================================
tier       protocol                 figures
=========  =======================  ==================================================================================
pixels     ``Environment``          predictions, rollouts, probes; control by pixels or features
objects    ``ObjectEnvironment``    position errors, the objective ``centres``, control judged by distances of objects
masks      ``MaskedEnvironment``    where the agent is
=========  =======================  ==================================================================================

Exactness: ``reset(seed=s)`` followed by a sequence of actions gives the same frames and the same states in
every process. That is the only way in which a state is stored or restored.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any, ClassVar, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Bool, Float, UInt8

from dmotion_bench.specs import EnvSpec, Episode, ObjectStates, Preset, Scalar

Action = int | Float[np.ndarray, " a"]
"""The number of a discrete action, or a continuous one in its units."""


@dataclass(frozen=True, kw_only=True)
class RecordingPreset:
    """The size of a recording at a preset.

    Attributes:
        episodes: Number of episodes.
        frames: At most so many frames an episode.
        tasks: Control tasks stored with the data set.
    """

    episodes: int
    frames: int
    tasks: int


class Tier(StrEnum):
    """What an environment can tell; each tier tells what those before it tell, too."""

    PIXELS = "pixels"
    OBJECTS = "objects"
    MASKS = "masks"


@runtime_checkable
class Environment(Protocol):
    """A ``gymnasium.Env`` that can be recorded and controlled: frames and actions, the tier ``pixels``."""

    facts: EnvSpec
    recording: ClassVar[Mapping[Preset, RecordingPreset]]
    policies: ClassVar[Mapping[str, Callable[[], Policy]]]  # made anew for each episode, so they may remember
    default_policy: ClassVar[str]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Start an episode; ``options`` may fix factors of variation."""

    def step(self, action: Any) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Take one ``Action``; an impossible one changes nothing and ``info["illegal"]`` says so."""

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """Which discrete actions are possible in the present state; continuous ones are not asked about."""

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""

    def close(self) -> None:
        """Free the simulator."""


@runtime_checkable
class ObjectEnvironment(Environment, Protocol):
    """An environment that also knows where things are: the tier ``objects``."""

    def agent(self) -> ObjectStates:
        """The states of ``facts.agents``: k = 1 where there is one."""

    def objects(self) -> ObjectStates:
        """The objects' states, in the order of ``facts.objects``."""


@runtime_checkable
class MaskedEnvironment(ObjectEnvironment, Protocol):
    """An environment that also knows what each pixel shows: the tier ``masks``."""

    def masks(self) -> UInt8[np.ndarray, "h w"]:
        """What each pixel shows: 0 background, 1 agent, 2 + k object k, then other agents (``facts.agent_masks``)."""


def tier_of(kind: type[Environment] | Environment) -> Tier:
    """The tier of an environment or of its class, by the methods that it has."""
    if not (hasattr(kind, "agent") and hasattr(kind, "objects")):
        return Tier.PIXELS
    return Tier.MASKS if hasattr(kind, "masks") else Tier.OBJECTS


@runtime_checkable
class EnvironmentFamily(Protocol):
    """Environments that are made by name: ``gym:ID`` is the member ``ID`` of the family ``gym``.

    Attributes:
        tier: Of every member.
        recording: Sizes of a recording, the same for every member.
        policies: That record every member, the default first.
    """

    tier: Tier
    recording: Mapping[Preset, RecordingPreset]
    policies: Sequence[str]

    def member(self, name: str) -> type[Environment]:
        """The class of a member.

        Raises:
            UnknownName: There is no such member.
            PackageNotInstalled: It needs a package that is absent.
        """

    def worlds(self) -> Mapping[str, str]:
        """Members that are known to work, by name, each with what it is in a line; nothing is imported for this."""


@runtime_checkable
class Parametrised(Protocol):
    """An environment class whose parameters the signature of its constructor does not tell."""

    @classmethod
    def parameters(cls) -> tuple[Mapping[str, Any], bool]:
        """The parameters' names and types, and whether others are taken, too."""

    @classmethod
    def completed(cls, parameters: Mapping[str, Scalar]) -> dict[str, Scalar]:
        """What stands in the recipe: the parameters, and those that would otherwise be decided by another package."""


@runtime_checkable
class Unproven(Protocol):
    """An environment class that says whether its episodes may not repeat.

    If so, a recording takes a sample of them again and compares. Classes of other packages that do not say so are
    taken for unproven ones.
    """

    unproven: ClassVar[bool]


@runtime_checkable
class Packaged(Protocol):
    """An environment class whose frames depend on packages that ``dataset.json`` is to give the versions of."""

    packages: ClassVar[tuple[str, ...]]


@runtime_checkable
class Varied(Protocol):
    """An environment class with factors that can vary between episodes (``dmbench record --vary``)."""

    factors: ClassVar[Mapping[str, str]]
    """Factors of variation by their names, each with what it is and what it is drawn from, in a line.

    A factor with the name ``specs.DELAY`` is the number of steps by which frames lag behind the world.
    """


@runtime_checkable
class Distracting(Protocol):
    """An environment that tells how what distracts in its video moves, which its actions have no part in.

    Asked by the probes that tell whether a latent action holds it (``scoring/true_factors.py``).
    """

    def distracting_motions(self, seed: int, vary: Sequence[str], steps: int) -> Mapping[str, Float[np.ndarray, "s d"]]:
        """How far each moves from frame i to frame i + 1 of the episode of ``seed`` [px].

        Names are ``camera``, ``background`` and ``movers``; those that there are not in the episode are left out. The
        present episode stays as it is.
        """


@runtime_checkable
class Prepared(Protocol):
    """An environment class with parameters that name files, which a recipe may not: it holds their hash instead."""

    @classmethod
    def prepared(cls, parameters: Mapping[str, Scalar]) -> Mapping[str, Scalar]:
        """Constructor arguments as somebody typed them, with a hash of what was found in the place of each path."""


@runtime_checkable
class Versioned(Protocol):
    """An environment class whose frames or rules have changed: its constructor takes ``version``, 1 by default.

    So a recipe that names no version makes what it made before there were versions, byte for byte.
    """

    versions: ClassVar[Mapping[int, str]]
    """What is true of each version, in a line, from 1 on; the last is recorded if nobody asks for another."""


@runtime_checkable
class HasTestTasks(Protocol):
    """An environment class with test tasks of the table of control (docs/protocol.md), on which nothing is chosen."""

    test_tasks: ClassVar[Mapping[int, Mapping[str, str]]]
    """The hashes of each version's test tasks (``planning.columns.tasks_hash``), by the settings of their recording.

    Settings are ``KEY=VALUE`` as for ``--set``, several separated by spaces; ``""`` are the usual ones. A data set with
    the seed of the test and other tasks is refused.
    """


@runtime_checkable
class Titled(Protocol):
    """An environment class that pages call by a title of its own, not by its registered name in words.

    ``push_t`` would be "Push T".
    """

    title: ClassVar[str]


@runtime_checkable
class Restorable(Protocol):
    """An environment whose state can be put back much faster than by replaying its actions.

    Offered to whoever tries things out, such as the oracle; what is recorded or judged is always replayed.
    Continuing from a restored state should do what continuing from the original does, as nearly as the simulator can.
    """

    def snapshot(self) -> Any:
        """The present state; fit for every environment with the same parameters that was reset with the same seed."""

    def restore(self, snapshot: Any) -> None:
        """Return to this state, so that ``agent``, ``objects`` and the next ``step`` are as they were there.

        ``pixel`` and ``visible`` may be of what was drawn last, until ``render`` or ``step`` draws again.
        """


@runtime_checkable
class Settled(Protocol):
    """An environment class that says whether all is at rest between two actions.

    If so, where agent and objects are and how they are turned decides where every further action takes them. The oracle
    then takes states of the same poses for one, and tries nothing twice. Say so only where nothing else decides: no
    velocity, no closed gripper, nothing that is hidden. Otherwise states are told apart by what led there.
    """

    settled: ClassVar[bool]


@runtime_checkable
class Remembering(Protocol):
    """An environment whose next frames depend on more than where agent and objects are, such as on earlier frames.

    Asked only where frames are kept: states with the same places and the same memory have the same next frames.
    """

    def memory(self) -> bytes:
        """A name of all else that decides the next frames; equal where they are."""


@runtime_checkable
class Undrawn(Protocol):
    """An environment that can take an action without drawing, which the oracle does thousands of times a step."""

    def advance(self, action: Action) -> bool:
        """Do what ``step`` does to the state; whether the action was impossible. The next ``step`` draws again."""


@runtime_checkable
class TaskMeasure(Protocol):
    """How far an environment is from a control task's goal."""

    def distance(self, env: Environment) -> float:
        """The judged distance, a finite number: 1 at the start, 0 at the goal."""

    def lost(self, env: Environment) -> int:
        """How many things that the goal needs are lost for good."""

    def cost(self, env: Environment) -> float:
        """What the oracle minimises: lower is nearer; zero at the goal."""


@runtime_checkable
class Judging(Protocol):
    """An environment whose tasks have a distance of their own, such as how far a drawer is open.

    Others are judged by how far the objects are from their places at the goal.
    """

    def task_measure(self, start: ObjectStates, goal: ObjectStates) -> TaskMeasure:
        """The measure of a task by its objects' states at the start and at the goal."""


@runtime_checkable
class SetsGoal(Protocol):
    """An environment that may set the goal of its control tasks itself, such as a place that is marked in it.

    The goal of others is what was recorded some frames after a task's start.
    """

    def task_goal(self) -> tuple[UInt8[np.ndarray, "h w 3"], ObjectStates] | None:
        """The picture and the objects' states at the goal of the present episode; None for the recorded ones."""


@runtime_checkable
class Script(Protocol):
    """Solves one control task by rules that read the simulator: the reference ``scripted``."""

    def watch(self, env: Environment) -> None:
        """Called at the task's start and after every step."""

    def act(self, env: Environment, goal: ObjectStates) -> Action | None:
        """The next action towards the objects' states at the goal; None for none."""


@runtime_checkable
class HasScript(Protocol):
    """An environment that comes with rules for its tasks."""

    def script(self) -> Script:
        """Made anew for each task, so it may remember."""


@runtime_checkable
class HasObjective(Protocol):
    """An environment class that names the objective that suits what its camera shows.

    Control plans with it if nobody names another; without it, with the paper's, ``centres``.
    """

    objective: ClassVar[str]


@runtime_checkable
class Policy(Protocol):
    """Chooses the actions of a recording."""

    def __call__(self, env: Environment, generator: np.random.Generator) -> Action:
        """The action to take in ``env``'s present state, a legal one."""


@runtime_checkable
class EpisodeGenerator(Protocol):
    """An environment class that makes many episodes at once, faster than step by step.

    What it yields must equal what resetting and stepping the environment with the same seeds gives. A class that
    inherits ``generate`` may step in another way, so it is not used there; define it anew if it holds.
    """

    @classmethod
    def generate(
        cls, seeds: Sequence[int], *, frames: int, policy: str, parameters: Mapping[str, Any]
    ) -> Iterator[Episode]:
        """The episodes of ``seeds``, in their order."""
