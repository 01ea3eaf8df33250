"""Foreign recordings -> a data set of the format ``dmbench/1``.

Two passes over every file: the first looks at times, sizes and actions and refuses what cannot be imported;
the second unpacks only the frames that are needed, one at a time. The data set is written beside its place and
moved there when it is whole, so a failed import leaves nothing behind.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np

from dmotion_bench.errors import RecipeMismatch, RecordingImportError, UsageError
from dmotion_bench.specs import IMPORTED, SOURCE, SPLIT, UNPLACED_AGENT, DatasetRecipe, EnvSpec, Scalar, unplaced_labels
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.advice import advice, no_episode
from dmotion_bench.storage.imports.confinement import Confinement
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands
from dmotion_bench.storage.imports.fitting import fitted
from dmotion_bench.storage.imports.imported_actions import (
    Actions,
    action_spec,
    check_pace,
    commanded,
    discrete_names,
    given_commands,
    pace_advice,
    step_actions,
)
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.recording import Named, Recording, Survey
from dmotion_bench.storage.imports.search import Found, find
from dmotion_bench.storage.imports.source_rate import source_hz, source_hz_range
from dmotion_bench.storage.imports.sources import UNSALVAGED, WITHOUT_ACTIONS, open_recording, require_effect
from dmotion_bench.storage.imports.timeline import Piece, cut, resample
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.shard import Footage
from dmotion_bench.storage.split import FEWEST_EPISODES
from dmotion_bench.storage.staging import staged, sweep
from dmotion_bench.storage.writer import DatasetWriter
from dmotion_bench.workspace import DATASET_MANIFEST

UNFINISHED: Final = ".importing"
FILE: Final = "file_"
HASH: Final = "sha256_"
"""What the recipe calls the name and the hash of a recording, each with the recording's number."""
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


@dataclass(frozen=True, kw_only=True)
class PlannedEpisode:
    """A planned episode.

    Attributes:
        recording: The number of the recording that it is of.
        segment: The number of the segment in it.
        source: The number of the segment among all that episodes come of, which decides its side of the split.
        piece: What it shows.
        actions: Of its steps; None for video alone.
    """

    recording: int
    segment: int
    source: int
    piece: Piece
    actions: Actions | None


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
        found = find(paths, options.camera)
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


@dataclass(frozen=True, kw_only=True)
class ImportPlan:
    """The data set that an import is to make.

    Attributes:
        recipe, spec: Of it.
        episodes: In their order.
        surveys: Of the recordings.
        left_out: Frames of episodes that are too short.
        may_hold_actions, advice: See ``ImportReport``.
    """

    recipe: DatasetRecipe
    spec: EnvSpec
    episodes: Sequence[PlannedEpisode]
    surveys: Sequence[Survey]
    left_out: int
    may_hold_actions: bool
    advice: tuple[str, ...]

    @property
    def keeps_times(self) -> bool:
        """Whether the episodes can have the times of their recordings, which then ascend through the data set."""
        return all(one.piece.t_ns[-1] < two.piece.t_ns[0] for one, two in itertools.pairwise(self.episodes))

    def report(self, out: Path, *, unreadable: int, skipped: tuple[tuple[str, str], ...] = ()) -> ImportReport:
        """What is told of the import into a folder."""
        return ImportReport(
            path=out,
            episodes=len(self.episodes),
            frames=sum(len(one.piece) for one in self.episodes),
            source_frames=sum(survey.pictures for survey in self.surveys),
            source_height=self.surveys[0].height,
            source_width=self.surveys[0].width,
            source_hz=source_hz(self.surveys),
            source_hz_range=source_hz_range(self.surveys),
            repeated=sum(int((np.diff(one.piece.frames) == 0).sum()) for one in self.episodes),
            unreadable=unreadable,
            left_out=self.left_out,
            actions=self.spec.actions,
            may_hold_actions=self.may_hold_actions,
            advice=self.advice,
            skipped=skipped,
        )


def plan_import(
    recordings: Sequence[Named], surveys: Sequence[Survey], options: ImportOptions, found: Found
) -> ImportPlan:
    """What becomes of recordings.

    Args:
        recordings: Those that are imported.
        surveys: Of them.
        options: How.
        found: What they were chosen from.

    Raises:
        RecordingImportError: They do not go together, or there is no episode in them.
    """
    _check_sizes(recordings, surveys)
    _check_depth(recordings, surveys)
    names = discrete_names(surveys, options)
    pieces = _pieces(surveys, options)
    planned, left_out = _plan(recordings, surveys, pieces, names, options)
    hints = list(found.told)
    if options.salvage and any(source.kind in UNSALVAGED for source in found.sources):
        hints.append(
            "'--salvage' does nothing for HDF5 files and LeRobot data sets; '--skip-damaged' leaves out their damaged "
            "episodes."
        )
    heard = {plan.recording for plan in planned}
    for number, recording in enumerate(recordings):
        if number not in heard and recording.path in found.doubts:
            raise RecordingImportError(found.doubts[recording.path])
    if not planned:
        raise no_episode(surveys, options, hints)
    recipe = _recipe(recordings, surveys, planned, options)
    _require_different(recordings, recipe)
    spec = EnvSpec(
        id=IMPORTED,
        actions=action_spec(surveys, [plan.actions for plan in planned], names, options),
        agent=UNPLACED_AGENT,
        objects=(),
        height=options.size,
        width=options.size,
        step_ns=round(1e9 / options.hz),
    )
    every = [one for some in pieces for one in some]
    told = advice(surveys, every, len(planned), source_count(planned), options, hints)
    commands = [{number: segment.commands for number, segment in survey.numbered} for survey in surveys]
    given = [(one.piece, commands[one.recording][one.segment]) for one in planned]
    return ImportPlan(
        recipe=recipe,
        spec=spec,
        episodes=planned,
        surveys=surveys,
        left_out=left_out,
        may_hold_actions=any(source.kind not in WITHOUT_ACTIONS for source in found.sources),
        advice=(*told, *pace_advice(given, options)),
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
    split = {SPLIT: wanted.parameters[SPLIT]} if wanted.splits_by_source and SPLIT not in known else {}
    if replace(standing, episodes=wanted.episodes, parameters={**known, **hashes, **split}) != wanted:
        return "a data set of other recordings or options"
    changed = [str(known[f"{FILE}{key.removeprefix(HASH)}"]) for key in hashes if hashes[key] != known[key]]
    if not changed and SPLIT in wanted.parameters.keys() - known.keys():
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


def _check_sizes(recordings: Sequence[Named], surveys: Sequence[Survey]) -> None:
    first = surveys[0]
    for recording, survey in zip(recordings, surveys, strict=True):
        if (survey.height, survey.width) != (first.height, first.width):
            raise RecordingImportError(
                f"the recordings mix picture sizes: {first.width}x{first.height} pixels in "
                f"{str(recordings[0].path)!r}, {survey.width}x{survey.height} in {str(recording.path)!r}; "
                "import them into data sets of their own."
            )


def _check_depth(recordings: Sequence[Named], surveys: Sequence[Survey]) -> None:
    """Check that pictures which may be depth are not mixed with others; alone they may be of a 16-bit camera."""
    deep = [recording for recording, survey in zip(recordings, surveys, strict=True) if survey.is_deep]
    others = [recording for recording, survey in zip(recordings, surveys, strict=True) if not survey.is_deep]
    if deep and others:
        raise RecordingImportError(
            f"the pictures in {str(deep[0].path)!r} are grey with 16 bits a pixel, as depth is stored, and those in "
            f"{str(others[0].path)!r} are not; depth is no picture: leave one out."
        )


def _require_different(recordings: Sequence[Named], recipe: DatasetRecipe) -> None:
    """Check that no recording is there twice: one copy could be trained on, and the other be a test."""
    first: dict[Scalar, int] = {}
    for number, recording in enumerate(recordings):
        same = first.setdefault(recipe.parameters[f"{HASH}{number}"], number)
        if same != number:
            raise RecordingImportError(
                f"{str(recordings[same].path)!r} and {str(recording.path)!r} are the same recording; leave one out."
            )


def _pieces(surveys: Sequence[Survey], options: ImportOptions) -> list[list[Piece]]:
    """Each segment's stretches without a gap, in the order of the recordings and their segments."""
    found: list[list[Piece]] = []
    most = options.limits.frames
    for segment in (segment for survey in surveys for segment in survey.segments):
        found.append(resample(segment.times_ns, hz=options.hz, max_gap_s=options.max_gap_s, most=most))
        most -= sum(map(len, found[-1]))
    return found


def _plan(
    recordings: Sequence[Named],
    surveys: Sequence[Survey],
    found: Sequence[list[Piece]],
    names: tuple[str, ...],
    options: ImportOptions,
) -> tuple[list[PlannedEpisode], int]:
    """The episodes, and how many frames are left out of all."""
    planned: list[PlannedEpisode] = []
    waiting, sources = iter(found), itertools.count()
    for number, survey in enumerate(surveys):
        for index, segment in survey.numbered:
            pieces = next(waiting)
            if segment.commands is not None:
                pieces = [commanded(piece, segment.commands) for piece in pieces]
                check_pace(recordings[number], segment.commands, pieces, options)
            parts = cut(pieces, longest=options.frames_per_episode, shortest=options.min_frames)
            source = next(sources) if parts else 0
            for piece in parts:
                actions = None if segment.commands is None else step_actions(piece, segment.commands, names, options)
                one = PlannedEpisode(recording=number, segment=index, source=source, piece=piece, actions=actions)
                planned.append(one)
    return planned, sum(len(piece) for one in found for piece in one) - sum(len(plan.piece) for plan in planned)


def source_count(planned: Sequence[PlannedEpisode]) -> int:
    """From how many segments the episodes come."""
    return len({one.source for one in planned})


def _recipe(
    recordings: Sequence[Named], surveys: Sequence[Survey], planned: Sequence[PlannedEpisode], options: ImportOptions
) -> DatasetRecipe:
    parameters: dict[str, Scalar] = {
        "camera": surveys[0].camera,
        "actions": options.actions or "",
        "size": options.size,
        "hz": options.hz,
        "fit": options.fit.value,
        "clock": options.clock.value,
        "max_gap_s": options.max_gap_s or 0.0,
        "min_frames": options.min_frames,
        "salvage": options.salvage,
    }
    if any(isinstance(commands, ContinuousCommands) for commands in given_commands(surveys)):
        parameters |= {"action_fields": ",".join(options.action_fields), "action_reduce": options.action_reduce.value}
    if options.source_hz is not None:
        parameters["source_hz"] = options.source_hz
    if FEWEST_EPISODES <= source_count(planned) < len(planned):
        parameters[SPLIT] = SOURCE
    for number, recording in enumerate(recordings):
        parameters[f"{FILE}{number}"] = recording.path.name
        parameters[f"{HASH}{number}"] = recording.sha256()
    return DatasetRecipe(
        environment=IMPORTED,
        parameters=parameters,
        policy="recorded",
        seed=options.seed,
        episodes=len(planned),
        frames=options.frames_per_episode,
    )


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
