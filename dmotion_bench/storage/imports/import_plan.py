"""What becomes of foreign recordings: the episodes, what the data set is called by, and what would be better.

Made from the recordings' surveys alone: no picture is unpacked for it.
"""

from __future__ import annotations

import itertools
import os
from collections import Counter
from collections.abc import Hashable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.specs import IMPORTED, SOURCE, SPLIT, UNPLACED_AGENT, DatasetRecipe, EnvSpec, Scalar
from dmotion_bench.storage.imports.advice import advice, no_episode
from dmotion_bench.storage.imports.continuous_commands import ContinuousCommands
from dmotion_bench.storage.imports.imported_actions import (
    Actions,
    action_spec,
    check_pace,
    commanded,
    constant_advice,
    discrete_names,
    given_commands,
    pace_advice,
    step_actions,
)
from dmotion_bench.storage.imports.options import ImportOptions, ImportReport
from dmotion_bench.storage.imports.overlaps import told_of_overlaps
from dmotion_bench.storage.imports.picture_sizes import have_one_shape, told_of_sizes, usual_size
from dmotion_bench.storage.imports.recording import Named, Survey
from dmotion_bench.storage.imports.search import Found
from dmotion_bench.storage.imports.source_rate import source_hz, source_hz_range
from dmotion_bench.storage.imports.sources import UNSALVAGED, WITHOUT_ACTIONS, Kind
from dmotion_bench.storage.imports.timeline import Piece, cut, resample
from dmotion_bench.storage.split import FEWEST_EPISODES

FILE: Final = "file_"
HASH: Final = "sha256_"
"""What the recipe calls the name and the hash of a recording, each with the recording's number."""
BAGS: Final = "bags"
"""What the recipe of a split by source calls the number of bags that are one source with several files."""


@dataclass(frozen=True, kw_only=True)
class PlannedEpisode:
    """A planned episode.

    Attributes:
        recording: The number of the recording that it is of.
        segment: The number of the segment in it.
        source: The number of the segment among all that episodes come of, which decides its side of the split; the
            files of one bag have one.
        piece: What it shows.
        actions: Of its steps; None for video alone.
    """

    recording: int
    segment: int
    source: int
    piece: Piece
    actions: Actions | None


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
    _check_cameras(recordings, surveys, options, found)
    _check_sizes(recordings, surveys)
    _check_depth(recordings, surveys)
    names = discrete_names(surveys, options)
    pieces = _pieces(surveys, options)
    planned, left_out = _plan(recordings, surveys, pieces, names, options, found.bags)
    overlaps = told_of_overlaps(recordings, surveys, found.bags)
    hints = [*found.told, *told_of_sizes(surveys, options.size), *overlaps]
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
    recipe = _recipe(recordings, surveys, planned, options, found.bags)
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
        advice=(*told, *constant_advice(spec.actions, [one.actions for one in planned]), *pace_advice(given, options)),
    )


def _check_cameras(
    recordings: Sequence[Named], surveys: Sequence[Survey], options: ImportOptions, found: Found
) -> None:
    """Check that recordings of one kind have one camera, unless it was chosen; each kind has names of its own."""
    kinds = {source.path: source.kind for source in found.sources}
    first = dict[Kind | None, tuple[Path, str]]()
    for recording, survey in zip(recordings, surveys, strict=True) if options.camera is None else ():
        path, camera = first.setdefault(kinds.get(recording.path), (recording.path, survey.camera))
        if survey.camera != camera:
            raise RecordingImportError(
                f"the recordings have different cameras: {camera!r} in {str(path)!r}, {survey.camera!r} in "
                f"{str(recording.path)!r}. A data set has one camera: name the recordings of one alone, or choose one "
                f"with '--camera {camera}' and leave the recordings without it out with '--skip-damaged'. If these are "
                "names of one camera, a part of the path that they share is enough for '--camera'."
            )


def _check_sizes(recordings: Sequence[Named], surveys: Sequence[Survey]) -> None:
    """Check that all pictures have one shape; their sizes may differ."""
    usual, _ = usual_size(surveys)
    sizes = [(survey.width, survey.height) for survey in surveys]
    for recording, (width, height) in zip(recordings, sizes, strict=True):
        if not have_one_shape((width, height), usual):
            raise RecordingImportError(
                f"the recordings mix pictures of different proportions: {usual[0]}x{usual[1]} pixels in "
                f"{str(recordings[sizes.index(usual)].path)!r}, {width}x{height} in {str(recording.path)!r}; "
                "import them into data sets of their own, or leave out those that differ with '--skip-damaged'."
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
    bags: Mapping[Path, Path],
) -> tuple[list[PlannedEpisode], int]:
    """The episodes, and how many frames are left out of all."""
    planned: list[PlannedEpisode] = []
    waiting, sources = iter(found), dict[Hashable, int]()
    for number, survey in enumerate(surveys):
        for index, segment in survey.numbered:
            pieces = next(waiting)
            if segment.commands is not None:
                pieces = [commanded(piece, segment.commands) for piece in pieces]
                check_pace(recordings[number], segment.commands, pieces, options)
            parts = cut(pieces, longest=options.frames_per_episode, shortest=options.min_frames)
            part = (number, index) if segment.source is None else (number, "source", segment.source)
            whole = bags.get(recordings[number].path, part)  # what the parts are of
            source = sources.setdefault(whole, len(sources)) if parts else 0
            for piece in parts:
                actions = None if segment.commands is None else step_actions(piece, segment.commands, names, options)
                one = PlannedEpisode(recording=number, segment=index, source=source, piece=piece, actions=actions)
                planned.append(one)
    return planned, sum(len(piece) for one in found for piece in one) - sum(len(plan.piece) for plan in planned)


def source_count(planned: Sequence[PlannedEpisode]) -> int:
    """From how many segments the episodes come; the files of one bag are one."""
    return len({one.source for one in planned})


def _as_text(name: str) -> str:
    """A file's name as UTF-8 can hold it: bytes that are no text, as of older disks, are written as ``\\xe9``."""
    return os.fsencode(name).decode("utf-8", "backslashreplace")


def _recipe(
    recordings: Sequence[Named],
    surveys: Sequence[Survey],
    planned: Sequence[PlannedEpisode],
    options: ImportOptions,
    bags: Mapping[Path, Path],
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
        heard = {recordings[one.recording].path for one in planned}
        parts = Counter(folder for path, folder in bags.items() if path in heard)
        if several := sum(count > 1 for count in parts.values()):
            parameters[BAGS] = several
    for number, recording in enumerate(recordings):
        parameters[f"{FILE}{number}"] = _as_text(recording.path.name)
        parameters[f"{HASH}{number}"] = recording.sha256()
    return DatasetRecipe(
        environment=IMPORTED,
        parameters=parameters,
        policy="recorded",
        seed=options.seed,
        episodes=len(planned),
        frames=options.frames_per_episode,
    )
