"""Import of modules that an id or a wrapper names.

Such a name may come out of somebody's ``dataset.json``. So a module is imported only if it belongs to an installed
package that depends on Gymnasium, or to Gymnasium itself.
"""

from __future__ import annotations

import importlib
import re
from functools import cache
from importlib.machinery import PathFinder
from importlib.metadata import distribution, distributions, packages_distributions
from pathlib import Path
from typing import Any

from dmotion_bench.errors import UsageError
from dmotion_bench.wording import shown
from recorders.gymnasium_env.guest import quiet, unmade


def import_named(module: str, wanted_by: str) -> Any:
    """The module.

    Args:
        module: Its name, with dots.
        wanted_by: The environment, for sentences.

    Raises:
        UsageError: It is none that may be imported.
        PackageNotInstalled, InvalidSetting: Its import fails.
    """
    owners_of(module, wanted_by)
    try:
        with quiet():
            return importlib.import_module(module)
    except Exception as error:  # somebody else's module may raise anything
        raise unmade(wanted_by, error) from error


@cache
def owners_of(module: str, wanted_by: str) -> tuple[str, ...]:
    """The packages that bring a module which may be imported; found once, as it takes a second and every episode asks.

    Raises:
        UsageError: It is none that may be imported.
    """
    top = module.partition(".")[0]
    owners = packages_distributions().get(top) or _linking(top)
    needed = {_package(one) for owner in owners for one in distribution(owner).requires or []}
    if top != "gymnasium" and "gymnasium" not in needed:
        said = f"is of the package {owners[0]!r}, which does not" if owners else "is in no installed package"
        raise UsageError(
            f"the module {shown(module)}, which {wanted_by!r} names, {said}; dmbench imports only modules of "
            "installed packages that depend on Gymnasium, since the name may come from anybody's data set. Install "
            "yours with 'pip install -e DIR'."
        )
    return tuple(owners)


def _linking(top: str) -> list[str]:
    """The packages that were installed with ``pip install -e`` and bring a module: of some, only a folder is known.

    Such an installation names folders in a file ``.pth``, as hatchling's, and none of the modules that lie there.
    """
    return sorted(
        {
            one.name
            for one in distributions()
            if one.read_text("direct_url.json")  # as all of them have; to read what files the others have takes seconds
            for file in one.files or ()
            if file.suffix == ".pth" and top.isidentifier()
            for folder in _folders(Path(str(file.locate())))
            if PathFinder.find_spec(top, [str(folder)]) is not None
        }
    )


def _folders(file: Path) -> list[Path]:
    """The folders that a file ``.pth`` puts on the path; lines that are code are none."""
    try:
        lines = file.read_text(encoding="utf-8").splitlines()
    except (OSError, ValueError):
        return []
    return [file.parent / line.strip() for line in lines if line.strip() and not line.startswith(("#", "import"))]


def _package(requirement: str) -> str:
    """The package that a requirement names: ``gymnasium`` of ``gymnasium[mujoco]>=1.0``."""
    return re.split(r"[^A-Za-z0-9._-]", requirement.strip(), maxsplit=1)[0].lower()
