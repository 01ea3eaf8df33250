"""How packages of others are used here: without warnings and without a screen, and their failures are sentences."""

from __future__ import annotations

import contextlib
import os
import re
import sys
import warnings
from collections.abc import Iterator
from typing import Final

from dmotion_bench.errors import DmbenchError, InvalidSetting, PackageNotInstalled
from recorders.gymnasium_env.worlds import MODULES

_EGL: Final = "apt-get install libegl1 libegl-mesa0 libgl1-mesa-dri"
_SCREENLESS: Final = re.compile(r"EGL|\begl(\b|[A-Z_])|(?i:opengl|glfw|osmesa|display)")
"""In what is said where there is no screen; ``egl`` alone is in "neglected", too."""


@contextlib.contextmanager
def quiet() -> Iterator[None]:
    """Without warnings, and without a screen: packages that draw read these variables when they are imported."""
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    if sys.platform == "linux" and not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        os.environ.setdefault("MUJOCO_GL", "egl")
        if os.environ["MUJOCO_GL"] == "egl":
            os.environ.setdefault("PYOPENGL_PLATFORM", "egl")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        yield


def missing_package(name: str, error: BaseException) -> PackageNotInstalled | None:
    """The error for an environment that needs an absent package, if that is what its error comes from."""
    cause: BaseException | None = error
    while cause is not None and not isinstance(cause, ModuleNotFoundError):
        cause = cause.__cause__ or cause.__context__
    if cause is None or not cause.name:
        return None
    module = cause.name.partition(".")[0]
    extra = MODULES.get(module)
    return PackageNotInstalled(
        module, repr(name), f"pip install 'dmbench[{extra}]'" if extra else f"pip install {module}"
    )


def unmade(name: str, error: Exception) -> DmbenchError:
    """The error for an environment that cannot be made."""
    if (missing := missing_package(name, error)) is not None:
        return missing
    said = f"{type(error).__name__}: {error}".rstrip(".")
    if _SCREENLESS.search(said):
        return InvalidSetting(
            f"{name!r} cannot draw without a screen here ({said}); install EGL with '{_EGL}' and set MUJOCO_GL=egl, or "
            "MUJOCO_GL=osmesa with 'libosmesa6'."
        )
    return InvalidSetting(f"{name!r} cannot be made: {said}.")
