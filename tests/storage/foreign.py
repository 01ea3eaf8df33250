"""Recordings written by other implementations: foxglove-sdk (Rust) and rosbags; never by dmbench."""

from __future__ import annotations

import base64
import io
import json
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
from foxglove.channels import CompressedImageChannel, RawImageChannel
from foxglove.mcap import MCAPWriteOptions
from foxglove.messages import CompressedImage, RawImage, Timestamp
from jaxtyping import UInt8
from PIL import Image
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

START = 1_700_000_000_000_000_000  # [ns]
ROS = get_typestore(Stores.ROS2_HUMBLE)


def video(count: int, height: int = 32, width: int = 32, seed: int = 0) -> UInt8[np.ndarray, "t h w 3"]:
    """Frames that all differ."""
    return np.random.default_rng(seed).integers(0, 256, (count, height, width, 3), dtype=np.uint8)


def steady(count: int, hz: float = 10.0) -> list[int]:
    """Times of a camera without jitter [ns]."""
    return [START + round(number * 1e9 / hz) for number in range(count)]


def packed(frame: UInt8[np.ndarray, "h w 3"], encoding: str) -> tuple[bytes, int]:
    """A frame in another encoding, and the bytes of a row; grey ones from its green."""
    opaque = np.full((*frame.shape[:2], 1), 255, np.uint8)
    pixels = {
        "rgb8": frame,
        "bgr8": frame[..., ::-1],
        "rgba8": np.concatenate([frame, opaque], axis=2),
        "bgra8": np.concatenate([frame[..., ::-1], opaque], axis=2),
        "mono8": frame[..., 1],
        "mono16": (frame[..., 1].astype("<u2") << 8 | 77).view(np.uint8),
    }[encoding]
    return pixels.tobytes(), pixels.reshape(len(frame), -1).shape[1]


def foxglove_file(
    path: Path,
    frames: Iterable[UInt8[np.ndarray, "h w 3"]],
    times: Sequence[int],
    *,
    encoding: str = "rgb8",
    topic: str = "/camera",
    actions: Sequence[tuple[int, Any]] = (),
    options: MCAPWriteOptions | None = None,
) -> Path:
    """foxglove.RawImage in protobuf; actions as JSON."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context, writer_options=options):
        camera = RawImageChannel(topic, context=context)
        for frame, t_ns in zip(frames, times, strict=True):
            data, step = packed(frame, encoding)
            camera.log(raw_image(t_ns, frame.shape[0], frame.shape[1], encoding, step, data), log_time=t_ns)
        if actions:
            commands = foxglove.Channel("/action", context=context)
            for t_ns, action in actions:
                commands.log({"action": action}, log_time=t_ns)
    return path


def raw_image(t_ns: int, height: int, width: int, encoding: str, step: int, data: bytes) -> RawImage:
    """One foxglove.RawImage."""
    return RawImage(
        timestamp=Timestamp(sec=t_ns // 10**9, nsec=t_ns % 10**9),
        frame_id="camera",
        height=height,
        width=width,
        encoding=encoding,
        step=step,
        data=data,
    )


def foxglove_json_file(path: Path, frames: Iterable[UInt8[np.ndarray, "h w 3"]], times: Sequence[int]) -> Path:
    """foxglove.RawImage in JSON, with the bytes in base64."""
    context = foxglove.Context()
    schema = foxglove.Schema(name="foxglove.RawImage", encoding="jsonschema", data=b'{"type": "object"}')
    with foxglove.open_mcap(path, context=context):
        camera = foxglove.Channel("/camera", schema=schema, message_encoding="json", context=context)
        for frame, t_ns in zip(frames, times, strict=True):
            message = {
                "timestamp": {"sec": t_ns // 10**9, "nsec": t_ns % 10**9},
                "frame_id": "camera",
                "width": frame.shape[1],
                "height": frame.shape[0],
                "encoding": "rgb8",
                "step": frame.shape[1] * 3,
                "data": base64.b64encode(frame.tobytes()).decode(),
            }
            camera.log(json.dumps(message), log_time=t_ns)
    return path


def compressed(frame: UInt8[np.ndarray, "h w 3"], kind: str, **options: Any) -> bytes:
    """A frame as a JPEG, PNG or WebP file."""
    file = io.BytesIO()
    Image.fromarray(frame).save(file, kind, **options)
    return file.getvalue()


def foxglove_compressed_file(path: Path, pictures: Iterable[bytes], times: Sequence[int], kind: str) -> Path:
    """foxglove.CompressedImage in protobuf."""
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        camera = CompressedImageChannel("/camera", context=context)
        for data, t_ns in zip(pictures, times, strict=True):
            stamp = Timestamp(sec=t_ns // 10**9, nsec=t_ns % 10**9)
            camera.log(CompressedImage(timestamp=stamp, frame_id="camera", data=data, format=kind), log_time=t_ns)
    return path


def ros_file(
    folder: Path,
    messages: Sequence[tuple[str, str, int, Any]],
    compression: CompressionMode = CompressionMode.NONE,
) -> Path:
    """A ROS 2 bag with MCAP storage; messages are topic, type, time, and the fields but the header."""
    bag = Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP)
    if compression is not CompressionMode.NONE:
        bag.set_compression(compression, CompressionFormat.ZSTD)
    with bag as writer:
        connections: dict[str, Any] = {}
        for topic, kind, t_ns, fields in messages:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, kind, typestore=ROS)
            message = ROS.types[kind](**fields)
            writer.write(connections[topic], t_ns, ROS.serialize_cdr(message, kind))
    (file,) = folder.glob("*.mcap*")
    return file


def ros_image(
    t_ns: int, height: int, width: int, encoding: str, step: int, data: bytes, frame_id: str = "camera"
) -> dict[str, Any]:
    """The fields of a sensor_msgs/msg/Image."""
    return {
        "header": ros_header(t_ns, frame_id),
        "height": height,
        "width": width,
        "encoding": encoding,
        "is_bigendian": 0,
        "step": step,
        "data": np.frombuffer(data, np.uint8),
    }


def ros_header(t_ns: int, frame_id: str = "camera") -> Any:
    """A std_msgs/msg/Header."""
    stamp = ROS.types["builtin_interfaces/msg/Time"](sec=t_ns // 10**9, nanosec=t_ns % 10**9)
    return ROS.types["std_msgs/msg/Header"](stamp=stamp, frame_id=frame_id)
