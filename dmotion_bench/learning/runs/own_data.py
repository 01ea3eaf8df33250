"""The data set that a run was trained on: by the path that the run names, or else by its fingerprint."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

from dmotion_bench.errors import DatasetMissing
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.manifest import fingerprint_at
from dmotion_bench.wording import shown
from dmotion_bench.workspace import DATASET_MANIFEST, Workspace

if TYPE_CHECKING:
    from dmotion_bench.learning.runs.run import Run

AnyDataset = TypeVar("AnyDataset", bound=Dataset)


def find_own_data(named: Iterable[Path], workspaces: Iterable[Path], fingerprint: str) -> Path | None:
    """The folder of a data set: one of those that a run may mean, or one under any other name.

    Args:
        named: Folders that may hold it.
        workspaces: In whose ``data/`` it is looked for otherwise.
        fingerprint: Of the data set.

    Returns:
        Where none has the fingerprint the first that is named and holds a data set; None if none does.
    """
    there = [path for path in named if (path / DATASET_MANIFEST).is_file()]
    others = (path for root in dict.fromkeys(workspaces) for path in Workspace(root).datasets())
    for paths in (there, others):
        for path in paths:
            if fingerprint_at(path) == fingerprint:
                return path
    return there[0] if there else None


def dataset_of(run: Run, kind: type[AnyDataset]) -> AnyDataset:
    """The data set that a run was trained on, as it is now: it may have changed.

    Args:
        run: Trained or not.
        kind: The class that opens it.

    Raises:
        DatasetMissing: It is not here under any name; says how to get it.
        DatasetError: It cannot be opened.
        RunError: It is at an address that nobody has opened here.
    """
    path = run.dataset_path
    try:
        return kind.open(path)
    except DatasetMissing:
        fingerprint = run.spec.fingerprint
        raise DatasetMissing(
            f"the run {run.name!r} was trained on the data set {shown(run.spec.dataset)}, which is not at "
            f"{shown(str(path))}, and no data set in {shown(str(run.path.absolute().parent.parent / 'data'))} has its "
            f"fingerprint, {fingerprint[:12]}. Put it there under any name, fetch it with "
            f"'dmbench share pull {fingerprint[:12]} --from PLACE' if it was published, or record it again."
        ) from None
