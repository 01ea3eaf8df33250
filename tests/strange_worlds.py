"""Gymnasium environments of our own: one that behaves, and one for each way of not doing so."""

from __future__ import annotations

import ctypes
import os
import random
from typing import Any, ClassVar

import gymnasium
import numpy as np
from gymnasium.error import DependencyNotInstalled
from gymnasium.spaces import Box, Dict, Discrete, MultiBinary

SLIDER = "gym:Strange/Slider-v0"
SMALL = ("--preset", "tiny", "--episodes", "2", "--frames", "6", "--size", "24", "--workers", "1")
"""Words that make a recording by the command line short."""


class Slider(gymnasium.Env[np.ndarray, Any]):
    """A white bar in a dark picture; actions 5 and 6 move it left and right, and it ends at the right edge."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}
    size: ClassVar[tuple[int, int]] = (48, 96)  # rows, columns

    def __init__(self, *, render_mode: str | None = None, places: int = 12, fails_at: int = -1) -> None:
        self.render_mode, self.places, self.fails_at = render_mode, places, fails_at
        self.action_space: Any = Discrete(2, start=5)
        self.observation_space = Box(0, places, (1,), np.float32)
        self.place, self.taken = 0, list[int]()

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place, self.taken = int(self.np_random.integers(1, self.places // 2)), []
        return self.observed(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        if len(self.taken) == self.fails_at:
            raise FloatingPointError("the simulation diverged")
        assert self.action_space.contains(action), action
        self.taken.append(int(action))
        self.place = max(0, self.place + (1 if action == 6 else -1))
        return self.observed(), 1.0, self.place >= self.places - 1, False, {}

    def observed(self) -> np.ndarray:
        return np.array([self.place], np.float32)

    def render(self) -> Any:
        rows, columns = self.size
        picture = np.full((rows, columns, 3), (10, 20, 31), np.uint8)
        width = columns // self.places
        picture[:, self.place * width : (self.place + 1) * width] = 250
        return picture


class Talking(Slider):
    """Prints, in Python and as a library in C does."""

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        print("a step")  # noqa: T201
        os.write(1, b"another step\n")
        ctypes.CDLL(None).printf(b"a step in C\n")  # waits in a buffer of its own
        return super().step(action)


class Unseeded(Slider):
    """Starts anywhere whatever the seed, in a light of its own: two starts look alike by a chance of 2**-24."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        generator = np.random.default_rng()
        self.place, self.light = int(generator.integers(0, self.places - 2)), generator.integers(0, 256, 3, np.uint8)
        return self.observed(), {}

    def render(self) -> Any:
        picture = super().render()
        picture[: len(picture) // 4] = self.light
        return picture


class Legacy(Slider):
    """Draws from the generators that a whole process shares."""

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        super().reset(seed=seed)
        self.place = int(np.random.randint(0, 2**20)) % (self.places - 2)  # noqa: NPY002 -- as OGBench does
        return self.observed(), {}

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return super_step(self, 5 + (random.random() < 0.5))


class Remembering(Slider):
    """Draws the picture in the colour of the number of its episode, as MuJoCo's camera stays where it was at first."""

    episodes = 0

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[np.ndarray, dict[str, Any]]:
        self.episodes += 1
        return super().reset(seed=seed)

    def render(self) -> Any:
        return super().render() - np.uint8(5 * (self.episodes > 1))


class Growing(Slider):
    """Draws larger pictures from the third step on."""

    def render(self) -> Any:
        picture = super().render()
        return picture if len(self.taken) < 3 else np.concatenate([picture, picture])


class Gray(Slider):
    """Draws no colours."""

    def render(self) -> Any:
        return super().render()[..., 0]


class Listing(Slider):
    """Draws nothing."""

    def render(self) -> Any:
        return None


class Paintless(Slider):
    """Notices at its first picture that it cannot draw, as Gymnasium's own notice that pygame is absent."""

    def render(self) -> Any:
        absent = ModuleNotFoundError("No module named 'pygame.gfxdraw'", name="pygame.gfxdraw")
        raise DependencyNotInstalled("pygame is not installed") from absent


class Blind(Slider):
    """Draws text alone, and has nothing to close."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["ansi"], "render_fps": 20}

    def close(self) -> None:
        """As one that closes a window that it has never opened."""
        super().close()
        raise AttributeError("'Blind' object has no attribute 'window'")


class Choiceless(Slider):
    """Has one action, which moves to the right."""

    def __init__(self, *, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.action_space = Discrete(1)

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        return super_step(self, 6)


class Keyed(Slider):
    """Takes actions with names."""

    def __init__(self, *, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.action_space = Dict(gas=Box(0, 1, (1,)), gear=Discrete(4))


class Buttons(Slider):
    """Takes several buttons at once."""

    def __init__(self, *, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.action_space = MultiBinary(3)


class Boundless(Slider):
    """Takes any number."""

    def __init__(self, *, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.action_space = Box(-np.inf, np.inf, (2,))


class Speed(Slider):
    """Takes a matrix of two numbers whose sum says where to go."""

    def __init__(self, *, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.action_space = Box(-0.1, np.array([[0.3], [0.2]], np.float32), (2, 1))

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        assert self.action_space.contains(action), action
        return super_step(self, 6 if float(action.sum()) > 0 else 5)


class Clamped(Slider):
    """Takes two numbers, one of which is always the same."""

    def __init__(self, *, render_mode: str | None = None) -> None:
        super().__init__(render_mode=render_mode)
        self.action_space = Box(np.array([-1, 0], np.float32), np.array([1, 0], np.float32))


class Leaving(Slider):
    """Ends the whole process, as a simulator without a licence does."""

    def step(self, action: Any) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
        raise SystemExit(3)


class Scribbling(Speed):
    """Doubles the action where it was given; has two rewards, and a rate as a whole number of numpy."""

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": np.int64(50)}

    def step(self, action: Any) -> Any:
        self.last = action.copy()
        action *= 2
        observed, _, terminated, truncated, info = super_step(self, 6)
        return observed, np.ones(2), terminated, truncated, info


class Named(Slider):
    """Its actions have names."""

    def get_action_meanings(self) -> list[str]:
        return ["LEFT", "RIGHT"]


class Mirrored(gymnasium.ActionWrapper[Any, Any, Any]):
    """The actions the other way round."""

    def action(self, action: int) -> int:
        return 11 - action

    def get_action_meanings(self) -> list[str]:
        return ["RIGHT", "LEFT"]


def super_step(world: Slider, action: int) -> tuple[np.ndarray, float, bool, bool, dict[str, Any]]:
    """A step of a ``Slider`` by its number."""
    world.taken.append(action)
    world.place = max(0, world.place + (1 if action == 6 else -1))
    return world.observed(), 1.0, world.place >= world.places - 1, False, {}


def register() -> None:
    """Make them known to Gymnasium, as ``Strange/NAME-v0``."""
    for kind in (
        Slider,
        Talking,
        Unseeded,
        Legacy,
        Remembering,
        Growing,
        Gray,
        Listing,
        Paintless,
        Blind,
        Choiceless,
        Keyed,
        Buttons,
        Boundless,
        Speed,
        Clamped,
        Leaving,
        Scribbling,
        Named,
    ):
        if (name := f"Strange/{kind.__name__}-v0") not in gymnasium.registry:
            gymnasium.register(id=name, entry_point=kind, max_episode_steps=40)
