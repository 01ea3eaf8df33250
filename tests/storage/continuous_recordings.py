"""Recordings with continuous commands, written by other implementations, and their import."""

from __future__ import annotations

import json
import struct
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import foxglove
import numpy as np
import pytest
from foxglove.channels import RawImageChannel
from storage.foreign import ROS, raw_image, ros_file, ros_image, steady, video

from dmotion_bench.errors import RecordingImportError
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.dataset import Dataset
from dmotion_bench.storage.imports.importing import import_recordings
from dmotion_bench.storage.imports.options import ImportOptions

TWIST = ImportOptions(size=32, actions="/cmd_vel", action_fields=("linear.x", "angular.z"))
AWKWARD = [0.1, -0.0, 1 / 3, -5e-324, 1.7976931348623157e300, 123456789.000001]
"""Numbers that do not survive a detour through text of few digits or through 32 bits."""


def twist(x: float, z: float) -> dict[str, Any]:
    vector = ROS.types["geometry_msgs/msg/Vector3"]
    return {"linear": vector(x=x, y=0.0, z=0.0), "angular": vector(x=0.0, y=0.0, z=z)}


def bag(
    folder: Path, kind: str, commands: Sequence[tuple[int, dict[str, Any]]], frames: int, topic: str = "/cmd_vel"
) -> Path:
    """A camera at 10 Hz, and commands at their times [ns]."""
    pictures = [
        ("/camera", "sensor_msgs/msg/Image", t_ns, ros_image(t_ns, 32, 32, "rgb8", 96, frame.tobytes()))
        for t_ns, frame in zip(steady(frames), video(frames), strict=True)
    ]
    given = [(topic, kind, t_ns, fields) for t_ns, fields in commands]
    return ros_file(folder, sorted([*pictures, *given], key=lambda message: message[2]))


def twists(folder: Path, numbers: Sequence[float], delay_ns: int = 5_000_000) -> Path:
    """A twist for each step."""
    times = steady(len(numbers))
    given = [(t_ns + delay_ns, twist(x, -x)) for t_ns, x in zip(times, numbers, strict=True)]
    return bag(folder, "geometry_msgs/msg/Twist", given, len(numbers) + 1)


def json_file(path: Path, commands: Sequence[Any], frames: int | None = None) -> Path:
    context = foxglove.Context()
    with foxglove.open_mcap(path, context=context):
        camera = RawImageChannel("/camera", context=context)
        for t_ns in steady(frames or len(commands) + 1):
            camera.log(raw_image(t_ns, 4, 4, "rgb8", 12, bytes(48)), log_time=t_ns)
        channel = foxglove.Channel("/cmd_vel", message_encoding="json", context=context)
        for t_ns, command in zip(steady(len(commands)), commands, strict=True):
            text = command if isinstance(command, bytes) else json.dumps(command).encode()
            channel.log(text, log_time=t_ns + 1)
    return path


def imported(path: Path, folder: Path, options: ImportOptions = TWIST) -> Dataset:
    dataset = Dataset.open(import_recordings([path], folder, options).path)
    assert not check_dataset(dataset.path).damages
    return dataset


def refused(path: Path, match: str, options: ImportOptions = TWIST) -> None:
    out = path.parent / "refused"
    with pytest.raises(RecordingImportError, match=match) as caught:
        import_recordings([path], out, options)
    assert not list(path.parent.glob("refused*"))
    assert "\x1b" not in str(caught.value)


def bits(values: Any) -> list[bytes]:
    return [struct.pack("<d", number) for number in np.asarray(values, np.float64).reshape(-1)]
