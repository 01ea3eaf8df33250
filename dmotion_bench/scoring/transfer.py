"""Scoring a run on another data set than the one it was trained on: other lights, masses, cameras, other seeds.

The figures are those of the other data set's held-out episodes, the same that runs trained on it are scored on, so
they stand on one board and can be paired. Such a report lies beside the run's own, in ``report/on/NAME/``, and says
what the run was trained on; of two data sets of one name the second has the beginning of its fingerprint in that name.
A report of validation episodes lies below that of the test, in ``validation/``.

It must be the same environment: the same actions and pictures of the same size. And the episodes must be new to the
run: two recordings with the same seed begin their episodes alike, and one may hold as a test what the other holds as
training. The seeds of the training are in its data set; where that is gone, the report says that nobody looked.

An import names no environment, so any import of frames of the same size fits whose actions have the same names. It may
list discrete ones in another order: scoring numbers them as the training did. The bounds of continuous actions are the
smallest and largest that were recorded, so they differ; scoring takes those of the training. An import has no seeds
either; whether its episodes are new is told by their pictures (``overlap.py``). Both take the data set that the run was
trained on.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np
from jaxtyping import Int

from dmotion_bench.actions import ActionSpec, Continuous, Discrete
from dmotion_bench.errors import DatasetError, DatasetMissing, RunMismatch
from dmotion_bench.learning.runs.manifest import stored_actions
from dmotion_bench.learning.runs.own_data import dataset_of
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.scoring.overlap import copied_episodes
from dmotion_bench.scoring.report import REPORT_FILE, REPORT_FOLDER, TRANSFERS, read_report, report_place
from dmotion_bench.specs import IMPORTED, SplitName
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.readable import ReadableDataset
from dmotion_bench.storage.split import SPLIT_NAMES
from dmotion_bench.wording import command, shortened, shown

_SHOWN: Final = 5


def report_folder(
    run: Path, trained_on: str, dataset: ReadableDataset, split: SplitName = "test", column: str | None = None
) -> Path:
    """The folder of a run's report on a data set.

    Args:
        run: The run's folder.
        trained_on: Fingerprint of the run's own data set.
        dataset: What it is scored on.
        split: Whose episodes are scored.
        column: Of the table of control; each has a report of its own.

    Raises:
        RunCorrupt: A report of a data set of the same name is there and cannot be read.
    """
    if dataset.fingerprint == trained_on:
        return run / report_place(None, split, column)
    plain = run / report_place(dataset.name, split, column)
    marked = run / report_place(f"{dataset.name}-{dataset.fingerprint[:8]}", split, column)
    if marked.is_dir():
        return marked
    standing = read_report(plain)
    return plain if standing is None or standing.dataset["fingerprint"] == dataset.fingerprint else marked


def transfer_folders(run: Path) -> list[Path]:
    """The folders of a run's reports on other data sets than its own, and of the columns there, sorted.

    Not of those on validation episodes, which are for choosing and stand on no leaderboard. Nor of hidden folders: they
    are other programs', and nobody sees that their links stay within the run (``storage/links.py``).
    """
    there = run / REPORT_FOLDER / TRANSFERS
    found = [path.parent for path in there.glob(f"*/{REPORT_FILE}")]
    found += [path.parent for path in there.glob(f"*/*/{REPORT_FILE}") if path.parent.name not in SPLIT_NAMES]
    return sorted(path for path in found if not any(one.startswith(".") for one in path.relative_to(there).parts))


def transferable(run: Run, dataset: Dataset, split: SplitName, column: str | None = None) -> Dataset:
    """Another data set than the run's own as its model reads it, which was trained on none of its episodes.

    Args:
        run: Trained.
        dataset: The other data set.
        split: Whose episodes are scored.
        column: Of the table of control: then it is the episodes of the tasks that must be new to the run.

    Raises:
        RunMismatch: It does not fit the run, or holds episodes that the run was trained on.
        DatasetMissing: As ``fitting`` raises it.
    """
    read, own = fitting(run, dataset), own_dataset(run)
    if own is None:
        return read
    trained = np.arange(len(own)) if run.spec.protocol == "paper" else _concatenated(own, "train", "validation")
    asked = dataset.split(split).tolist() if column is None else sorted({task.episode for task in dataset.tasks()})
    if _is_import(dataset):
        known = copied_episodes(own, trained.tolist(), dataset, asked)
        how = f"{'shows' if len(known) == 1 else 'show'} the same as"
        instead = "import recordings that the training did not have."
    else:
        known = _known_before(own, trained.tolist(), dataset, asked)
        how = f"{'has' if len(known) == 1 else 'have'} the seed of"
        instead = "record the data set with another '--seed'."
    if known:
        whose = split if column is None else "task"
        listed = ", ".join(map(str, known[:_SHOWN])) + (" ..." if len(known) > _SHOWN else "")
        raise RunMismatch(
            f"{len(known)} of the {len(asked)} {whose} episodes of {shown(dataset.name)} {how} episodes that "
            f"{shown(run.name)} was trained on (episodes {listed}); {instead}"
        )
    return read


def fitting(run: Run, dataset: Dataset) -> Dataset:
    """A data set as a run's model reads it: an import with the numbers, or the bounds, of the training's actions.

    Raises:
        RunMismatch: It has other pictures or actions than the run's model, or is of another environment.
        DatasetMissing: It is an import with actions, and the run's own data set, which has their order, is not there.
    """
    spec, name, own = run.spec, dataset.name, own_dataset(run)
    if own is not None and not _is_import(dataset) and own.recipe.environment != dataset.recipe.environment:
        again = (
            "import other recordings of it with 'dmbench data import'"
            if _is_import(own)
            else command("dmbench record", own.recipe.environment, "--seed", "1", "--out", "DIR")
        )
        raise RunMismatch(
            f"{run.name!r} was trained in {own.recipe.environment!r}, and {name!r} is of "
            f"{dataset.recipe.environment!r}; take data of its own environment: {again}."
        )
    mine, theirs = (f"{one.width} x {one.height}" for one in (spec, dataset.spec))
    if mine != theirs:
        again = f"import it again with '--size {spec.width}'" if _is_import(dataset) else "take data of the same size"
        raise RunMismatch(f"{run.name!r} was trained on {mine} pixels, and {name!r} has {theirs}; {again}.")
    if _is_import(dataset) and own is None and dataset.fingerprint != spec.fingerprint:
        raise DatasetMissing(
            f"{name!r} is an import, and only the data set that {run.name!r} was trained on says which actions and "
            f"episodes it knows; {shown(str(run.dataset_path))} is not there or has changed: put it there again."
        )
    if _is_import(dataset) and dataset.spec.actions is None:
        return dataset
    read = dataset if own is None else _numbered(run, own, dataset)
    if spec.actions != stored_actions(read.spec.actions):
        known = spec.action_spec
        mine = _listed(known) if isinstance(known, Continuous) else f"{len(known or ())} actions"
        raise RunMismatch(
            f"{run.name!r} was trained on {mine}, and those of {name!r} are {_listed(dataset.spec.actions)}; take data "
            "of the same actions."
        )
    return read


def _numbered(run: Run, own: Dataset, dataset: Dataset) -> Dataset:
    """A data set with the actions of the training in their order; only an import may have stored another one."""
    mine, theirs = own.spec.actions, dataset.spec.actions
    if mine == theirs:
        return dataset
    match mine, theirs:
        case Discrete(), Discrete() if _is_import(dataset) and set(mine.names) == set(theirs.names):
            return dataset.numbered(mine.names)
        case Continuous(), Continuous() if _is_import(dataset) and _same_numbers(mine, theirs):
            return dataset.bounded(mine)
        case Continuous(), Continuous() if _is_import(dataset) and _differ_in_order(mine, theirs):
            again = f"their order differs: import it again with '--action-fields {','.join(mine.names)}'"
        case None, _:
            again = "import it again without '--actions'"
        case _:
            again = "take data of the same actions"
    raise RunMismatch(
        f"the actions of {dataset.name!r} are {_listed(theirs)}, and those of {own.name!r}, which {run.name!r} was "
        f"trained on, {_listed(mine)}; {again}."
    )


def _same_numbers(mine: Continuous, theirs: Continuous) -> bool:
    """Whether actions differ in their bounds alone, which an import takes from what was recorded."""
    return (mine.names, mine.units) == (theirs.names, theirs.units)


def _differ_in_order(mine: Continuous, theirs: Continuous) -> bool:
    return mine.names != theirs.names and set(mine.names) == set(theirs.names)


def beyond_bounds(dataset: Dataset, split: SplitName) -> tuple[int, int]:
    """How many actions of a split hold a number beyond the bounds of the training, and how many actions there are.

    Args:
        dataset: As ``transferable`` returns it.
        split: Whose episodes are looked at; none if the bounds are those of the data set itself.
    """
    known = dataset.spec.actions
    if not isinstance(known, Continuous) or known == dataset.manifest.spec.actions:
        return 0, 0
    taken = [dataset.states(episode).actions for episode in dataset.split(split).tolist()]
    return sum(int(known.beyond(actions).any(axis=1).sum()) for actions in taken), sum(map(len, taken))


def training_is_here(run: Run) -> bool:
    """Whether the data set that the run was trained on is there, which alone says which episodes are new to it."""
    return own_dataset(run) is not None


def training_of(run: Run, dataset: Dataset) -> dict[str, Any] | None:
    """What a run was trained on, as its report on another data set says it; None on its own data set."""
    if dataset.fingerprint == run.spec.fingerprint:
        return None
    said, own = {"name": run.spec.dataset, "fingerprint": run.spec.fingerprint}, own_dataset(run)
    differs = own is not None and own.recipe.environment != dataset.recipe.environment
    return said | ({"environment": own.recipe.environment} if own is not None and differs else {})


def transfer_remark(run: Run, dataset: Dataset, split: SplitName) -> str:
    """What to bear in mind of a report on another data set than the run's own.

    Args:
        run: Trained.
        dataset: The other data set, as ``transferable`` returns it.
        split: Whose episodes were scored.
    """
    own = own_dataset(run)
    world = f" ({own.recipe.environment})" if own is not None and _is_import(dataset) else ""
    said = f"trained on {run.spec.dataset!r}{world}, and scored on {dataset.name!r}"
    if dataset.recipe.vary:
        ranges = " (shifted)" if dataset.recipe.parameters.get("ranges") == "shifted" else ""
        varying = "varies" if len(dataset.recipe.vary) == 1 else "vary"
        said += f", in which {', '.join(dataset.recipe.vary)} {varying}{ranges}"
    if _is_import(dataset):
        said += ", an import" + (
            " whose actions are matched by their names" if dataset.spec.actions is not None else ""
        )
    if own is not None and own.spec.step_ns != dataset.spec.step_ns:
        said += f"; a step of it takes {dataset.spec.step_ns / 1e9:g} s, of the training {own.spec.step_ns / 1e9:g} s"
    beyond, count = beyond_bounds(dataset, split)
    if beyond:
        said += f"; {beyond:,} of the {count:,} {split} actions hold a number beyond the bounds of the training"
    if own is None:
        said += "; whether its episodes are new to the run was not looked at: the data of the training are not here"
    return said


def _is_import(dataset: Dataset) -> bool:
    return dataset.recipe.environment == IMPORTED


def _listed(actions: ActionSpec | None) -> str:
    return "not known" if actions is None else shortened(str(actions), 300)


def _concatenated(dataset: Dataset, *splits: SplitName) -> Int[np.ndarray, " n"]:
    return np.concatenate([dataset.split(name) for name in splits])


def own_dataset(run: Run) -> Dataset | None:
    """The data set that the run was trained on, if it still exists unchanged."""
    try:
        dataset = dataset_of(run, Dataset)
    except DatasetError:
        return None
    return dataset if dataset.fingerprint == run.spec.fingerprint else None


def _known_before(own: Dataset, trained: Sequence[int], dataset: Dataset, asked: Sequence[int]) -> list[int]:
    """The episodes with the seed of one that the run was trained or validated on.

    The seed decides where things stand, whatever else differs: light, camera or version only draw it otherwise.
    """
    seen = {own.rows[episode].seed for episode in trained}
    return [episode for episode in asked if dataset.rows[episode].seed in seen]
