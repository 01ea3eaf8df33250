"""Makes the environments of all installed packages known to Gymnasium, by the entry points of ``dmbench.gymnasium``.

Gymnasium 1.0 took away the entry points by which packages registered themselves with it; an environment is known once
its package is imported. Such an entry point names a function without arguments that calls ``gymnasium.register`` with
texts, so that no simulator is loaded before an environment is made.
"""

from __future__ import annotations

import os
import warnings
from importlib.metadata import entry_points
from typing import Final

GROUP: Final = "dmbench.gymnasium"
CONFINED: Final = "DMBENCH_CONFINED"
"""Set in a process that only reads recordings: it makes no environment, and Gymnasium would be a third of its start."""


def register_ids() -> None:
    """Let each installed package register its environments; a package that fails to is named in a warning."""
    if CONFINED in os.environ:
        return
    for point in entry_points(group=GROUP):
        try:
            point.load()()
        except Exception as error:  # somebody else's module may raise anything, and importing this must not fail
            warnings.warn(
                f"the environments of {point.value!r} are not known to Gymnasium ({type(error).__name__}: {error}).",
                RuntimeWarning,
                stacklevel=2,
            )
