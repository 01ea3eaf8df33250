"""The workspace: its folders ``data/``, ``runs/`` and ``reports/``, and the search for data sets and runs in them.

The workspace is the current folder, or the one that ``DMBENCH_WORKSPACE`` names. Who calls the library may name another
one for the time of the call. What is derived from a data set is kept in its ``cache/``, or in the folder that
``DMBENCH_CACHE`` names.
"""

from __future__ import annotations

import contextlib
import functools
import os
import re
import shlex
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextvars import ContextVar
from dataclasses import dataclass
from pathlib import Path
from typing import Final, ParamSpec, TypeVar, cast

from dmotion_bench.addresses import remote_address
from dmotion_bench.errors import DatasetMissing, RunMissing, UnknownName, UsageError
from dmotion_bench.wording import command, shown

AnyPath = str | os.PathLike[str]
"""What may stand for a folder where somebody calls the library."""

AnyPaths = AnyPath | Sequence[AnyPath]
"""One or several of these."""

CACHE = "cache"
CACHE_VARIABLE = "DMBENCH_CACHE"
ANOTHER_CACHE = f"name another folder with '--cache DIR', or in the variable {CACHE_VARIABLE}"
DATASET_MANIFEST = "dataset.json"
RUN_MANIFEST = "run.json"


def listed(given: AnyPaths) -> list[AnyPath]:
    """One path or several as a list; what is no path is refused where it is used."""
    return list(given) if isinstance(given, Iterable) and not isinstance(given, str | os.PathLike) else [given]


def as_path(name: str, given: AnyPath) -> Path:
    """What somebody gives as a path.

    Args:
        name: What it is to be.
        given: It.

    Raises:
        UsageError: It is none.
    """
    try:
        return Path(given)
    except TypeError:
        raise UsageError(f"{shown(given)} stands for no {name}; give one name, or one path.") from None


def cache_folder(dataset: Path) -> Path:
    """Where what is derived from a data set is kept: in its folder, or where the variable says.

    Args:
        dataset: The data set's folder.
    """
    given = os.environ.get(CACHE_VARIABLE)
    return Path(given) if given else dataset / CACHE


@dataclass(frozen=True)
class Workspace:
    """A folder with data sets, runs and reports.

    Args:
        root: Kept as a ``Path``.
    """

    root: Path

    def __init__(self, root: AnyPath) -> None:
        object.__setattr__(self, "root", Path(root))

    @classmethod
    def current(cls) -> Workspace:
        """The workspace that was entered or, outside of any, that of this process."""
        return _ENTERED.get() or cls(Path(os.environ.get("DMBENCH_WORKSPACE", ".")))

    @contextlib.contextmanager
    def entered(self) -> Iterator[None]:
        """The current workspace within; another thread has its own."""
        token = _ENTERED.set(self)
        try:
            yield
        finally:
            _ENTERED.reset(token)

    @property
    def data(self) -> Path:
        """The folder of all data sets."""
        return self.root / "data"

    @property
    def runs(self) -> Path:
        """The folder of all training runs."""
        return self.root / "runs"

    @property
    def reports(self) -> Path:
        """The folder of all reports that compare runs."""
        return self.root / "reports"

    def datasets(self) -> list[Path]:
        """Every data set's folder, whole or still being recorded, sorted."""
        return sorted(path.parent for path in self.data.glob(f"*/{DATASET_MANIFEST}"))

    def all_runs(self) -> list[Path]:
        """Every run's folder, sorted."""
        return sorted(path.parent for path in self.runs.glob(f"*/{RUN_MANIFEST}"))

    def dataset(self, given: AnyPath | None) -> Path:
        """The data set asked for by path, name or address, or the only one there is.

        Raises:
            DatasetMissing: There is none.
            UsageError: There are several and none was named.
        """
        if given is not None:
            path = as_path("data set", given)
            if remote_address(given) is not None:
                return path  # whoever opens it looks whether there is one
            return self._named(path, self.data, DATASET_MANIFEST, "data set", self.datasets())
        found = self.datasets()
        if not found:
            raise DatasetMissing(
                f"no data set in {str(self.data)!r}; record one with 'dmbench record grid_world' "
                "or give the path of one."
            )
        if len(found) > 1:
            listed = "\n".join(f"  {shlex.quote(str(self.short(path)))}" for path in found)
            raise UsageError(f"several data sets are here; name one, as the argument or with '--data':\n{listed}")
        return found[0]

    def run(self, given: AnyPath | None, besides: Sequence[str] = ()) -> Path:
        """The run asked for by path or name, or the only one there is.

        Args:
            given: A path or a name.
            besides: What else may be named in its place; an error suggests these names, too.

        Raises:
            RunMissing: There is none.
            UsageError: There are several and none was named.
        """
        if given is not None:
            return self._named(as_path("run", given), self.runs, RUN_MANIFEST, "run", self.all_runs(), besides)
        found = self.all_runs()
        if not found:
            raise RunMissing(f"no run in {str(self.runs)!r}; train one with 'dmbench train dmotion'.")
        if len(found) > 1:
            listed = "\n".join(f"  {shlex.quote(str(self.short(path)))}" for path in found)
            raise UsageError(f"several runs are here; name one:\n{listed}")
        return found[0]

    def trainings(self, given: AnyPath) -> list[Path]:
        """The run asked for by path or name or, where none has this name, the runs that add a seed to it.

        For ``a`` these are ``a-s0``, ``a-s1`` ..., in the order of their seeds.

        Raises:
            RunMissing, UnknownName: There is none.
        """
        path = as_path("run", given)
        places = (path, self.runs / path)
        if not any((place / RUN_MANIFEST).is_file() for place in places):
            for place in places:
                seeded = re.compile(rf"{re.escape(place.name)}-s(\d+)")
                runs = [manifest.parent for manifest in place.parent.glob(f"*-s*/{RUN_MANIFEST}")]
                found = {int(seed[1]): run for run in runs if (seed := seeded.fullmatch(run.name))}
                if found:
                    return [found[seed] for seed in sorted(found)]
        return [self.run(given)]

    def short(self, folder: AnyPath) -> AnyPath:
        """What to type for a data set or a run: its name where that finds it, otherwise its path or address."""
        path = Path(folder)
        return path.name if path.parent in (self.data, self.runs) and not Path(path.name).exists() else folder

    @staticmethod
    def _named(
        given: Path, folder: Path, manifest: str, kind: str, known: list[Path], besides: Sequence[str] = ()
    ) -> Path:
        listing = f"dmbench list {kind.replace(' ', '')}s"
        for candidate in (given, folder / given):
            if (candidate / manifest).is_file():
                return candidate
        if given.is_dir():
            missing = DatasetMissing if kind == "data set" else RunMissing
            raise missing(f"{str(given)!r} is no {kind}: it holds no {manifest}. '{listing}' lists the {kind}s.")
        if kind == "data set" and given.is_file():
            raise DatasetMissing(
                f"{str(given)!r} is a file, no data set; a recording becomes one with "
                f"{command('dmbench data import', given)}."
            )
        raise UnknownName(kind, str(given), [path.name for path in known] + [*besides], listing)


_ENTERED: Final[ContextVar[Workspace | None]] = ContextVar("entered", default=None)
_Given = ParamSpec("_Given")
_Result = TypeVar("_Result")


def in_workspace(function: Callable[_Given, _Result]) -> Callable[_Given, _Result]:
    """Let the ``workspace`` that a caller names be the current one of all that the function calls.

    Args:
        function: Has the keyword argument ``workspace``: a folder, or None for the current one.
    """

    @functools.wraps(function)
    def called(*args: _Given.args, **named: _Given.kwargs) -> _Result:
        given = named.get("workspace")
        if given is None:
            return function(*args, **named)
        with Workspace(as_path("workspace", cast(AnyPath, given))).entered():
            return function(*args, **named)

    return called
