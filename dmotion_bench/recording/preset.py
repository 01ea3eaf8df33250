"""Turn a user's request into a recipe: environment, size, parameters and varying factors."""

from __future__ import annotations

import inspect
import typing
from collections.abc import Mapping, Sequence
from typing import Any, Final

from dmotion_bench.environment import Environment, Parametrised, Prepared, Versioned
from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.recording.session import SHARD_EPISODES
from dmotion_bench.registry import environment_class
from dmotion_bench.specs import VERSION, DatasetRecipe, Preset, Scalar
from dmotion_bench.values import parse_value
from dmotion_bench.wording import shown

RANGES: Final = "ranges"  # the parameter of an environment that says what varying factors are drawn from
USUAL_RANGES: Final = "in-distribution"
_OPTIONS: Final = {"vary": "--vary", RANGES: "--ranges"}  # parameters with an option of their own
FRAME_SIZE: Final = "frame_size"  # parameters of environments that draw in any size, or repeat actions
ACTION_REPEAT: Final = "action_repeat"
_NOT_RECORDED: Final = "render_mode"


def recipe_for(
    environment: str,
    preset: Preset = Preset.SMALL,
    *,
    episodes: int | None = None,
    frames: int | None = None,
    tasks: int | None = None,
    seed: int = 0,
    vary: Sequence[str] = (),
    ranges: str = USUAL_RANGES,
    policy: str | None = None,
    settings: Sequence[str] = (),
    size: int | None = None,
    frame_skip: int | None = None,
) -> DatasetRecipe:
    """The recipe of a preset, with what is given instead of the preset's numbers.

    Args:
        environment, preset: What and how much.
        episodes, frames, tasks: Instead of the preset's.
        seed: Decides every episode.
        vary: Factors of variation, drawn anew for each episode.
        ranges: What they are drawn from; another than the usual is a parameter of the environment.
        policy: Chooses the actions; None: the environment's usual one.
        settings: ``KEY=VALUE`` for parameters of the environment's constructor.
        size: Side of the frames [px], of environments that draw in any size.
        frame_skip: How often an action is taken between two frames, of environments that can repeat one.

    Raises:
        UnknownName: There is no such environment, or it has no such preset or parameter.
        InvalidSetting: A parameter cannot have this value.
    """
    kind = environment_class(environment)
    if not (policy is None or isinstance(policy, str)):
        raise InvalidSetting(
            f"policy is {shown(policy)}; name it as 'MODULE:FUNCTION', so that others can record again."
        )
    if preset not in kind.recording:
        raise UnknownName(f"preset of {environment}", preset.value, [known.value for known in kind.recording])
    usual = kind.recording[preset]
    parameters = _with_version(kind, _prepared(kind, parse_parameters(environment, kind, settings)))
    for key, option, given in ((FRAME_SIZE, "--size", size), (ACTION_REPEAT, "--frame-skip", frame_skip)):
        if given is not None:
            if key not in _parameters(kind)[0]:
                raise InvalidSetting(f"{environment} has no setting {key!r}; leave out '{option}'.")
            parameters[key] = given
    if issubclass(kind, Parametrised):
        parameters = kind.completed(parameters)
    varying = tuple(sorted({name.strip() for name in vary} - {""}))
    for name in varying:
        if name in parameters:
            raise InvalidSetting(
                f"{name} has one value by '--set' and cannot vary; leave out the setting, or {name} in '--vary'."
            )
    if ranges != USUAL_RANGES:
        if not varying:
            raise InvalidSetting(f"--ranges {ranges} is for factors that vary, and none does; name some with '--vary'.")
        if RANGES not in _parameters(kind)[0]:
            raise InvalidSetting(f"{environment} has no other ranges to choose from; leave out '--ranges'.")
        parameters[RANGES] = ranges
    return DatasetRecipe(
        environment=environment,
        parameters=parameters,
        policy=kind.default_policy if policy is None else policy,
        seed=seed,
        episodes=usual.episodes if episodes is None else episodes,
        frames=usual.frames if frames is None else frames,
        tasks=usual.tasks if tasks is None else tasks,
        shard_episodes=SHARD_EPISODES,
        vary=varying,
    )


def _prepared(kind: type[Environment], parameters: dict[str, Scalar]) -> dict[str, Scalar]:
    """The parameters without paths, where the environment takes any."""
    prepared: object = kind
    return dict(prepared.prepared(parameters)) if isinstance(prepared, Prepared) else parameters


def _with_version(kind: type[Environment], parameters: dict[str, Scalar]) -> dict[str, Scalar]:
    """The parameters with the version that is recorded; the first is not named, as in recipes from before versions."""
    versioned: object = kind
    if not isinstance(versioned, Versioned):
        return parameters
    version = parameters.pop(VERSION, max(versioned.versions))
    return dict(sorted(({**parameters, VERSION: version} if version != 1 else parameters).items()))


def parse_parameters(environment: str, kind: type[Environment], settings: Sequence[str]) -> dict[str, Scalar]:
    """Keyword arguments of the environment's constructor, out of ``KEY=VALUE``.

    Raises:
        UnknownName: It takes none of this name.
        InvalidSetting: The value is not of its type.
    """
    known, more = _parameters(kind)
    found: dict[str, Scalar] = {}
    for setting in settings:
        key, equals, text = setting.partition("=")
        if not equals:
            raise InvalidSetting(f"--set {setting!r} has no value; write --set {key}=VALUE.")
        if key in _OPTIONS and key in known:
            raise InvalidSetting(f"{key} is no setting; say '{_OPTIONS[key]} {text}'.")
        names = [name for name in known if name not in _OPTIONS]
        if key not in names and (not more or key == _NOT_RECORDED):
            raise UnknownName(f"setting of {environment}", key, names)
        value = parse_value(key, text, known.get(key, Any))
        if value is not None:  # none is what leaving it out means
            found[key] = value
    return dict(sorted(found.items()))


def _parameters(kind: type[Environment]) -> tuple[Mapping[str, Any], bool]:
    """The constructor's keyword arguments and their types, and whether it takes others, too."""
    if issubclass(kind, Parametrised):
        return kind.parameters()
    try:
        hints = typing.get_type_hints(kind.__init__)
    except NameError:  # types that only a checker imports
        hints = {}
    names = list(inspect.signature(kind).parameters)
    return {name: hints.get(name, str) for name in names if name != _NOT_RECORDED}, False
