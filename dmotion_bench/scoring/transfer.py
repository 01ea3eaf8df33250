"""Scoring a run on another data set than the one it was trained on: other lights, masses, cameras, other seeds.

The figures are those of the other data set's held-out episodes, the same that runs trained on it are scored on, so
they stand on one board and can be paired. Such a report lies beside the run's own, in ``report/on/NAME/``, and says
what the run was trained on.

It must be the same environment: the same actions and pictures of the same size. And the episodes must be new to the
run: two recordings with the same seed begin their episodes alike, and where nothing that can be seen varies, one may
hold as a test what the other holds as training.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, Protocol, runtime_checkable

import numpy as np

from dmotion_bench.errors import DatasetError, RunMismatch
from dmotion_bench.learning.run import Run
from dmotion_bench.learning.run_manifest import stored_actions
from dmotion_bench.scoring.report import REPORT_FILE, REPORT_FOLDER, TRANSFERS
from dmotion_bench.specs import SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.wording import command

_SHOWN: Final = 5


@runtime_checkable
class Identified(Protocol):
    """What finding a report needs to know of a data set."""

    @property
    def name(self) -> str: ...

    @property
    def fingerprint(self) -> str: ...


def report_folder(run: Path, trained_on: str, dataset: Identified) -> Path:
    """The folder of a run's report on a data set.

    Args:
        run: The run's folder.
        trained_on: Fingerprint of the run's own data set.
        dataset: What it is scored on.
    """
    own = run / REPORT_FOLDER
    return own if dataset.fingerprint == trained_on else own / TRANSFERS / dataset.name


def transfer_folders(run: Path) -> list[Path]:
    """The folders of a run's reports on other data sets than its own, sorted."""
    return sorted(path.parent for path in (run / REPORT_FOLDER / TRANSFERS).glob(f"*/{REPORT_FILE}"))


def require_transferable(run: Run, dataset: Dataset, split: SplitName) -> None:
    """Raise an error if a run cannot be scored on another data set, or was trained on its episodes.

    Raises:
        RunMismatch: It is of another environment, or holds episodes that the run was trained on.
    """
    require_fitting(run, dataset)
    own, name = _trained_on(run), dataset.name
    known = [] if own is None else _known_before(own, dataset, split)
    if known:
        listed = ", ".join(map(str, known[:_SHOWN])) + (" ..." if len(known) > _SHOWN else "")
        raise RunMismatch(
            f"{len(known)} of the {len(dataset.split(split))} {split} episodes of {name!r} have the seed and the first "
            f"picture of episodes that {run.name!r} was trained on (episodes {listed}); record the data set with "
            "another '--seed'."
        )


def require_fitting(run: Run, dataset: Dataset) -> None:
    """Raise an error unless a data set has the environment, actions and image size of a run's model.

    Raises:
        RunMismatch: It cannot.
    """
    spec, name = run.spec, dataset.name
    own = _trained_on(run)
    if own is not None and own.recipe.environment != dataset.recipe.environment:
        raise RunMismatch(
            f"{run.name!r} was trained in {own.recipe.environment!r}, and {name!r} is of "
            f"{dataset.recipe.environment!r}; take data of its own environment: "
            f"{command('dmbench record', own.recipe.environment, '--seed', '1', '--out', 'DIR')}."
        )
    for what, mine, theirs in (
        ("actions", spec.actions, stored_actions(dataset.spec.actions)),
        ("pixels", f"{spec.width} x {spec.height}", f"{dataset.spec.width} x {dataset.spec.height}"),
    ):
        if mine != theirs:
            raise RunMismatch(f"{run.name!r} was trained on {mine} {what}, and {name!r} has {theirs}.")
    if own is not None and own.spec.actions != dataset.spec.actions:
        raise RunMismatch(
            f"the actions of {name!r} are {dataset.spec.actions}, and those of {own.name!r}, which {run.name!r} was "
            f"trained on, {own.spec.actions}."
        )


def _trained_on(run: Run) -> Dataset | None:
    """The data set that the run was trained on, if it still exists unchanged."""
    try:
        dataset = Dataset.open(run.dataset_path)
    except DatasetError:
        return None
    return dataset if dataset.fingerprint == run.spec.fingerprint else None


def _known_before(own: Dataset, dataset: Dataset, split: SplitName) -> list[int]:
    """Episodes of a split with the seed and first image of one of the run's training or validation episodes.

    Two versions of an environment may draw the same episode otherwise, so between them the seed alone decides.
    """
    redrawn = own.recipe.version != dataset.recipe.version
    trained = np.concatenate([own.split("train"), own.split("validation")])
    seen = {own.rows[episode].seed: episode for episode in trained.tolist()}
    asked = [(episode, seen.get(dataset.rows[episode].seed)) for episode in dataset.split(split).tolist()]
    return [
        episode
        for episode, same in asked
        if same is not None and (redrawn or np.array_equal(dataset.video(episode)[0], own.video(same)[0]))
    ]
