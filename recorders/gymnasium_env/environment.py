"""A Gymnasium environment as an environment of dmbench, of the tier ``pixels``.

A frame is what the environment draws in the render mode ``rgb_array``, averaged over areas to a square. An action is
taken ``action_repeat`` times. An episode that the environment has terminated stays as it is: further actions change
nothing. A time limit ends a recorded episode, and nothing else: a control task may go on beyond it. An environment that
begins anew by itself where an episode ends would show the next one as what an action led to; it is refused there.

Somebody else's simulator may raise anything at any time; what it raises becomes a sentence (``RecordingFailed``).
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterator, Mapping
from functools import partial
from numbers import Real
from types import MappingProxyType
from typing import Any, ClassVar, Final

import gymnasium
import numpy as np
from jaxtyping import Bool, UInt8

from dmotion_bench.actions import Discrete
from dmotion_bench.environment import Policy, RecordingPreset
from dmotion_bench.errors import DmbenchError, InvalidSetting, RecordingFailed
from dmotion_bench.recording.failures import failed
from dmotion_bench.specs import UNPLACED_AGENT, EnvSpec, Preset, Scalar
from dmotion_bench.storage.imports.fitting import area_mean
from dmotion_bench.wording import shown
from recorders.gymnasium_env.guest import missing_package, quiet, unmade
from recorders.gymnasium_env.legacy_randomness import LegacyRandomness
from recorders.gymnasium_env.modules import import_named
from recorders.gymnasium_env.resets import Resets, is_first
from recorders.gymnasium_env.spaces import action_spec, for_simulator
from recorders.gymnasium_env.worlds import PACKAGES
from recorders.policies import RandomPolicy, StickyPolicy

RENDER_MODE: Final = "rgb_array"
_SEEDS: Final = 2**31  # what every simulator takes: some keep a seed in 32 bits
_SIZES: Final = range(16, 1025)  # [px]
_USUAL_FPS: Final = 10.0
_MOST_FPS: Final = 1e6


class GymnasiumEnvironment(gymnasium.Env[UInt8[np.ndarray, "h w 3"], Any]):
    """An environment that Gymnasium makes by its id.

    Args:
        frame_size: Side of the frames [px].
        action_repeat: How often an action is taken between two frames.
        max_episode_steps: The simulator's steps after which an episode is cut off; None for what its id says.
        wrappers: ``MODULE:CLASS``, separated by commas: applied in this order to what ``gymnasium.make`` gives.
        fresh: Whether each episode has a simulator of its own. Some remember: MuJoCo's camera looks at where things
            were when it drew first, so the same seed gives other pictures in a simulator that was used before.
        render_mode: Gymnasium's; frames are always drawn in ``rgb_array``.
        settings: Keyword arguments of ``gymnasium.make``.

    Raises:
        InvalidSetting: It draws no pictures, has actions that cannot be recorded, or does not take the settings.
        PackageNotInstalled: It needs a package that is absent.
    """

    id: ClassVar[str]
    """Of the member, which is a subclass of its own (``family.py``): what follows ``gym:``."""

    registered: ClassVar[str]
    """The id without the module that registers it."""

    metadata: dict[str, Any] = {"render_modes": [RENDER_MODE]}  # noqa: RUF012 -- as in Gymnasium
    recording: ClassVar[Mapping[Preset, RecordingPreset]] = MappingProxyType(
        {
            Preset.TINY: RecordingPreset(episodes=12, frames=12, tasks=4),
            Preset.SMALL: RecordingPreset(episodes=200, frames=60, tasks=100),
            Preset.PAPER: RecordingPreset(episodes=1000, frames=100, tasks=100),
        }
    )
    policies: ClassVar[Mapping[str, Callable[[], Policy]]] = MappingProxyType(
        {"random": RandomPolicy, "sticky": StickyPolicy}
    )
    default_policy: ClassVar[str] = "random"
    objective: ClassVar[str] = "pixel"
    unproven: ClassVar[bool] = True
    packages: ClassVar[tuple[str, ...]] = PACKAGES

    def __init__(
        self,
        *,
        frame_size: int = 128,
        action_repeat: int = 1,
        max_episode_steps: int | None = None,
        wrappers: str = "",
        fresh: bool = True,
        render_mode: str | None = None,
        **settings: Scalar,
    ) -> None:
        if frame_size not in _SIZES:
            raise InvalidSetting(
                f"frame_size is {frame_size}; it can be {_SIZES[0]} to {_SIZES[-1]} pixels: '--size 128'."
            )
        if action_repeat < 1:
            raise InvalidSetting(
                f"action_repeat is {action_repeat}; an action is taken once or more: '--frame-skip 1'."
            )
        if max_episode_steps is not None and max_episode_steps < 1:
            raise InvalidSetting(f"max_episode_steps is {max_episode_steps}; an episode has 1 step or more.")
        self.name, self.render_mode = f"gym:{self.id}", render_mode
        self._size, self._repeat = frame_size, action_repeat
        self._legacy = LegacyRandomness()
        self._make = partial(self._made, max_episode_steps, wrappers, settings)
        self._inner, self._resets = self._make()
        self._fresh, self._used = fresh, False
        try:
            self._require_pictures()
            with quiet():
                actions = action_spec(self.name, self._inner)
        except BaseException:
            self.close()
            raise
        fps = self._inner.metadata.get("render_fps")
        fps = float(fps) if isinstance(fps, Real) else 0.0
        fps = fps if 0 < fps <= _MOST_FPS else _USUAL_FPS
        self.facts = EnvSpec(
            id=self.name,
            actions=actions,
            agent=UNPLACED_AGENT,
            objects=(),
            height=frame_size,
            width=frame_size,
            step_ns=round(1e9 * action_repeat / fps),
        )
        self.action_space = actions.space()
        self.observation_space = gymnasium.spaces.Box(0, 255, (frame_size, frame_size, 3), np.uint8)
        self._seed, self._steps, self._over = 0, 0, False
        self._drawn: tuple[int, ...] | None = None  # the shape of the pictures
        self._frame: UInt8[np.ndarray, "h w 3"] = np.zeros((frame_size, frame_size, 3), np.uint8)

    def _made(
        self, max_episode_steps: int | None, wrappers: str, settings: Mapping[str, Scalar]
    ) -> tuple[gymnasium.Env[Any, Any], Resets]:
        for key, value in settings.items():
            if isinstance(value, str) and (value.startswith(("~", ".")) or "/" in value or "\\" in value):
                raise InvalidSetting(
                    f"{key} is {shown(value)}, which could name a file, and the recipe of a data set names none; "
                    "register an environment of your own with it."
                )
        self._legacy.begin(0)
        kinds = [self._wrapper(name.strip()) for name in wrappers.split(",") if name.strip()]
        try:
            with quiet(), self._legacy.lent():
                made = gymnasium.make(
                    self.registered,
                    max_episode_steps=max_episode_steps,
                    disable_env_checker=True,
                    render_mode=RENDER_MODE,
                    **settings,
                )
                resets = Resets(made.unwrapped)
                for kind in kinds:
                    made = kind(made)
                return made, resets
        except Exception as error:  # somebody else's constructor may raise anything
            raise unmade(self.name, error) from error

    def _wrapper(self, name: str) -> Callable[[Any], Any]:
        """The class of a wrapper that is made with the environment alone."""
        module, colon, attribute = name.partition(":")
        kind: Any = getattr(import_named(module, self.name), attribute, None) if colon else None
        if not (isinstance(kind, type) and issubclass(kind, gymnasium.Wrapper)):
            raise InvalidSetting(
                f"wrappers names {shown(name)}, which is no wrapper; write MODULE:CLASS, such as "
                "'minigrid.wrappers:ReseedWrapper'."
            )
        return kind

    def _require_pictures(self) -> None:
        """See that pictures can be drawn, as far as it is said; the first one shows where nothing is said (OGBench)."""
        modes = self._inner.metadata.get("render_modes") or []
        if modes and RENDER_MODE not in modes:
            raise InvalidSetting(
                f"{self.name!r} has no render mode {RENDER_MODE!r}, so it cannot be recorded; it has "
                f"{', '.join(map(repr, modes))}."
            )

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[UInt8[np.ndarray, "h w 3"], dict[str, Any]]:
        """Start an episode; nothing varies but by the seed."""
        super().reset(seed=seed)
        self._steps, self._over = 0, False
        self._seed = 0 if seed is None else seed % _SEEDS
        if seed is not None:
            if self._fresh and self._used:
                self.close()
                self._inner, self._resets = self._make()
            self._legacy.begin(self._seed)
        self._used = True
        with self._guarded("reset"):
            self._inner.reset(seed=None if seed is None else self._seed)
            self._frame = self._look()
        return self.render(), {}

    def step(self, action: Any) -> tuple[UInt8[np.ndarray, "h w 3"], float, bool, bool, dict[str, Any]]:
        """Take an action ``action_repeat`` times; in an episode that has terminated it changes nothing.

        A time limit that is reached within the repeats cuts none of them short: a task may go on beyond it.

        Raises:
            RecordingFailed: The simulator raises an error, draws no picture of the usual size, or has begun a new
                episode by itself.
        """
        reward, truncated = 0.0, False
        if self._over:
            return self.render(), reward, True, False, {"illegal": True}
        with self._guarded("step"):
            for _ in range(self._repeat):
                # Made anew each time: a simulator may write into it.
                given, before = for_simulator(self._inner.action_space, action), self._resets.count
                _, gained, over, late, info = self._inner.step(given)
                self._steps += 1
                reward += float(np.asarray(gained, np.float64).sum())  # of several objectives; no data set holds it
                self._over, truncated = bool(over), truncated or bool(late)
                self._require_same_episode(self._resets.count > before or is_first(info))
                if self._over:
                    break
            self._frame = self._look()
        return self.render(), reward, self._over, truncated, {"illegal": False}

    def render(self) -> UInt8[np.ndarray, "h w 3"]:
        """The present frame."""
        return self._frame.copy()

    def legal_actions(self) -> Bool[np.ndarray, " a"]:
        """All of them: Gymnasium does not say which are possible."""
        actions = self.facts.actions
        return np.ones(len(actions) if isinstance(actions, Discrete) else 0, np.bool_)

    def close(self) -> None:
        """Free the simulator."""
        with contextlib.suppress(Exception), quiet():
            self._inner.close()

    def _look(self) -> UInt8[np.ndarray, "h w 3"]:
        """What is drawn now, in the size of the frames."""
        with self._named("render"):
            picture: Any = self._inner.render()
        if not (
            isinstance(picture, np.ndarray)
            and picture.dtype == np.uint8
            and picture.ndim == 3
            and picture.shape[2] == 3
            and picture.size
        ):
            found = (
                f"an array of {picture.dtype} of the shape {picture.shape}"
                if isinstance(picture, np.ndarray)
                else f"a {type(picture).__name__}"
            )
            raise RecordingFailed(
                f"{self.name!r} drew {found} in the render mode {RENDER_MODE!r}, not rows and columns of RGB (uint8), "
                f"{self._when()}; a 'gymnasium.Wrapper' of yours whose 'render' turns it into such is applied with "
                "'--set wrappers=MODULE:CLASS'."
            )
        if self._drawn is None:
            self._drawn = picture.shape
        if picture.shape != self._drawn:
            before, now = (f"{shape[1]}x{shape[0]}" for shape in (self._drawn, picture.shape))
            raise RecordingFailed(
                f"{self.name!r} changed the size of its pictures from {before} to {now} pixels {self._when()}, and "
                "frames of a data set have one size."
            )
        return area_mean(picture, self._size, self._size)

    def _require_same_episode(self, began: bool) -> None:
        """See that the simulator did not begin a new episode in a step."""
        if began:
            raise RecordingFailed(
                f"{self.name!r} began a new episode by itself {self._when()}, so the next frame would not be what the "
                "action led to; leave out what resets it, such as the wrapper 'gymnasium.wrappers:Autoreset', or stay "
                "before its end, with '--set max_episode_steps=1000', fewer '--frames' or a smaller '--frame-skip'."
            )

    def _when(self) -> str:
        return f"at step {self._steps} of the episode with seed {self._seed}"

    @contextlib.contextmanager
    def _guarded(self, what: str) -> Iterator[None]:
        """Quietly and with random numbers of the simulator's own; what it raises becomes a sentence."""
        with self._named(what), quiet(), self._legacy.lent():
            yield

    @contextlib.contextmanager
    def _named(self, what: str) -> Iterator[None]:
        """Turn what a method of the simulator raises into a sentence."""
        try:
            yield
        except (DmbenchError, MemoryError):
            raise
        except (Exception, SystemExit) as error:
            if (missing := missing_package(self.name, error)) is not None:  # pygame is imported when it is drawn with
                raise missing from error
            raise failed(repr(self.name), repr(what), self._when(), error) from error
