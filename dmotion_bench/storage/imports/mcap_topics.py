"""Which topic of an MCAP file is meant, and what there is to choose from."""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Mapping, Sequence
from typing import Final

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import KNOWN, BadPicture, VideoPacket, is_camera, picture_decoder
from dmotion_bench.storage.imports.mcap_records import McapFile, TopicInfo
from dmotion_bench.storage.imports.pixels import size_of

LISTED: Final = 30  # topics that an error names
MEANT: Final = 3  # topics that are suggested


def camera_topic(file: McapFile, topics: Sequence[TopicInfo], asked: str | None) -> str:
    """The camera's topic: the one asked for, or the only one whose pictures can be imported.

    A part of the topic's path is enough where no other camera has it: ``front`` for ``/front/image_raw``.

    Raises:
        RecordingImportError: There is no such topic, none at all, or several to choose from.
    """
    if asked is not None:
        within = topics_with([topic.topic for topic in topics if is_camera(topic)], asked)
        if len(within) == 1 and all(topic.topic != asked for topic in topics):
            return within[0]
        return named_topic(file, topics, asked, "camera")
    cameras = sorted({topic.topic for topic in topics if is_camera(topic)})
    if not cameras:
        raise RecordingImportError(
            f"{str(file.path)!r} has no camera topic that can be imported ({KNOWN}); {_listing(topics)}"
        )
    unfit = {} if len(cameras) == 1 else _unfit(file, cameras)
    fit = [camera for camera in cameras if camera not in unfit]
    if len(fit) == 1:
        return fit[0]
    reasons = "".join(f"\n  not {topic!r}: it {reason}" for topic, reason in list(unfit.items())[:LISTED])
    if not fit:
        raise RecordingImportError(f"{str(file.path)!r} has no camera that can be imported:{reasons}")
    choices = "".join(f"\n  --camera {topic!r}" for topic in fit[:LISTED])
    raise RecordingImportError(f"{str(file.path)!r} has {len(fit)} camera topics; choose one:{choices}{reasons}")


def named_topic(file: McapFile, topics: Sequence[TopicInfo], asked: str, option: str) -> str:
    """The topic of this name.

    Raises:
        RecordingImportError: There is none.
    """
    names = sorted({topic.topic for topic in topics})
    if asked in names:
        return asked
    fit = [topic.topic for topic in topics if option != "camera" or is_camera(topic)]
    near = topics_with(fit, asked)[:MEANT] or difflib.get_close_matches(asked, names, n=1)
    hint = f"did you mean {' or '.join(map(repr, near))}? " if near else ""
    raise RecordingImportError(f"{str(file.path)!r} has no topic {asked!r} for '--{option}'; {hint}{_listing(topics)}")


def topics_with(names: Iterable[str], part: str) -> list[str]:
    """The topics whose path holds these whole parts: ``front`` or ``front/image_raw`` that of ``/front/image_raw``.

    A topic that differs in slashes at its ends alone is the only one.
    """
    bare = part.strip("/")
    within = sorted({name for name in names if bare and f"/{bare}/" in f"/{name.strip('/')}/"})
    return [name for name in within if name.strip("/") == bare] or within


def is_stream(file: McapFile, camera: str) -> bool:
    """Whether a camera's first message is a packet of a video, not a picture of its own."""
    for message in file.messages(camera):
        try:
            return isinstance(picture_decoder(message.topic)(message.data), VideoPacket)
        except BadPicture:
            return False
    return False


def _unfit(file: McapFile, cameras: Sequence[str]) -> Mapping[str, str]:
    """The cameras whose first picture cannot be imported, such as depth, with the reason."""
    unfit = dict.fromkeys(cameras, "has no messages")
    waiting = set(cameras)
    for message in file.messages(*cameras):
        topic = message.topic.topic
        if topic not in waiting:
            continue
        waiting.remove(topic)
        try:
            picture = picture_decoder(message.topic)(message.data)
            if not isinstance(picture, VideoPacket):
                size_of(picture, file.limits)
            del unfit[topic]
        except BadPicture as error:
            unfit[topic] = str(error).partition("; known are")[0]
        except RecordingImportError as error:
            unfit[topic] = str(error).partition(" carries ")[2] or "cannot be decoded"
        if not waiting:
            break
    return unfit


def _listing(topics: Sequence[TopicInfo]) -> str:
    if not topics:
        return "it has no topics at all."
    shown = "".join(
        f"\n  {topic.topic!r} {topic.schema_name or topic.message_encoding}{' (camera)' if is_camera(topic) else ''}"
        for topic in sorted(topics, key=lambda topic: (not is_camera(topic), topic.topic))[:LISTED]
    )
    more = f"\n  ... and {len(topics) - LISTED} more" if len(topics) > LISTED else ""
    return f"its topics are:{shown}{more}"
