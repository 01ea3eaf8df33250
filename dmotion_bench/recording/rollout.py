"""Making episodes: an environment, a policy, a seed.

An episode's seed is all it depends on: the environment is reset with it, and the policy's random numbers come
from a stream of the same seed. Environments that are ``EpisodeGenerator`` make a whole shard at once.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from copy import copy
from functools import partial
from types import MappingProxyType
from typing import Final, Literal

import numpy as np
from jaxtyping import Bool, Float, Int, UInt8

from dmotion_bench.environment import (
    Action,
    Environment,
    EpisodeGenerator,
    MaskedEnvironment,
    ObjectEnvironment,
    Policy,
)
from dmotion_bench.errors import DmbenchError, InvalidSetting, RecordingFailed
from dmotion_bench.recording.failures import guarded, said
from dmotion_bench.recording.policies import find_policy
from dmotion_bench.specs import (
    MASK_FIRST_OBJECT,
    DatasetRecipe,
    EnvSpec,
    Episode,
    EpisodeLabels,
    ObjectStates,
    Scalar,
    episode_seed,
    unplaced_labels,
)
from dmotion_bench.wording import shown

_POLICY_STREAM: Final = 0x70F1  # sets the policy's random numbers apart from the environment's
_TELLING: Final = "what it tells of its state"
_STATE_WIDTHS: Final[Mapping[str, tuple[int, ...]]] = MappingProxyType(
    {"position": (3,), "orientation": (4,), "pixel": (2,), "visible": ()}
)
"""The axes of an ``ObjectStates`` behind that of the things."""


def policy_generator(seed: int) -> np.random.Generator:
    """The random numbers of an episode's policy."""
    return np.random.default_rng([seed, _POLICY_STREAM])


def make_environment(kind: type[Environment], recipe: DatasetRecipe) -> Environment:
    """An environment with the recipe's parameters.

    Raises:
        InvalidSetting: The class does not take them, or has no facts.
    """
    try:
        env = kind(**recipe.parameters)
    except (DmbenchError, MemoryError):
        raise
    except (Exception, SystemExit) as error:  # somebody else's constructor may raise anything
        raise InvalidSetting(f"{recipe.environment!r} cannot be made: {said(error)}.") from error
    if not isinstance(getattr(env, "facts", None), EnvSpec):
        raise InvalidSetting(f"{recipe.environment!r} has no 'facts'; set them to a dmotion_bench.specs.EnvSpec.")
    return env


def record_episodes(
    kind: type[Environment], recipe: DatasetRecipe, episodes: Sequence[int]
) -> Generator[Episode, None, None]:
    """The episodes of these numbers, in their order."""
    seeds = [episode_seed(recipe.seed, episode) for episode in episodes]
    make_policy = find_policy(kind, recipe)
    at_once: object = kind
    usual = not recipe.vary and recipe.policy in kind.policies and "generate" in vars(kind)
    if usual and isinstance(at_once, EpisodeGenerator):
        yield from at_once.generate(seeds, frames=recipe.frames, policy=recipe.policy, parameters=recipe.parameters)
        return
    env = make_environment(kind, recipe)
    try:
        for seed in seeds:
            yield record_episode(env, make_policy(), seed, recipe.frames, recipe.vary)
    finally:
        env.close()


def record_episode(env: Environment, policy: Policy, seed: int, frames: int, vary: Sequence[str] = ()) -> Episode:
    """One episode of at most so many frames, by stepping."""
    generator = policy_generator(seed)
    actions: list[Action] = []
    guard = partial(
        guarded,
        f"the environment {env.facts.id!r}",
        when=lambda: f"at step {len(actions)} of the episode with seed {seed}",
    )
    with guard("'reset'"):
        frame, info = env.reset(seed=seed, options={"vary": list(vary)} if vary else None)
    require_picture(env.facts, frame)
    factors = _factors(env.facts, info)
    with guard(_TELLING):
        images, witness = _Film(frame), _Witness(env)
    ended: Literal["truncated", "terminated"] = "truncated"
    while len(actions) < frames - 1:
        action = policy(env, generator)
        taken = copy(action)  # a policy may return the same array again, and a step may write into it
        with guard("'step'"):
            frame, _, over, late, _ = env.step(action)
            terminated, truncated = bool(over), bool(late)
        require_picture(env.facts, frame)
        actions.append(taken)
        images.append(frame)
        with guard(_TELLING):
            witness.look()
        if terminated:
            ended = "terminated"
        if terminated or truncated:
            break
    film = images.developed()
    labels = witness.labels(_recorded(env.facts, actions), film.shape[:3], factors)
    return Episode(frames=film, labels=labels, seed=seed, ended=ended)


def require_picture(facts: EnvSpec, picture: object) -> None:
    """Check that what an environment draws is what its facts say.

    Raises:
        RecordingFailed: It is something else.
    """
    wanted = (facts.height, facts.width, 3)
    if isinstance(picture, np.ndarray) and picture.dtype == np.uint8 and picture.shape == wanted:
        return
    drawn = f"{picture.dtype} of {picture.shape}" if isinstance(picture, np.ndarray) else type(picture).__name__
    raise RecordingFailed(
        f"the environment {facts.id!r} draws {drawn}; by its facts a picture is a uint8 array of {wanted}."
    )


def _factors(facts: EnvSpec, info: object) -> dict[str, Scalar]:
    """An episode's factors of variation, out of what ``reset`` tells beside the frame.

    Raises:
        RecordingFailed: It is no dictionary, or a factor is neither a number nor a text, or has a name that is none.
    """
    told = info.get("factors", {}) if isinstance(info, Mapping) else info
    if not isinstance(told, Mapping):
        raise RecordingFailed(
            f"the environment {facts.id!r} tells {shown(told)} in 'reset' beside the frame; that and its 'factors' are "
            "to be dictionaries."
        )
    factors = {name: _plain(value) for name, value in told.items()}
    for name, value in factors.items():
        if not isinstance(name, str):
            raise RecordingFailed(
                f"the environment {facts.id!r} tells a factor of the name {shown(name)}; a name is to be a text."
            )
        if not isinstance(value, Scalar):
            raise RecordingFailed(
                f"the environment {facts.id!r} tells a {type(value).__name__} as its factor {shown(name)}; it is to be "
                "a number, a text or a truth value."
            )
    return factors


class _Witness:
    """Collects what an environment tells beside its frames: nothing, positions, or positions and masks."""

    def __init__(self, env: Environment) -> None:
        self._facts = env.facts
        self._located = env if isinstance(env, ObjectEnvironment) else None
        self._masked = env if isinstance(env, MaskedEnvironment) else None
        self._threshold = env.facts.push_threshold
        self._highest = max(MASK_FIRST_OBJECT + len(env.facts.objects) - 1, *env.facts.agent_masks)
        self._agents, self._objects = list[ObjectStates](), list[ObjectStates]()
        self._note_states()
        self._masks = _Film(self._mask(self._masked)) if self._masked else None

    def look(self) -> None:
        """Ask about the present state."""
        self._note_states()
        if self._masked is not None and self._masks is not None:
            self._masks.append(self._mask(self._masked))

    def _note_states(self) -> None:
        if self._located is not None:
            self._agents.append(_told(self._facts, "agents", self._located.agent(), len(self._facts.agents)))
            self._objects.append(_told(self._facts, "objects", self._located.objects(), len(self._facts.objects)))

    def _mask(self, env: MaskedEnvironment) -> UInt8[np.ndarray, "h w"]:
        """The present masks, which hold no other values than the facts have meanings for."""
        mask, facts = np.asarray(env.masks()), self._facts
        if mask.dtype.kind not in "bui" or mask.shape != (facts.height, facts.width):
            raise RecordingFailed(
                f"the environment {facts.id!r} tells masks that are {mask.dtype} of {mask.shape}; by its facts they "
                f"are a uint8 array of {(facts.height, facts.width)}."
            )
        if mask.max(initial=0) > self._highest or (mask.dtype.kind == "i" and mask.min(initial=0) < 0):
            raise RecordingFailed(
                f"the environment {facts.id!r} tells masks with values from {mask.min()} to {mask.max()}; by its facts "
                f"they are 0 to {self._highest}: background, agent, then its objects."
            )
        return mask.astype(np.uint8, copy=False)  # the film copies it

    def labels(
        self,
        actions: Int[np.ndarray, " s"] | Float[np.ndarray, "s a"],
        shape: tuple[int, ...],
        factors: Mapping[str, Scalar],
    ) -> EpisodeLabels:
        """All of it, with the actions, of a video of this shape."""
        if self._located is None:
            return unplaced_labels(actions, shape, factors)
        states = _stacked(self._objects)
        return EpisodeLabels(
            actions=actions,
            pushed=_pushed(states, self._threshold),
            agent=_stacked(self._agents),
            objects=states,
            masks=np.zeros(shape, np.uint8) if self._masks is None else self._masks.developed(),
            factors=factors,
        )


def _told(facts: EnvSpec, what: str, states: object, count: int) -> ObjectStates:
    """A copy of the states of one moment: an environment may write the next ones into the same arrays.

    Raises:
        RecordingFailed: They are not those of so many things.
    """
    if not isinstance(states, ObjectStates):
        raise RecordingFailed(
            f"the environment {facts.id!r} tells a {type(states).__name__} as the states of its {what}; it is to be a "
            "dmotion_bench.specs.ObjectStates."
        )
    copied = {name: np.array(getattr(states, name)) for name in _STATE_WIDTHS}
    for name, width in _STATE_WIDTHS.items():
        if copied[name].dtype.kind not in "fiub":
            raise RecordingFailed(
                f"the environment {facts.id!r} tells {name!r} of its {what} as an array of {copied[name].dtype}; it is "
                "to be one of numbers."
            )
        found, wanted = copied[name].shape, (count, *width)
        if found[1:] == width and len(found) == len(wanted) and found != wanted:
            raise RecordingFailed(
                f"the environment {facts.id!r} tells where {found[0]} {what} are; its facts name {count}."
            )
        if found != wanted:
            raise RecordingFailed(
                f"the environment {facts.id!r} tells {name!r} of its {what} as an array of {found}; it is to be one "
                f"of {wanted}."
            )
    return ObjectStates(**copied)


def _recorded(facts: EnvSpec, actions: Sequence[Action]) -> Int[np.ndarray, " s"] | Float[np.ndarray, "s a"]:
    """The actions of an episode, as its labels hold them.

    Raises:
        InvalidSetting: The environment names none, or one of them cannot be.
    """
    if facts.actions is None:
        raise InvalidSetting(f"the environment {facts.id!r} does not say what can be done in it.")
    taken = np.array(actions, facts.actions.dtype).reshape(len(actions), *facts.actions.shape)
    if fault := facts.actions.fault(taken):
        raise InvalidSetting(f"the policy of {facts.id!r} took {fault}; mend the policy.")
    return taken


class _Film:
    """A growing array of frames: it doubles when it is full, and copies each frame while it is in the cache."""

    def __init__(self, first: UInt8[np.ndarray, "h w *c"]) -> None:
        self._pictures, self._count = np.empty((64, *first.shape), np.uint8), 0
        self.append(first)

    def append(self, picture: UInt8[np.ndarray, "h w *c"]) -> None:
        if self._count == len(self._pictures):
            self._pictures = np.concatenate([self._pictures, np.empty_like(self._pictures)])
        self._pictures[self._count] = picture
        self._count += 1

    def developed(self) -> UInt8[np.ndarray, "t h w *c"]:
        return self._pictures[: self._count]


def _stacked(states: Sequence[ObjectStates]) -> ObjectStates:
    return ObjectStates(**{name: np.stack([getattr(one, name) for one in states]) for name in _STATE_WIDTHS})


def _pushed(objects: ObjectStates, threshold: float) -> Bool[np.ndarray, "t-1"]:
    """Whether an object moved in each step; one that vanished has moved."""
    there = ~np.isnan(objects.position[..., 0])
    moved = np.linalg.norm(np.diff(objects.position, axis=0), axis=-1) > threshold
    pushed: Bool[np.ndarray, "t-1"] = ((moved & there[1:]) | (there[:-1] & ~there[1:])).any(axis=-1)
    return pushed


def _plain(value: Scalar | np.generic) -> Scalar:
    plain: Scalar = value.item() if isinstance(value, np.generic) else value
    return plain
