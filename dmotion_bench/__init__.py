"""The core of dmbench: storage, learning, planning, scoring and viewing; no environment and no model by name.

Environments and models reach the core through entry points (``dmbench.environments``,
``dmbench.models``), the same door that a third party's package uses.
"""

from importlib.metadata import PackageNotFoundError, version

try:
    __version__ = version("dmbench")
except PackageNotFoundError:  # the source tree on a path, never installed
    __version__ = "0.0.0"

__all__ = ["__version__"]
