"""A shard: a fixed group of episodes in two files, the video's and the labels', each written whole or not at all.

A shard describes itself: each episode's number, seed and length stand in MCAP metadata records, so the tables
of a data set can be made again from its shards alone. ``write_shard`` and ``scan_shard`` give the same receipt.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import BinaryIO, Final, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import UInt8

from dmotion_bench.errors import DatasetError
from dmotion_bench.specs import IMPORTED, DatasetRecipe, EnvSpec, Episode, EpisodeLabels, delay_of
from dmotion_bench.storage.atomic import atomic_file
from dmotion_bench.storage.limits import LAST_NS, MOST_EPISODES, MOST_SHARD_EPISODES, longest_episode, most_frames
from dmotion_bench.storage.mcap_reader import DamagedFile, Room, Section, list_sections, read_messages
from dmotion_bench.storage.mcap_writer import McapWriter, Span
from dmotion_bench.storage.messages import (
    StateLabels,
    chunk_limit,
    decode_states,
    decode_video,
    encode_masks,
    encode_states,
    encode_video,
)
from dmotion_bench.storage.schema import VIDEO_CHANNELS, label_channels
from dmotion_bench.storage.tasks import Candidate, candidates, picture_candidates
from dmotion_bench.wording import shown

VIDEO: Final = "video"
LABELS: Final = "labels"
PAUSE_FRAMES: Final = 10  # between two episodes on the clock of a recording, so that viewers show the cut
Ended = Literal["truncated", "terminated"]


@dataclass(frozen=True, kw_only=True)
class Footage:
    """An imported episode, whose labels may be missing.

    Attributes:
        frames: RGB, 0-255.
        labels: None for video alone.
        seed: Of the environment, where one made it.
        ended: Why it ended.
        start_ns: When it started; None puts it on the clock of the recording.
        source: The number of the recording that it is a part of, where the recipe splits by source.
    """

    frames: UInt8[np.ndarray, "t h w 3"]
    labels: EpisodeLabels | None = None
    seed: int = 0
    ended: Ended = "truncated"
    start_ns: int | None = None
    source: int | None = None


@dataclass(frozen=True, kw_only=True)
class EpisodeRow:
    """Where an episode is and how it came about: a row of ``episodes.parquet``.

    Attributes:
        episode, shard: Numbers, from 0.
        frames: How many.
        start_ns: The first frame's time stamp.
        seed: Of the environment.
        ended: Why it ended.
        interactions: Steps in which an object moved; 0 where that is not known.
        video, states, masks: Where they stand in their files; of size 0 where there are no labels.
        source: The number of the recording that it is a part of; None where the split is by episode.
    """

    episode: int
    shard: int
    frames: int
    start_ns: int
    seed: int
    ended: Ended
    interactions: int
    video: Span
    states: Span
    masks: Span
    source: int | None = None


class FileFacts(NamedTuple):
    """A file's size [bytes] and SHA-256, in hexadecimal."""

    size: int
    sha256: str


@dataclass(frozen=True, kw_only=True)
class ShardReceipt:
    """The facts of a shard that the data set's tables need.

    Attributes:
        index: Its number.
        rows: One an episode.
        video, labels: Its files; no labels for imported video.
        candidates: For each episode, what could be a control task.
    """

    index: int
    rows: tuple[EpisodeRow, ...]
    video: FileFacts
    labels: FileFacts | None
    candidates: tuple[tuple[Candidate, ...], ...]

    @property
    def frames(self) -> int:
        """Frames in the shard."""
        return sum(row.frames for row in self.rows)


def shard_path(dataset: Path, kind: str, index: int) -> Path:
    """Where a shard's file is."""
    return dataset / kind / f"shard-{index:05d}.mcap"


def shard_range(recipe: DatasetRecipe, index: int) -> range:
    """The episodes of a shard; the last may have fewer."""
    start = index * recipe.shard_episodes
    return range(start, min(start + recipe.shard_episodes, recipe.episodes))


def shard_count(recipe: DatasetRecipe) -> int:
    """How many shards a data set has."""
    return -(-recipe.episodes // recipe.shard_episodes)


class _Hashing:
    """Passes bytes on to a file and hashes them on the way."""

    def __init__(self, file: BinaryIO) -> None:
        self._file, self._hash, self._size = file, hashlib.sha256(), 0

    def write(self, data: bytes) -> int:
        self._hash.update(data)
        self._size += len(data)
        return self._file.write(data)

    def facts(self) -> FileFacts:
        return FileFacts(self._size, self._hash.hexdigest())


def _shard_file(path: Path) -> contextlib.AbstractContextManager[BinaryIO]:
    """A shard's file to write; the data set's own folder must be there."""
    path.parent.mkdir(exist_ok=True)
    return atomic_file(path, make_folders=False)


def write_shard(
    dataset: Path, recipe: DatasetRecipe, spec: EnvSpec, index: int, episodes: Iterable[Episode | Footage]
) -> ShardReceipt:
    """Write the files of a shard; they appear, the labels first, when both are whole.

    Args:
        dataset: The data set's folder.
        recipe, spec: The data set's.
        index: The shard's number.
        episodes: Those of ``shard_range``, in order; either all or none have labels.

    Raises:
        FileNotFoundError: The data set's folder is gone; it is not made again, as what it held is lost.
    """
    rows, found = list[EpisodeRow](), list[tuple[Candidate, ...]]()
    video_path, labels_path = (shard_path(dataset, kind, index) for kind in (VIDEO, LABELS))
    with contextlib.ExitStack() as files:
        video_file = _Hashing(files.enter_context(_shard_file(video_path)))
        video = McapWriter(video_file, VIDEO_CHANNELS)
        labels_file: _Hashing | None = None
        labels: McapWriter | None = None
        for number, episode in zip(shard_range(recipe, index), episodes, strict=True):
            if episode.labels is not None and labels is None and not rows:
                labels_file = _Hashing(files.enter_context(_shard_file(labels_path)))
                labels = McapWriter(labels_file, label_channels(spec.actions))
            if (episode.labels is None) != (labels is None):
                raise ValueError("either all episodes of a shard have labels or none has")
            start_ns = number * (recipe.frames + PAUSE_FRAMES) * spec.step_ns
            if isinstance(episode, Footage) and episode.start_ns is not None:
                start_ns = episode.start_ns
            if not 0 <= start_ns <= LAST_NS - len(episode.frames) * spec.step_ns:
                raise DatasetError(f"episode {number} starts at {start_ns} ns, which no time stamp of MCAP can say.")
            facts = {
                "episode": str(number),
                "frames": str(len(episode.frames)),
                "seed": str(episode.seed),
                "ended": episode.ended,
                "start_ns": str(start_ns),
            }
            source = episode.source if isinstance(episode, Footage) else None
            if source is not None:
                facts["source"] = str(source)
            video.metadata(f"episode {number}", facts)
            spans = [video.chunks(encode_video(episode.frames, start_ns, spec.step_ns)), Span(0, 0), Span(0, 0)]
            interactions, possible = 0, tuple[Candidate, ...]()
            if labels is not None and episode.labels is not None:
                truth, step_ns = episode.labels, spec.step_ns
                labels.metadata(f"states {number}", {"episode": str(number)})
                spans[1] = labels.chunks(encode_states(truth, spec, start_ns, step_ns))
                labels.metadata(f"masks {number}", {"episode": str(number)})
                spans[2] = labels.chunks(encode_masks(truth.masks, start_ns, step_ns))
                interactions = int(truth.pushed.sum())
                possible = _possible_tasks(spec, truth, episode.frames)
            rows.append(
                EpisodeRow(
                    episode=number,
                    shard=index,
                    frames=len(episode.frames),
                    start_ns=start_ns,
                    seed=episode.seed,
                    ended=episode.ended,
                    interactions=interactions,
                    video=spans[0],
                    states=spans[1],
                    masks=spans[2],
                    source=source,
                )
            )
            found.append(possible)
        for writer in (video, labels):
            if writer is not None:
                writer.finish()
        video_facts, label_facts = video_file.facts(), labels_file.facts() if labels_file else None
    if label_facts is None:
        labels_path.unlink(missing_ok=True)
    return ShardReceipt(index=index, rows=tuple(rows), video=video_facts, labels=label_facts, candidates=tuple(found))


def _judged_by_pictures(spec: EnvSpec) -> bool:
    """Whether tasks are chosen by what is seen: nothing tells where objects are, and there is somewhere to act."""
    return not spec.objects and spec.id != IMPORTED


def _possible_tasks(
    spec: EnvSpec, labels: EpisodeLabels | StateLabels, frames: UInt8[np.ndarray, "t h w 3"] | None
) -> tuple[Candidate, ...]:
    """What could be control tasks in an episode."""
    if _judged_by_pictures(spec):
        return () if frames is None else picture_candidates(frames)
    delay = delay_of(labels.factors)
    return candidates(labels.objects.position, labels.pushed, spec.push_threshold, delay=delay)


def scan_shard(dataset: Path, spec: EnvSpec, index: int, *, labelled: bool = True) -> ShardReceipt:
    """The receipt of an existing shard, read from its files.

    Args:
        dataset: The data set's folder.
        spec: The data set's.
        index: The shard's number.
        labelled: Whether its labels are read, if they are there; False where ``dataset.json`` knows of none.

    Raises:
        DamagedFile: The files are not whole or do not belong together.
    """
    video_path, labels_path = (shard_path(dataset, kind, index) for kind in (VIDEO, LABELS))
    videos = list_sections(video_path, most=MOST_SHARD_EPISODES)
    has_labels = labelled and labels_path.is_file()
    sections = list_sections(labels_path, most=2 * MOST_SHARD_EPISODES) if has_labels else []
    states = {one.values.get("episode"): one for one in sections if one.kind == "states"}
    masks = {one.values.get("episode"): one for one in sections if one.kind == "masks"}
    rows, found = list[EpisodeRow](), list[tuple[Candidate, ...]]()
    for section in videos:
        row = episode_row(section, index, spec)
        possible: tuple[Candidate, ...] = ()
        if has_labels:
            number = section.values["episode"]
            if number not in states or number not in masks:
                raise DamagedFile(f"has no labels for episode {number}")
            truth = read_states(labels_path, states[number].span, spec, row.frames)
            pictures = read_video(video_path, row.video, spec, row.frames) if _judged_by_pictures(spec) else None
            possible = _possible_tasks(spec, truth, pictures)
            row = replace(
                row,
                states=states[number].span,
                masks=masks[number].span,
                interactions=int(truth.pushed.sum()),
            )
        rows.append(row)
        found.append(possible)
    return ShardReceipt(
        index=index,
        rows=tuple(rows),
        video=file_facts(video_path),
        labels=file_facts(labels_path) if has_labels else None,
        candidates=tuple(found),
    )


def episode_row(section: Section, index: int, spec: EnvSpec) -> EpisodeRow:
    """The table row of an episode from its section of the video file, without the place of its labels."""
    values: Mapping[str, str] = section.values
    if section.kind != "episode":
        raise DamagedFile(f"holds a section {section.name!r} where an episode was expected")
    try:
        row = EpisodeRow(
            episode=int(values["episode"]),
            shard=index,
            frames=int(values["frames"]),
            start_ns=int(values["start_ns"]),
            seed=int(values["seed"]),
            ended=ended_as(values["ended"]),
            interactions=0,
            video=section.span,
            states=Span(0, 0),
            masks=Span(0, 0),
            source=int(values["source"]) if "source" in values else None,
        )
    except (KeyError, ValueError) as error:
        raise DamagedFile(f"holds a section that describes no episode: {error}") from None
    if row.frames > most_frames(spec):
        raise DamagedFile(f"holds an episode of {shown(row.frames)} frames; {longest_episode(spec)}")
    if (
        not 0 <= row.episode < MOST_EPISODES
        or row.frames < 1
        or not 0 <= row.seed <= LAST_NS
        or not 0 <= row.start_ns <= LAST_NS - row.frames * spec.step_ns
        or not 0 <= (row.source or 0) < MOST_EPISODES
    ):
        raise DamagedFile(f"holds a section that describes no episode: {shown(dict(values))}")
    return row


def ended_as(word: str) -> Ended:
    """The word, if it is a reason why an episode ended."""
    for known in get_args(Ended):
        if word == known:
            ended: Ended = known
            return ended
    raise ValueError(f"{shown(word)} is no way to end")


def read_states(path: Path, span: Span, spec: EnvSpec, frames: int) -> StateLabels:
    """An episode's labels without its masks."""
    return decode_states(read_messages(path, span, chunk_limit=chunk_limit(spec)), spec, frames)


def read_video(
    path: Path, span: Span, spec: EnvSpec, frames: int, room: Room | None = None
) -> UInt8[np.ndarray, "t h w 3"]:
    """An episode's frames; ``room`` is where the file's chunks are unpacked."""
    pictures = np.empty((frames, spec.height, spec.width, 3), np.uint8)
    decode_video(read_messages(path, span, chunk_limit=chunk_limit(spec), room=room), pictures)
    return pictures


def file_facts(path: Path) -> FileFacts:
    """Size and hash of a file, read a piece at a time."""
    with path.open("rb") as file:
        digest = hashlib.file_digest(file, "sha256").hexdigest()
    return FileFacts(path.stat().st_size, digest)
