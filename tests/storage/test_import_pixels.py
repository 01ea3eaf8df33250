"""Unpacking against independent implementations: scipy for the demosaic, the colour equations for YUV."""

from __future__ import annotations

import tracemalloc
from io import BytesIO

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from PIL import Image
from scipy.ndimage import convolve
from storage.foreign import compressed, video

from dmotion_bench.storage.imports import pixels
from dmotion_bench.storage.imports.cameras import BadPicture, CompressedPicture, RawPicture
from dmotion_bench.storage.imports.fitting import Fit, fitted
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.pixels import WIDE, demosaic, size_of, to_rgb

LIMITS = ImportLimits()
PATTERNS = ["rggb", "bggr", "gbrg", "grbg"]
GREEN = np.array([[0, 1, 0], [1, 4, 1], [0, 1, 0]]) / 4
SIXTEEN_BITS = compressed(np.full((4, 4), 256 * 9 + 77, np.uint16), "png")
QUALITY: dict[str, dict[str, int]] = {"png": {}, "jpeg": {"quality": 100}}
OTHER = np.array([[1, 2, 1], [2, 4, 2], [1, 2, 1]]) / 4


def raw(encoding: str, data: bytes, height: int, width: int, step: int = 0, big_endian: bool = False) -> RawPicture:
    return RawPicture(
        stamp_ns=0, width=width, height=height, encoding=encoding, step=step, big_endian=big_endian, data=data
    )


def mosaic_of(frame: np.ndarray, pattern: str) -> np.ndarray:
    mosaic = np.empty(frame.shape[:2], np.uint8)
    for place, letter in enumerate(pattern):
        rows, columns = slice(place // 2, None, 2), slice(place % 2, None, 2)
        mosaic[rows, columns] = frame[rows, columns, "rgb".index(letter)]
    return mosaic


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize(("height", "width"), [(8, 10), (7, 5), (2, 2)])
def test_demosaic_is_bilinear(pattern: str, height: int, width: int) -> None:
    mosaic = mosaic_of(video(1, height, width)[0], pattern)
    expected = np.empty((height, width, 3))
    for channel, letter in enumerate("rgb"):
        plane = np.zeros((height, width))
        for place in range(4):
            if pattern[place] == letter:
                rows, columns = slice(place // 2, None, 2), slice(place % 2, None, 2)
                plane[rows, columns] = mosaic[rows, columns]
        expected[..., channel] = convolve(plane, GREEN if letter == "g" else OTHER, mode="mirror")
    np.testing.assert_array_equal(demosaic(mosaic, pattern), np.floor(expected + 0.5).astype(np.uint8))


@given(colour=st.tuples(*[st.integers(0, 255)] * 3), pattern=st.sampled_from(PATTERNS))
@settings(deadline=None, derandomize=True, max_examples=40)
def test_demosaic_keeps_one_colour_exactly(colour: tuple[int, int, int], pattern: str) -> None:
    frame = np.broadcast_to(np.array(colour, np.uint8), (6, 8, 3))
    picture = raw(f"bayer_{pattern}8", mosaic_of(frame, pattern).tobytes(), 6, 8)
    np.testing.assert_array_equal(to_rgb(picture, LIMITS), frame)


@pytest.mark.parametrize(("encoding", "places"), [("uyvy", (1, 0, 3, 2)), ("yuv422_yuy2", (0, 1, 2, 3))])
def test_yuv_keeps_colours(encoding: str, places: tuple[int, ...]) -> None:
    colours = np.array([[255, 0, 0], [0, 255, 0], [0, 0, 255], [200, 180, 30], [128, 128, 128]], np.float64)
    luma = colours @ [0.299, 0.587, 0.114]
    blue, red = 128 + (colours[:, 2] - luma) / 1.772, 128 + (colours[:, 0] - luma) / 1.402
    pairs = np.rint(np.stack([luma, blue, luma, red], axis=1)).clip(0, 255).astype(np.uint8)[:, list(places)]
    got = to_rgb(raw(encoding, pairs.tobytes(), 5, 2), LIMITS)
    assert np.abs(got.astype(float) - colours[:, None]).max() <= 2


def test_a_png_file_of_mono16_keeps_its_upper_8_bits() -> None:
    picture = CompressedPicture(stamp_ns=0, format="mono16; png compressed ", data=SIXTEEN_BITS)
    assert np.unique(to_rgb(picture, LIMITS)).tolist() == [9]


@pytest.mark.parametrize("alpha", [None, bytes([255, 0, 128])])
def test_a_palette_gives_its_colours_whatever_their_alpha(alpha: bytes | None) -> None:
    colours = np.array([[200, 30, 10], [5, 6, 7], [90, 255, 0]], np.uint8)
    image = Image.fromarray(np.array([[0, 1], [2, 1]], np.uint8), "P")
    image.putpalette(colours.tobytes())
    file = BytesIO()
    image.save(file, "PNG", **({} if alpha is None else {"transparency": alpha}))
    got = to_rgb(CompressedPicture(stamp_ns=0, format="png", data=file.getvalue()), LIMITS)
    np.testing.assert_array_equal(got, colours[[[0, 1], [2, 1]]])


@pytest.mark.parametrize("kind", ["png", "jpeg"])
@pytest.mark.parametrize("encoding", ["bayer_grbg8", "bayer_grbg16"])
def test_a_mosaic_that_image_transport_has_packed_gets_its_colours(kind: str, encoding: str) -> None:
    mosaic = mosaic_of(np.broadcast_to(np.array([200, 90, 30], np.uint8), (16, 16, 3)), "grbg")
    wide = encoding.endswith("16") and kind == "png"
    packed = compressed(mosaic.astype(np.uint16) << 8 | 77 if wide else mosaic, kind, **QUALITY[kind])
    got = to_rgb(CompressedPicture(stamp_ns=0, format=f"{encoding}; {kind} compressed ", data=packed), LIMITS)
    assert np.abs(got.astype(int) - [200, 90, 30]).max() <= (0 if kind == "png" else 3)


def test_a_picture_in_colours_is_no_mosaic_whatever_its_format_says() -> None:
    frame = video(1, 8, 8)[0]
    picture = CompressedPicture(stamp_ns=0, format="bayer_grbg8; png compressed bgr8", data=compressed(frame, "png"))
    np.testing.assert_array_equal(to_rgb(picture, LIMITS), frame)


@pytest.mark.parametrize(("order", "big"), [("<u2", False), (">u2", True)])
@pytest.mark.parametrize("encoding", sorted(WIDE))
def test_of_16_bits_a_channel_the_upper_8_are_kept(encoding: str, order: str, big: bool) -> None:
    narrow = WIDE[encoding]
    bytes_a_pixel = {"rgb8": 3, "bgr8": 3, "rgba8": 4, "bgra8": 4}.get(narrow, 1)
    upper = np.random.default_rng(0).integers(0, 256, (4, 6 * bytes_a_pixel), dtype=np.uint8)
    wide = (upper.astype(np.uint16) << 8 | 177).astype(order)
    got = to_rgb(raw(encoding, wide.tobytes(), 4, 6, big_endian=big), LIMITS)
    np.testing.assert_array_equal(got, to_rgb(raw(narrow, upper.tobytes(), 4, 6), LIMITS))


@pytest.mark.parametrize(
    ("picture", "reason"),
    [
        (raw("rgb8", b"\0" * 47, 4, 4), "declares 4x4 pixels of rgb8, 48 bytes, but has 47"),
        (raw("rgb8", b"\0" * 48, 4, 4, step=11), "declares 11 bytes a row, but 4 pixels of rgb8 need 12"),
        (raw("rgb8", b"", 2**31, 2**31), "more than the 67,108,864"),
        (raw("rgb8", b"", 0, 4), "it is empty"),
        (raw("nv21", b"\0" * 48, 4, 4), "has the encoding 'nv21'; known are"),
        (raw("32FC1", b"\0" * 64, 4, 4), "depth is no picture"),
        (raw("yuyv", b"\0" * 60, 4, 5), "stores them in pairs"),
        (raw("bayer_rggb8", b"\0" * 4, 1, 4), "too few for its 2x2 pattern"),
        (raw("bayer_rggb16", b"\0" * 8, 1, 4), "too few for its 2x2 pattern"),
        (raw("rgb16", b"\0" * 95, 4, 4), "declares 4x4 pixels of rgb16, 96 bytes, but has 95"),
        (CompressedPicture(stamp_ns=0, format="jpeg", data=b"no picture"), "are no JPEG, PNG or WebP file"),
        (CompressedPicture(stamp_ns=0, format="16UC1; compressedDepth", data=b""), "depth is no picture"),
        (CompressedPicture(stamp_ns=0, format="16UC1; png compressed ", data=SIXTEEN_BITS), "depth is no picture"),
        (CompressedPicture(stamp_ns=0, format="32FC1; tiff compressed", data=SIXTEEN_BITS), "depth is no picture"),
    ],
)
def test_a_bad_picture_is_named_before_it_is_unpacked(picture: RawPicture, reason: str) -> None:
    with pytest.raises(BadPicture, match=reason):
        size_of(picture, LIMITS)


@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_a_damaged_file_is_named_when_it_is_unpacked(kind: str) -> None:
    data = compressed(video(1, 64, 64)[0], kind)
    picture = CompressedPicture(stamp_ns=0, format=kind, data=data[: len(data) // 2])
    assert size_of(picture, LIMITS) == (64, 64)
    with pytest.raises(BadPicture, match="is a damaged"):
        to_rgb(picture, LIMITS)


def test_a_picture_bomb_is_not_unpacked() -> None:
    data = compressed(np.zeros((600, 600, 3), np.uint8), "png")
    picture = CompressedPicture(stamp_ns=0, format="png", data=data)
    with pytest.raises(BadPicture, match="declares 600x600 pixels, more than the 100,000"):
        size_of(picture, ImportLimits(pixels=100_000))


def test_a_webp_file_may_have_half_the_pixels_as_it_takes_twice_the_memory() -> None:
    for kind, allowed in (("png", True), ("webp", False)):
        picture = CompressedPicture(stamp_ns=0, format=kind, data=compressed(np.zeros((60, 60, 3), np.uint8), kind))
        if allowed:
            assert to_rgb(picture, ImportLimits(pixels=3600)).shape == (60, 60, 3)
            continue
        with pytest.raises(BadPicture, match="declares 60x60 pixels, more than the 1,800"):
            to_rgb(picture, ImportLimits(pixels=3600))


@pytest.mark.parametrize("encoding", ["bayer_rggb8", "bayer_gbrg8", "uyvy", "yuyv"])
def test_a_large_picture_is_unpacked_in_parts(encoding: str, monkeypatch: pytest.MonkeyPatch) -> None:
    height, width = 1026, 1030
    size = height * width * (1 if encoding.startswith("bayer") else 2)
    picture = raw(encoding, np.random.default_rng(0).integers(0, 256, size, np.uint8).tobytes(), height, width)
    monkeypatch.setattr(pixels, "TILE", 2048)
    whole = to_rgb(picture, LIMITS)
    monkeypatch.setattr(pixels, "TILE", 64)
    tracemalloc.start()
    try:
        in_parts = to_rgb(picture, LIMITS)
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    np.testing.assert_array_equal(in_parts, whole)
    assert peak < 6 * height * width  # three of them are the picture; unpacked as a whole it took more than forty


@pytest.mark.parametrize(("height", "width", "size"), [(64, 64, 32), (48, 48, 32), (37, 91, 16), (20, 20, 32)])
def test_a_pixel_is_the_mean_of_the_area_it_covers(height: int, width: int, size: int) -> None:
    picture = video(1, height, width)[0]

    def share(length: int) -> np.ndarray:
        edges, entry = np.arange(size + 1) * length / size, np.arange(length)
        inside = np.minimum(edges[1:, None], entry + 1) - np.maximum(edges[:-1, None], entry)
        return np.clip(inside, 0, 1) * size / length

    mean = np.einsum("ij,jkc,lk->ilc", share(height), picture.astype(float), share(width))
    assert np.abs(fitted(picture, size, Fit.STRETCH) - mean).max() <= 0.5 + 1e-9


def test_cropping_takes_the_middle() -> None:
    picture = video(1, 32, 48)[0]
    np.testing.assert_array_equal(fitted(picture, 32, Fit.CROP), picture[:, 8:40])


def test_padding_keeps_all_in_proportion() -> None:
    picture = np.full((16, 64, 3), 200, np.uint8)
    frame = fitted(picture, 32, Fit.PAD)
    assert (frame[12:20] == 200).all()
    assert (frame[:12] == 0).all()
    assert (frame[20:] == 0).all()


def test_stretching_fills_the_frame() -> None:
    assert (fitted(np.full((16, 64, 3), 200, np.uint8), 32, Fit.STRETCH) == 200).all()
