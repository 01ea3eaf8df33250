"""How strong each factor may be, and the ready scenes: ``clean``, ``distracted``, ``unseen``.

A scene is a set of usual strengths and the generators of its backgrounds. What is given beside it goes before it, and
a factor that varies is drawn. ``unseen`` has the strengths of ``distracted`` with other textures, other shapes of
movers and other random streams, so that nothing but the states is shared by two data sets with the same seed.

No ready scene has ``delay``: with it, the action between two frames is another than the one that is labelled. None has
``noise``, which no codec without loss can compress: it makes a data set ten times as large (docs/decisions/068).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Any, Final, Literal, get_args

from dmotion_bench.errors import InvalidSetting, UnknownName
from dmotion_bench.specs import Scalar
from recorders.distractors.clips import load_clips, prepared_clips
from recorders.distractors.streams import stream
from recorders.distractors.textures import GENERATORS
from recorders.variation import Factor, Variation

SceneName = Literal["clean", "distracted", "unseen"]
TEXTURE: Final = "background/texture"
"""What an episode's values call the generator of its background."""

CLIPS: Final = "clips"
"""What stands there where it is a clip; also the parameter that names the clips."""

FACTORS: Final = (
    Factor(
        name="background",
        usual=0,
        low=0,
        high=0.8,
        shifted=((0.85, 1.0),),
        meaning="share of moving textures in what is seen behind agent and objects",
    ),
    Factor(
        name="movers",
        usual=0,
        low=0,
        high=4,
        shifted=((5, 8),),
        whole=True,
        meaning="number of things that move at random, behind agent and objects",
    ),
    Factor(
        name="correlated",
        usual=0,
        low=0,
        high=0.6,
        shifted=((0.7, 1.0),),
        meaning="probability that each of three more such things goes where the action points; 0: there are none",
    ),
    Factor(
        name="shake",
        usual=0,
        low=0,
        high=3,
        shifted=((4, 6),),
        whole=True,
        meaning="largest shift of the whole picture [px]",
    ),
    Factor(
        name="noise",
        usual=0,
        low=0,
        high=6,
        shifted=((8, 12),),
        meaning="standard deviation of the sensor's noise, of 255",
    ),
    Factor(
        name="delay",
        usual=0,
        low=0,
        high=2,
        shifted=((3, 4),),
        whole=True,
        meaning="steps by which a frame lags behind the world's state",
    ),
)
NAMES: Final = tuple(factor.name for factor in FACTORS)


@dataclass(frozen=True, kw_only=True)
class Scene:
    """What distracts in an environment.

    Attributes:
        strengths: Of factors that neither vary nor are given.
        textures: Generators that an episode's background is drawn from.
        family: Of random streams and of movers' shapes.
        clips: The hash of clips that are the background in place of textures (``clips.py``).
    """

    strengths: Mapping[str, float] = field(default_factory=dict)
    textures: tuple[str, ...] = ("leaves", "clouds")
    family: int = 0
    clips: str | None = None


_DISTRACTED: Final = MappingProxyType({"background": 0.7, "movers": 3, "correlated": 0.5, "shake": 2})
SCENES: Final[Mapping[str, Scene]] = MappingProxyType(
    {
        "clean": Scene(),
        "distracted": Scene(strengths=_DISTRACTED),
        "unseen": Scene(strengths=_DISTRACTED, textures=("waves", "cells"), family=1),
    }
)
assert tuple(SCENES) == get_args(SceneName), "the type lists the scenes"


def make_scene(name: str, textures: str | None, clips: str | None = None) -> Scene:
    """A ready scene, with other textures or with clips if some are given.

    Args:
        name: Of the scene.
        textures: Generators, separated by commas.
        clips: The hash of prepared clips; the background is as strong as in ``distracted`` if nobody says how strong.

    Raises:
        UnknownName: There is no such scene, or no such generator.
        InvalidSetting: No generator is named, both are given, or the clips are not here.
    """
    if name not in SCENES:
        raise UnknownName("scene", name, SCENES)
    scene = SCENES[name]
    if clips is not None:
        if textures is not None:
            raise InvalidSetting("a background is made of textures or of clips; leave out one of the two.")
        load_clips(clips)
        strong = {"background": _DISTRACTED["background"], **scene.strengths}
        return replace(scene, strengths=strong, textures=(CLIPS,), clips=clips)
    if textures is None:
        return scene
    named = tuple(one.strip() for one in textures.split(",") if one.strip())
    if not named:
        raise InvalidSetting(f"textures={textures!r} names none; known: {', '.join(GENERATORS)}.")
    for one in named:
        if one not in GENERATORS:
            raise UnknownName("generator of textures", one, GENERATORS)
    return replace(scene, textures=named)


def strengths(values: Mapping[str, Scalar]) -> dict[str, float]:
    """The strength of each factor by an episode's values."""
    return {name: float(values.get(name, 0.0)) for name in NAMES}


def episode_values(
    scene: Scene, variation: Variation, entropy: int, vary: Iterable[str], fixed: Mapping[str, Any]
) -> dict[str, Scalar]:
    """An episode's values of all factors, with the generator of its background where it has one.

    Args:
        scene: Gives the strengths of factors that neither vary nor are fixed.
        variation: All factors of the environment.
        entropy: Of the episode.
        vary: Factors that are drawn.
        fixed: Values that are given.

    Raises:
        UnknownName: There is no such factor, or no such generator.
        InvalidSetting: A value that its factor cannot take.
    """
    given, varying = dict(fixed), tuple(vary)
    kind = given.pop(TEXTURE, None)
    known = (CLIPS,) if scene.clips else tuple(GENERATORS)
    if kind is not None and kind not in known:
        raise UnknownName("generator of textures", str(kind), known)
    usual = {name: value for name, value in scene.strengths.items() if name not in varying}
    values = variation.values(entropy, varying, {**usual, **given})
    if values.get("background"):
        number = int(stream(entropy, TEXTURE, scene.family).integers(len(scene.textures)))
        values[TEXTURE] = kind or scene.textures[number]
    return values


def without_paths(parameters: Mapping[str, Scalar]) -> dict[str, Scalar]:
    """An environment's parameters with the hash of its clips in the place of their folder (``Prepared``).

    Raises:
        RecordingImportError: The clips cannot be read.
        InvalidSetting: None of them moves.
    """
    if CLIPS not in parameters:
        return dict(parameters)
    return {**parameters, CLIPS: prepared_clips(str(parameters[CLIPS]))}
