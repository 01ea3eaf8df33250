"""Lost pictures of an H.264 stream are told by the numbers of the others, whatever the encoder."""

from __future__ import annotations

import pytest
from storage.foreign_video import moving, packets

from dmotion_bench.storage.video.h264_numbers import PictureNumbers

LIVE = "repeat-headers=1:annexb=1:keyint=12:scenecut=0"
DISPOSABLE = 0x60
"""Bits of a unit's first byte that are zero if no other picture is drawn on top of its one."""


def lost(sent: list[bytes]) -> list[int]:
    numbers = PictureNumbers()
    return [place for place, packet in enumerate(sent) if numbers.is_one_lost(packet)]


@pytest.mark.parametrize(
    ("encoder", "pixels", "settings"),
    [
        ("libx264", "yuv420p", {"tune": "zerolatency", "x264-params": LIVE}),
        ("libx264", "yuv420p", {"x264-params": f"{LIVE}:bframes=3:b-pyramid=normal:ref=5"}),
        ("libx264", "yuv420p", {"profile": "baseline", "x264-params": f"{LIVE}:slices=4:bframes=0"}),
        ("libx264", "yuv444p", {"x264-params": f"{LIVE}:bframes=0"}),
        ("libx264", "yuv420p", {"x264-params": f"{LIVE}:intra-refresh=1:bframes=0"}),
        ("libx264", "yuv420p", {"x264-params": f"{LIVE}:interlaced=1"}),
        ("libx264rgb", "rgb24", {"qp": "0", "x264-params": f"{LIVE}:bframes=0"}),
    ],
)
def test_each_lost_reference_is_told_and_nothing_else(encoder: str, pixels: str, settings: dict[str, str]) -> None:
    sent = packets(moving(40), encoder, pixels, settings)
    assert lost(sent) == []
    for gone in (3, 7, 13, 14, 22):
        is_key = b"\x00\x00\x01\x65" in sent[gone + 1]
        is_reference = any(unit[:1] and unit[0] & DISPOSABLE and unit[0] & 31 == 1 for unit in _units(sent[gone]))
        assert lost(sent[:gone] + sent[gone + 1 :]) == ([gone] if is_reference and not is_key else [])
    assert lost(sent[:3] + sent[12:]) == ([] if b"\x00\x00\x01\x65" in sent[12] else [3])


def _units(packet: bytes) -> list[bytes]:
    return packet.split(b"\x00\x00\x01")[1:]


def test_a_stream_that_begins_in_its_middle_and_one_of_another_kind_tell_nothing() -> None:
    sent = packets(moving(30), "libx264", "yuv420p", {"tune": "zerolatency", "x264-params": LIVE})
    assert lost(sent[5:]) == []
    assert lost([b"", b"\x00\x00\x01", b"\x00\x00\x01\x67", b"\x00\x00\x01\x41" + bytes(200), b"\xff" * 50]) == []
