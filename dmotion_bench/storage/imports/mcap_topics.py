"""Which topic of an MCAP file is meant, and what there is to choose from."""

from __future__ import annotations

import difflib
from collections.abc import Mapping, Sequence

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.imports.cameras import KNOWN, BadPicture, VideoPacket, is_camera, picture_decoder
from dmotion_bench.storage.imports.mcap_records import McapFile, TopicInfo
from dmotion_bench.storage.imports.pixels import size_of

LISTED = 30  # topics that an error names


def camera_topic(file: McapFile, topics: Sequence[TopicInfo], asked: str | None) -> str:
    """The camera's topic: the one asked for, or the only one whose pictures can be imported.

    Raises:
        RecordingImportError: There is no such topic, none at all, or several to choose from.
    """
    if asked is not None:
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
    near = difflib.get_close_matches(asked, names, n=1)
    hint = f"did you mean {near[0]!r}? " if near else ""
    raise RecordingImportError(f"{str(file.path)!r} has no topic {asked!r} for '--{option}'; {hint}{_listing(topics)}")


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
