"""Tiny recordings of every kind that can be imported, made by software that is not dmbench's."""

from __future__ import annotations

import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import zstandard

from tests.fuzz.command import dmbench

FRAMES = 14
SIDE = 16  # [px]
VIDEOS = (("h264", "mp4"), ("hevc", "mp4"), ("vp9", "webm"), ("ffv1", "mkv"), ("raw", "avi"))
"""Codec and container of the video files."""

Maker = Callable[[Path], Path]
"""Makes a recording in a folder."""


def makers() -> dict[str, Maker]:
    """By the names of the kinds."""
    sys.path.insert(0, str(Path(__file__).parents[1]))
    from storage.foreign import compressed, foxglove_compressed_file, foxglove_file, foxglove_json_file, steady, video

    frames, times = video(FRAMES, SIDE, SIDE), steady(FRAMES)
    actions = [(t_ns, ("left", "right")[number % 2]) for number, t_ns in enumerate(times)]

    def packed(folder: Path) -> Path:
        plain = foxglove_file(folder / "plain.mcap", frames, times, actions=actions)
        file = folder / "a.mcap.zst"
        file.write_bytes(zstandard.ZstdCompressor().compress(plain.read_bytes()))
        return file

    def pictures(kind: str, folder: Path) -> Path:
        shown = [compressed(frame, kind.upper()) for frame in frames]
        return foxglove_compressed_file(folder / "a.mcap", shown, times, kind)

    def folder_of_pictures(folder: Path) -> Path:
        for number, frame in enumerate(frames):
            file = folder / "pictures" / f"episode_{number // 7}" / f"{number}.{('png', 'jpg')[number // 7]}"
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_bytes(compressed(frame, ("PNG", "JPEG")[number // 7]))
        return folder / "pictures"

    def lerobot(folder: Path) -> Path:
        file = foxglove_file(folder / "source.mcap", frames, times, actions=actions)
        words = ("--size", str(SIDE), "--actions", "/action", "--frames-per-episode", "5")
        dmbench("data", "import", str(file), *words, "--out", str(folder / "source")).done()
        dmbench("data", "export", str(folder / "source"), "--out", str(folder / "lerobot")).done()
        return folder / "lerobot"

    return {
        "foxglove": lambda folder: foxglove_file(folder / "a.mcap", frames, times, actions=actions),
        "bgra": lambda folder: foxglove_file(folder / "a.mcap", frames, times, encoding="bgra8"),
        "json": lambda folder: foxglove_json_file(folder / "a.mcap", frames, times),
        "jpeg": partial(pictures, "jpeg"),
        "png": partial(pictures, "png"),
        "packed": packed,
        "ros": partial(_ros, frames, times, actions),
        "ros-compressed": partial(_ros_compressed, frames, times),
        "stream": partial(_stream, frames, times),
        "pictures": folder_of_pictures,
        "hdf5": partial(_hdf5, frames),
        "lerobot": lerobot,
        **{f"{kind}.{suffix}": partial(_video, frames, kind, suffix) for kind, suffix in VIDEOS},
    }


def _ros(frames: np.ndarray, times: list[int], actions: list[tuple[int, str]], folder: Path) -> Path:
    """A bag of raw pictures, blue first, and of actions."""
    from storage.foreign import ros_file, ros_image

    messages: list[Any] = []
    for frame, t_ns, (_, action) in zip(frames, times, actions, strict=True):
        image = ros_image(t_ns, SIDE, SIDE, "bgr8", SIDE * 3, frame[..., ::-1].tobytes())
        messages.append(("/camera", "sensor_msgs/msg/Image", t_ns, image))
        messages.append(("/action", "std_msgs/msg/String", t_ns, {"data": action}))
    return ros_file(folder / "bag", messages)


def _ros_compressed(frames: np.ndarray, times: list[int], folder: Path) -> Path:
    """A bag of JPEG pictures."""
    from storage.foreign import compressed, ros_file, ros_header

    messages = []
    for frame, t_ns in zip(frames, times, strict=True):
        data = np.frombuffer(compressed(frame, "JPEG"), np.uint8)
        fields = {"header": ros_header(t_ns), "format": "jpeg", "data": data}
        messages.append(("/camera", "sensor_msgs/msg/CompressedImage", t_ns, fields))
    return ros_file(folder / "bag", messages)


def _stream(frames: np.ndarray, times: list[int], folder: Path) -> Path:
    """foxglove.CompressedVideo: H.264, a packet a picture."""
    import foxglove
    from foxglove.channels import CompressedVideoChannel
    from foxglove.messages import CompressedVideo, Timestamp
    from storage.foreign_video import packets

    sent, context = (
        packets(frames, "libx264rgb", "rgb24", {"qp": "0", "g": "5", "tune": "zerolatency"}),
        foxglove.Context(),
    )
    with foxglove.open_mcap(folder / "a.mcap", context=context):
        camera = CompressedVideoChannel("/video", context=context)
        for data, t_ns in zip(sent, times, strict=True):
            stamp = Timestamp(sec=t_ns // 10**9, nsec=t_ns % 10**9)
            message = CompressedVideo(timestamp=stamp, frame_id="camera", data=data, format="h264")
            camera.log(message, log_time=t_ns)
    return folder / "a.mcap"


def _hdf5(frames: np.ndarray, folder: Path) -> Path:
    """robomimic's layout, packed and plain."""
    with h5py.File(folder / "a.hdf5", "w") as file:
        data = file.create_group("data")
        data.attrs["total"] = len(frames)
        data.attrs["env_args"] = '{"env_name": "Lift", "env_kwargs": {"control_freq": 10}}'
        for name, part, packing in (("demo_0", frames[:7], {"compression": "gzip"}), ("demo_1", frames[7:], {})):
            group = data.create_group(name)
            group.attrs["num_samples"] = len(part)
            group.create_dataset("obs/agentview_image", data=part, **packing)
            group.create_dataset("obs/robot0_eef_pos", data=np.zeros((len(part), 3)))
            group.create_dataset("actions", data=np.arange(len(part)) % 3)
    return folder / "a.hdf5"


def _video(frames: np.ndarray, kind: str, suffix: str, folder: Path) -> Path:
    """A video file without loss."""
    from storage.foreign_video import video_file

    return video_file(folder / f"a.{suffix}", frames, kind)
