"""The options of an import, and its report."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from dmotion_bench.actions import ActionSpec
from dmotion_bench.errors import InvalidSetting
from dmotion_bench.storage.imports.continuous_commands import Reduce
from dmotion_bench.storage.imports.fitting import Fit
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.recording import Clock


@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """How recordings become episodes.

    Attributes:
        camera: Of the pictures: a topic (MCAP), a feature (LeRobot), a path (HDF5), a folder or a pattern of names
            (pictures), the number of a stream or the name of the files without suffix (video); None for the only one.
        actions: Topic or feature of the actions; None imports the video alone.
        action_fields: Fields with the numbers of continuous actions; a field with several numbers stands for them
            all. Without any, actions are discrete, unless the format says that they are continuous.
        action_reduce: What several continuous commands between two frames become.
        size: Side of a frame [px].
        hz: Frames a second.
        fit: What becomes of a picture that is not square.
        source_hz: Pictures a second of recordings without times; they have ``hz``, or what the file says, where this is
            None. It also replaces the times of a video.
        clock: Which time counts as the time of a frame.
        max_gap_s: A longer time without a picture ends an episode [s]; None: see ``timeline.longest_gap_ns``.
        min_frames: A shorter episode is left out.
        frames_per_episode: A longer one is cut into equal parts.
        seed: Of the split into training, validation and test.
        salvage: Take what stands before the damage in a damaged file, and for a damaged picture the one before it.
        skip_damaged: Leave out damaged episodes of recordings that hold several.
        limits: What a file may make us do.
    """

    camera: str | None = None
    actions: str | None = None
    action_fields: tuple[str, ...] = ()
    action_reduce: Reduce = Reduce.LAST
    size: int = 128
    hz: float = 10.0
    source_hz: float | None = None
    fit: Fit = Fit.CROP
    clock: Clock = Clock.LOG
    max_gap_s: float | None = None
    min_frames: int = 3
    frames_per_episode: int = 100
    seed: int = 0
    salvage: bool = False
    skip_damaged: bool = False
    limits: ImportLimits = field(default_factory=ImportLimits)

    def __post_init__(self) -> None:
        if self.actions is None and self.action_fields:
            raise InvalidSetting(
                "'--action-fields' names fields of the actions, and no actions are asked for; name their topic or "
                "feature with '--actions'."
            )
        if not all(self.action_fields) or len(set(self.action_fields)) < len(self.action_fields):
            raise InvalidSetting(
                f"'--action-fields {','.join(self.action_fields)}' has an empty field, or a field twice; name each "
                "once, such as '--action-fields linear.x,angular.z'."
            )
        for name, low, high in (
            ("size", 8, 4096),
            ("hz", 0.01, 1000),
            ("source_hz", 0.001, 10_000),
            ("min_frames", 3, 1_000_000),
            ("frames_per_episode", 3, 1_000_000),
            ("seed", 0, 2**63 - 1),
        ):
            value = getattr(self, name)
            if value is None and name == "source_hz":
                continue
            if value is None or not low <= value <= high:
                option = f"--{name.replace('_', '-')}"
                raise InvalidSetting(f"'{option}' is {value}; allowed is {low} ... {high}.")
        if self.max_gap_s is not None and not 0 < self.max_gap_s < math.inf:
            raise InvalidSetting(
                f"'--max-gap' is {self.max_gap_s}; a gap is longer than 0 s, and no recording is endless: give "
                "seconds, such as '--max-gap 0.5', or leave it out."
            )
        if self.min_frames > self.frames_per_episode:
            raise InvalidSetting(
                f"'--min-frames' is {self.min_frames}, and longer episodes than '--frames-per-episode' "
                f"{self.frames_per_episode} are cut: no episode would be left. Lower the one or raise the other."
            )


def options_from(fields: Mapping[str, Any]) -> ImportOptions:
    """Options out of what ``dataclasses.asdict`` and JSON have made of them."""
    given = dict(fields)
    limits = ImportLimits(**given.pop("limits"))
    fit, clock, reduce = Fit(given.pop("fit")), Clock(given.pop("clock")), Reduce(given.pop("action_reduce"))
    named = tuple(given.pop("action_fields"))
    return ImportOptions(fit=fit, clock=clock, action_reduce=reduce, action_fields=named, limits=limits, **given)


@dataclass(frozen=True, kw_only=True)
class ImportReport:
    """The result of an import.

    Attributes:
        path: The data set.
        episodes, frames: That it has.
        source_frames: Pictures in the recordings.
        source_height, source_width: Of the pictures [px].
        source_hz: Pictures a second in all recordings together, without pauses; 0 where that is not known.
        source_hz_range: The lowest and the highest rate of a recording.
        repeated: Frames that show the same picture as the one before, as the camera was slower than asked for.
        unreadable: Damaged pictures, in whose place the ones before them were taken; of this import, none if the data
            set was there already.
        left_out: Frames of episodes that were too short.
        actions: What they are; None without labels.
        may_hold_actions: Whether one of the recordings is of a kind that can hold actions.
        advice: Sentences about what would make a better data set of the same recordings.
        skipped: Recordings that were left out because they are damaged, and episodes of recordings (``PATH: NAME``),
            each with the reason.
    """

    path: Path
    episodes: int
    frames: int
    source_frames: int
    source_height: int
    source_width: int
    source_hz: float
    source_hz_range: tuple[float, float]
    repeated: int
    unreadable: int
    left_out: int
    actions: ActionSpec | None
    may_hold_actions: bool
    advice: tuple[str, ...]
    skipped: tuple[tuple[str, str], ...] = ()

    def __fspath__(self) -> str:
        """The data set's folder: what was imported may stand wherever a path may."""
        return str(self.path)
