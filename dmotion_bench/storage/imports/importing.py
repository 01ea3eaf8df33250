"""Foreign recordings -> a data set of the format ``dmbench/1``.

Two passes over every file: the first looks at times, sizes and actions and refuses what cannot be imported;
the second unpacks only the frames that are needed, one at a time. The data set is written beside its place and
moved there when it is whole, so a failed import leaves nothing behind.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from dmotion_bench.errors import RecipeMismatch, UsageError
from dmotion_bench.specs import SPLIT, DatasetRecipe, Scalar, unplaced_labels
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.fitting import fitted
from dmotion_bench.storage.imports.import_plan import BAGS, FILE, HASH, ImportPlan, PlannedEpisode, plan_import
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.recording import Named, Recording, Survey
from dmotion_bench.storage.imports.search import find
from dmotion_bench.storage.imports.sources import open_recording, require_effect
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.shard import Footage
from dmotion_bench.storage.staging import staged, sweep
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.wording import shown
from dmotion_bench.workspace import DATASET_MANIFEST

UNFINISHED: Final = ".importing"
_OF_SPLIT: Final = (SPLIT, BAGS)
"""The parameters of a recipe that say which episodes stay on one side of the split."""
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


def import_recordings(
    paths: Sequence[Path], out: Path, options: ImportOptions, progress: Progress = lambda what, done, total: None
) -> ImportReport:
    """Make a data set of foreign recordings.

    Args:
        paths: Files, folders of such, folders of pictures, LeRobot data sets; see ``search``.
        out: The data set's folder; one that this very import has made is left as it is.
        options: How.
        progress: Is told how far it is.

    Raises:
        RecordingImportError: A recording cannot be imported.
        RecipeMismatch: The folder holds another data set.
        InvalidSetting: An option has no effect for these recordings.
        UsageError: The folder holds something else.
    """
    sweep(out, UNFINISHED)
    standing = standing_in(out)
    with Confinement(options) as confinement:
        found = find(paths, options.camera, salvage=options.salvage)
        found.require_sound()
        require_effect(found.sources, options)
        recordings = [open_recording(source, options, confinement) for source in found.sources]
        surveys = [_survey(one, number, len(recordings), progress) for number, one in enumerate(recordings)]
        plan = plan_import(recordings, surveys, options, found)
        if standing is None:
            _write(out, plan, recordings, options, progress)
        else:
            require_same(standing, plan, out)
    unreadable = sum(recording.unreadable for recording in recordings)
    return plan.report(out, unreadable=unreadable, skipped=skipped_episodes(recordings, surveys))


def skipped_episodes(recordings: Sequence[Named], surveys: Sequence[Survey]) -> tuple[tuple[str, str], ...]:
    """The episodes of recordings that were left out because they are damaged, for ``ImportReport.skipped``."""
    return tuple(
        (f"{recording.path}: {name}", f"{name}: {why}")
        for recording, survey in zip(recordings, surveys, strict=True)
        for name, why in survey.skipped
    )


def require_same(standing: Manifest, plan: ImportPlan, out: Path) -> None:
    """Check that the data set which is there is the one that is wanted.

    Raises:
        RecipeMismatch: It is another.
    """
    if (standing.recipe, standing.spec) != (plan.recipe, plan.spec):
        raise RecipeMismatch(
            f"{str(out)!r} holds {_other(standing.recipe, plan.recipe)}; name another folder with '--out DIR', or "
            "delete it first."
        )


def _other(standing: DatasetRecipe, wanted: DatasetRecipe) -> str:
    """Why a data set is not the one that is wanted, to follow "holds"."""
    known = standing.parameters
    hashes = {key: value for key, value in wanted.parameters.items() if key.startswith(HASH) and key in known}
    alike = {key: value for key, value in known.items() if key not in _OF_SPLIT} | hashes
    alike |= {key: value for key, value in wanted.parameters.items() if key in _OF_SPLIT}
    if replace(standing, episodes=wanted.episodes, parameters=alike) != wanted:
        return _other_request(standing, wanted)
    changed = [str(known[f"{FILE}{key.removeprefix(HASH)}"]) for key in hashes if hashes[key] != known[key]]
    if not changed and any(known.get(key) != wanted.parameters.get(key) for key in _OF_SPLIT):
        return (
            "what an earlier version of dmbench has made of these recordings, with parts of one recording in training "
            "and in test"
        )
    if not changed:
        return (
            "what an earlier version of dmbench has made of these recordings, and this one makes something else of them"
        )
    more = f" and {len(changed) - 1} more" if len(changed) > 1 else ""
    return (
        f"an import of {changed[0]!r}{more} with other contents: the files have changed since (of a LeRobot data set "
        "also if an earlier version of dmbench imported it, which did not compare the list of episodes)"
    )


def _other_request(standing: DatasetRecipe, wanted: DatasetRecipe) -> str:
    """In what another import was asked for, to follow "holds": first in recordings, as these decide most options."""
    if standing.environment != wanted.environment:
        return f"a data set recorded in {standing.environment!r}"
    there, here = _options(standing), _options(wanted)
    before, now = (Counter(str(name) for key, name in one.items() if key.startswith(FILE)) for one in (there, here))
    for apart, which in ((now - before, "lacks"), (before - now, "has")):
        if apart:
            return f"an import of other recordings, which {which} {shown(min(apart))}"
    differing = [
        f"'--{name.removesuffix('_s').replace('_', '-')}' is {_given(there.get(name))} there and "
        f"{_given(here.get(name))} here"
        for name in here | there
        if not name.startswith(FILE) and there.get(name) != here.get(name)
    ]
    if not differing:
        return "an import of these recordings in another order"
    return f"an import with other options: {'; '.join(differing)}"


def _options(recipe: DatasetRecipe) -> dict[str, Scalar]:
    """What an import was asked for, by the options' names; and the names of its files."""
    asked = {
        name: value for name, value in recipe.parameters.items() if name not in _OF_SPLIT and not name.startswith(HASH)
    }
    return asked | {"frames_per_episode": recipe.frames, "seed": recipe.seed}


def _given(value: Scalar | None) -> str:
    """An option as somebody gives it; what is empty was left out, but for the seed 0."""
    if value is True:
        return "given"
    return shown(value) if value or type(value) is int else "left out"


def _survey(recording: Recording, number: int, count: int, progress: Progress) -> Survey:
    looking = f"looking through {recording.path.name}"
    progress(looking, number, count)
    return recording.survey(lambda pictures: progress(f"{looking}: {pictures:,} pictures", number, count))


def standing_in(out: Path) -> Manifest | None:
    """The whole data set that is there already."""
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return None
    if not (out / DATASET_MANIFEST).is_file():
        raise UsageError(f"{str(out)!r} is there already and is no data set; name another folder with '--out DIR'.")
    return Dataset.open(out).manifest


def _write(
    out: Path, plan: ImportPlan, recordings: Sequence[Recording], options: ImportOptions, progress: Progress
) -> None:
    """Write beside ``out`` and move there."""
    recipe = plan.recipe
    with staged(out, UNFINISHED) as folder, DatasetWriter.create_or_resume(folder, recipe, plan.spec) as writer:
        numbered, by_source = dict(enumerate(recordings)), recipe.splits_by_source
        episodes = footage(numbered, plan.episodes, options, keep_times=plan.keeps_times, by_source=by_source)
        done = 0
        for shard in writer.missing:
            progress("importing", done, recipe.episodes)
            count = len(writer.episodes_of(shard))
            writer.write_shard(shard, itertools.islice(episodes, count))
            done += count
        progress("importing", done, recipe.episodes)
        writer.finish()


def footage(
    recordings: Mapping[int, Recording],
    planned: Sequence[PlannedEpisode],
    options: ImportOptions,
    *,
    keep_times: bool,
    by_source: bool,
) -> Iterator[Footage]:
    """Episodes in order, unpacked one at a time.

    Args:
        recordings: Those that they are of, surveyed already.
        planned: The episodes.
        options: How.
        keep_times: See ``ImportPlan.keeps_times``.
        by_source: Whether the data set is split by source.
    """
    for (number, segment), group in itertools.groupby(planned, key=lambda plan: (plan.recording, plan.segment)):
        plans = list(group)
        wanted = np.unique(np.concatenate([plan.piece.frames for plan in plans]))
        pictures = zip(wanted.tolist(), recordings[number].pictures(segment, wanted), strict=True)
        shown, frame = -1, np.zeros(0, np.uint8)
        for plan in plans:
            frames = np.empty((len(plan.piece), options.size, options.size, 3), np.uint8)
            for tick, source in enumerate(plan.piece.frames.tolist()):
                while shown < source:
                    shown, picture = next(pictures)
                    frame = fitted(picture, options.size, options.fit)
                frames[tick] = frame
            labels = None if plan.actions is None else unplaced_labels(plan.actions, frames.shape[:3])
            yield Footage(
                frames=frames,
                labels=labels,
                start_ns=int(plan.piece.t_ns[0]) if keep_times else None,
                source=plan.source if by_source else None,
            )
