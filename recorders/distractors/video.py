"""What the frames of an episode show: the factors together, in the order that the package's docstring tells.

What speaks of the picture (frame, masks, pixel centres, what is visible) is of the moment that the frame shows: it
moves with the camera and lags with the delay. What speaks of the world (positions, actions, what was pushed) is of
the present moment.
"""

from __future__ import annotations

import hashlib
import itertools
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, UInt8

from dmotion_bench.specs import EnvSpec, Scalar
from recorders.distractors.background import Backdrop, Textures, choice_of, chosen
from recorders.distractors.clips import Clip, load_clips
from recorders.distractors.movers import FAMILIES, Followers, Looks, Movers, mover_colors
from recorders.distractors.noise import Noise
from recorders.distractors.scenes import TEXTURE, Scene, strengths
from recorders.distractors.shake import Shake, cut_off, shifted
from recorders.distractors.streams import stream

STILL = (0, 0)


@dataclass(frozen=True, kw_only=True)
class Picture:
    """A frame, and what is seen where in it.

    Attributes:
        frame: RGB, 0-255.
        masks: 0 background, 1 the agent, 2 + k object k.
        pixel: Centres (x, y) of the agent and of the objects [px]; NaN for what is gone.
        visible: The share of each that nothing hides and that lies in the picture.
    """

    frame: UInt8[np.ndarray, "h w 3"]
    masks: UInt8[np.ndarray, "h w"]
    pixel: Float[np.ndarray, "k 2"]
    visible: Float[np.ndarray, " k"]


@dataclass(frozen=True, kw_only=True)
class VideoState:
    """What the next frames depend on beside what will be drawn.

    Attributes:
        moment: Steps since the episode's start.
        followers: Where the correlated things are.
        waiting: Pictures that are still to be shown, the first of them now.
    """

    moment: int
    followers: tuple[tuple[float, float], ...]
    waiting: tuple[Picture, ...]


class Video:
    """Turns what an environment draws into what its frames show, through one episode.

    Args:
        scene: Which generators and streams.
        values: The episode's values of the factors; those that are missing are 0.
        entropy: Of the episode.
        facts: Of the environment: the size of a frame, and the colours that no mover may have.
        surroundings: The colour that comes in at an edge when the camera shakes (RGB).
    """

    def __init__(
        self,
        scene: Scene,
        values: Mapping[str, Scalar],
        *,
        entropy: int,
        facts: EnvSpec,
        surroundings: tuple[int, int, int] = (0, 0, 0),
    ) -> None:
        strong, size = strengths(values), facts.height
        own = tuple(one.color for one in (facts.agent, *facts.objects, *facts.other_agents))
        looks = Looks(size=size, shapes=FAMILIES[scene.family], colors=mover_colors(own))

        def numbers(factor: str) -> np.random.Generator:
            return stream(entropy, factor, scene.family)

        self.delay, self._surroundings, self._things = (
            int(strong["delay"]),
            surroundings,
            len(facts.agents) + len(facts.objects),
        )
        self._background: Backdrop | None = None
        if strong["background"]:
            share = strong["background"]
            if scene.clips:
                self._background = Clip(numbers("background"), load_clips(scene.clips), share=share)
            else:
                self._background = Textures(numbers("background"), str(values[TEXTURE]), size=size, share=share)
        self._movers = Movers(numbers("movers"), int(strong["movers"]), looks) if strong["movers"] else None
        correlated = strong["correlated"]
        self._followers = Followers(numbers("correlated"), correlated, looks) if correlated else None
        self._shake = Shake(numbers("shake"), int(strong["shake"])) if strong["shake"] else None
        self._noise = Noise(numbers("noise"), strong["noise"]) if strong["noise"] else None
        self._moment, self._latest, self._waiting = 0, -1, list[Picture]()

    def begin(self, drawn: Picture) -> Picture:
        """The first frame."""
        self._moment, self._latest = 0, -1
        if self.delay:
            self._waiting = [self._composed(drawn)] * self.delay
        return self.show(drawn)

    def step(self, heading: Sequence[float], headings: Sequence[Sequence[float]] | None) -> None:
        """A step was taken; with a delay, ``show`` is to follow before the next.

        Args:
            heading: The direction (x, y) of the agent's action in the picture, of length 1; (0, 0) for none.
            headings: The directions that the environment's actions have; None where there is no end of them.
        """
        self._moment += 1
        if self._followers is not None:
            self._followers.step(self._moment, heading, headings)

    def show(self, drawn: Picture) -> Picture:
        """The frame of the present moment, as often as it is asked for."""
        shown = self._composed(drawn)
        if self.delay:
            if self._latest != self._moment:
                self._waiting = [*self._waiting[-self.delay :], shown]
            self._latest = self._moment
            shown = self._waiting[0]
        if self._noise is not None:
            shown = replace(shown, frame=self._noise.on(shown.frame, self._moment))
        return shown

    def motions(self, steps: int) -> dict[str, Float[np.ndarray, "s d"]]:
        """How far what no action moves does move from each frame to the next [px], as (x, y).

        ``camera``: the whole picture; ``background``: each plane of the texture in turn; ``movers``: their mean.
        """
        tracks: dict[str, Callable[[int, int], Float[np.ndarray, " d"]]] = {}
        if self._shake is not None:
            tracks["camera"] = self._shake.moved
        if isinstance(self._background, Textures):
            tracks["background"] = self._background.moved
        if self._movers is not None:
            tracks["movers"] = self._movers.moved
        shown = [max(0, moment - self.delay) for moment in range(steps + 1)]
        return {
            name: np.stack([moved(before, after) for before, after in itertools.pairwise(shown)])
            for name, moved in tracks.items()
        }

    @property
    def follows(self) -> bool:
        """Whether it needs to know where actions point."""
        return self._followers is not None

    def state(self) -> VideoState:
        """To be put back by ``restore``."""
        followers = () if self._followers is None else tuple(self._followers.places)
        return VideoState(moment=self._moment, followers=followers, waiting=tuple(self._waiting))

    def restore(self, state: VideoState) -> None:
        """Go on from there."""
        self._moment, self._waiting = state.moment, list(state.waiting)
        self._latest = state.moment if state.waiting else -1
        if self._followers is not None:
            self._followers.places = list(state.followers)

    def memory(self) -> bytes:
        """Equal for states with the same next frames, wherever agent and objects are."""
        state = self.state()
        parts = [repr((state.moment, state.followers)).encode(), *(one.frame.tobytes() for one in state.waiting)]
        return hashlib.blake2b(b"".join(parts), digest_size=16).digest()

    def _composed(self, drawn: Picture) -> Picture:
        """Without delay and noise."""
        shift = STILL if self._shake is None else self._shake.at(self._moment)
        if shift != STILL:
            drawn = self._moved(drawn, shift)
        if self._background is None and self._movers is None and self._followers is None:
            return drawn
        behind = drawn.frame
        behind = behind.copy() if self._background is None else self._background.lay(behind, self._moment, shift)
        if self._movers is not None:
            self._movers.lay(behind, self._moment, shift)
        if self._followers is not None:
            self._followers.lay(behind, shift)
        return replace(drawn, frame=before(drawn.frame, drawn.masks, behind))

    def _moved(self, drawn: Picture, shift: tuple[int, int]) -> Picture:
        kept = cut_off(drawn.masks, shift, self._things)
        return Picture(
            frame=shifted(drawn.frame, shift, self._surroundings),
            masks=shifted(drawn.masks, shift, 0),
            pixel=drawn.pixel + np.asarray(shift, np.float64),
            visible=drawn.visible if kept is None else drawn.visible * kept,
        )


def make_video(
    scene: Scene,
    values: Mapping[str, Scalar],
    *,
    entropy: int,
    facts: EnvSpec,
    surroundings: tuple[int, int, int] = (0, 0, 0),
) -> Video | None:
    """An episode's ``Video``; None where nothing distracts, so that what is drawn is what is shown."""
    if not any(strengths(values).values()):
        return None
    return Video(scene, values, entropy=entropy, facts=facts, surroundings=surroundings)


def before(
    frame: UInt8[np.ndarray, "h w 3"], masks: UInt8[np.ndarray, "h w"], behind: UInt8[np.ndarray, "h w 3"]
) -> UInt8[np.ndarray, "h w 3"]:
    """Agent and objects of a frame before another picture."""
    rows = len(frame), -1
    return chosen(choice_of(masks != 0), frame.reshape(rows), behind.reshape(rows)).reshape(frame.shape)
