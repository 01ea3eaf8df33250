"""Pixel encodings of ROS and foxglove -> RGB, 8 bits.

Of 16 bits a channel the upper 8 are kept; an alpha channel is dropped; YUV 4:2:2 is full-range BT.601, as Foxglove
shows it; ``8UC3`` is BGR, as OpenCV and Foxglove have it. Depth (16UC1, 32FC1) is no picture and is refused. A JPEG or
WebP file that says how the camera was held is turned upright. A grey file is a mosaic where its format begins with a
Bayer pattern: image_transport packs what the camera sends, and leaves the colours to those who unpack it.
"""

from __future__ import annotations

import re
import struct
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from io import BytesIO
from typing import Final

import numpy as np
from jaxtyping import Integer, UInt8
from PIL import ExifTags, Image, UnidentifiedImageError

from dmotion_bench.storage.imports.cameras import BadPicture, CompressedPicture, Picture, RawPicture, VideoPacket
from dmotion_bench.storage.imports.git_lfs import IS_POINTER, is_pointer
from dmotion_bench.storage.imports.limits import ImportLimits

RGB = UInt8[np.ndarray, "h w 3"]
Rows = UInt8[np.ndarray, "h bytes"]
TILE: Final = 1024
"""Side of the parts that a picture is unpacked in [px]: what that takes besides the picture does not grow with it."""


def _order(*channels: int, of: int) -> Callable[[Rows], RGB]:
    def unpack(rows: Rows) -> RGB:
        return np.take(rows.reshape(len(rows), -1, of), channels, axis=2)

    return unpack


def _gray(rows: Rows) -> RGB:
    return np.repeat(rows[..., None], 3, axis=2)


def _tiles(height: int, width: int) -> Iterator[tuple[slice, slice]]:
    """The rows and columns of the parts that a picture is unpacked in; each begins at an even row and column."""
    for top in range(0, height, TILE):
        for left in range(0, width, TILE):
            yield slice(top, min(top + TILE, height)), slice(left, min(left + TILE, width))


def _yuv(luma: int, blue: int, red: int) -> Callable[[Rows], RGB]:
    def unpack(rows: Rows) -> RGB:
        pairs = rows.reshape(len(rows), -1, 4)
        rgb = np.empty((len(rows), 2 * pairs.shape[1], 3), np.uint8)
        for down, across in _tiles(*rgb.shape[:2]):
            part = pairs[down, across.start // 2 : across.stop // 2].astype(np.float32)
            y = part[..., luma::2]
            u, v = part[..., blue, None] - 128, part[..., red, None] - 128
            colours = np.stack([y + 1.402 * v, y - 0.344136 * u - 0.714136 * v, y + 1.772 * u], axis=-1)
            rgb[down, across] = np.rint(colours.clip(0, 255)).reshape(len(part), -1, 3)
        return rgb

    return unpack


def demosaic(mosaic: UInt8[np.ndarray, "h w"], pattern: str) -> RGB:
    """Bilinear: what a pixel lacks is the mean of its nearest neighbours that have it; the border is mirrored.

    Args:
        mosaic: One colour a pixel.
        pattern: The colours of the top left 2x2 pixels, row by row: ``"rggb"``, ``"bggr"``, ``"gbrg"``, ``"grbg"``.
    """
    rgb = np.empty((*mosaic.shape, 3), np.uint8)
    bordered = np.pad(mosaic, 1, mode="reflect")
    for down, across in _tiles(*mosaic.shape):
        rgb[down, across] = _demosaic(bordered[down.start : down.stop + 2, across.start : across.stop + 2], pattern)
    return rgb


def _demosaic(bordered: UInt8[np.ndarray, "h+2 w+2"], pattern: str) -> RGB:
    """A part of a mosaic; its border, a pixel wide, is not in what is returned."""
    height, width = bordered.shape
    colours = np.array([["rgb".index(letter) for letter in pattern[row : row + 2]] for row in (2, 0)])[:, ::-1]
    where = np.tile(colours, (height // 2 + 1, width // 2 + 1))[:height, :width]  # the border comes first
    planes = np.where(where[..., None] == np.arange(3), bordered[..., None], 0).astype(np.uint16)

    centre = planes[1:-1, 1:-1]
    sides_x = planes[1:-1, :-2] + planes[1:-1, 2:]
    sides_y = planes[:-2, 1:-1] + planes[2:, 1:-1]
    corners = planes[:-2, :-2] + planes[:-2, 2:] + planes[2:, :-2] + planes[2:, 2:]
    quarters: Integer[np.ndarray, "h w 3"] = 4 * centre + 2 * (sides_x + sides_y) + corners
    quarters[..., 1] = (4 * centre + sides_x + sides_y)[..., 1]
    return ((quarters + 2) // 4).astype(np.uint8)


BAYER = {f"bayer_{pattern}8": pattern for pattern in ("rggb", "bggr", "gbrg", "grbg")}

UNPACK: dict[str, tuple[int, Callable[[Rows], RGB]]] = {
    "rgb8": (3, _order(0, 1, 2, of=3)),
    "bgr8": (3, _order(2, 1, 0, of=3)),
    "8UC3": (3, _order(2, 1, 0, of=3)),
    "rgba8": (4, _order(0, 1, 2, of=4)),
    "bgra8": (4, _order(2, 1, 0, of=4)),
    "8UC4": (4, _order(2, 1, 0, of=4)),
    "mono8": (1, _gray),
    "8UC1": (1, _gray),
    "uyvy": (2, _yuv(1, 0, 2)),
    "yuv422": (2, _yuv(1, 0, 2)),
    "yuyv": (2, _yuv(0, 1, 3)),
    "yuv422_yuy2": (2, _yuv(0, 1, 3)),
}
"""Bytes a pixel, and what turns rows of bytes into RGB."""

WIDE = {f"{name[:-1]}16": name for name in (*UNPACK, *BAYER) if re.fullmatch("[a-z_]+8", name)}
"""Encodings with 16 bits a channel, by the one that their upper 8 bits are of."""
ENCODINGS = sorted([*UNPACK, *BAYER, *WIDE])
_DEPTH: Final = re.compile(r"(16[USF]|32[SF]|64F)C\d+")
"""OpenCV's names of pixels that are no brightness; image_transport puts them first in the format of a PNG file."""
PICTURE_FILES = ("JPEG", "PNG", "WEBP")
_UPRIGHT = {
    2: Image.Transpose.FLIP_LEFT_RIGHT,
    3: Image.Transpose.ROTATE_180,
    4: Image.Transpose.FLIP_TOP_BOTTOM,
    5: Image.Transpose.TRANSPOSE,
    6: Image.Transpose.ROTATE_270,
    7: Image.Transpose.TRANSVERSE,
    8: Image.Transpose.ROTATE_90,
}
"""What turns a picture upright, by EXIF's number of how the camera was held."""


@dataclass(frozen=True, kw_only=True)
class Shape:
    """What a picture's head says.

    Attributes:
        height, width: Of it, upright [px].
        is_deep: Whether it is grey with 16 bits a pixel, as depth is stored.
    """

    height: int
    width: int
    is_deep: bool = False


def shape_of(picture: CompressedPicture, limits: ImportLimits) -> Shape:
    """What a compressed picture's head says.

    Raises:
        BadPicture: As ``size_of``.
    """
    with _opened(picture, limits) as image:
        height, width = image.height, image.width
        if _orientation(image) >= 5:
            height, width = width, height
        return Shape(height=height, width=width, is_deep=_is_deep(image))


def size_of(picture: Picture, limits: ImportLimits) -> tuple[int, int]:
    """Height and width, after all was checked that can be without unpacking.

    Raises:
        BadPicture: It is too large, too short for its size, or of an encoding that is not known.
    """
    if isinstance(picture, VideoPacket):
        raise BadPicture(f"is a packet of {picture.codec} among pictures")
    if isinstance(picture, CompressedPicture):
        shape = shape_of(picture, limits)
        return shape.height, shape.width
    height, width = picture.height, picture.width
    _check_size(height, width, limits.pixels)
    row = width * _bytes_a_pixel(picture.encoding)
    step = picture.step or row
    if step < row:
        raise BadPicture(f"declares {step} bytes a row, but {width} pixels of {picture.encoding} need {row}")
    needed = step * (height - 1) + row
    if len(picture.data) < needed:
        raise BadPicture(
            f"declares {width}x{height} pixels of {picture.encoding}, {needed:,} bytes, but has {len(picture.data):,}"
        )
    if WIDE.get(picture.encoding, picture.encoding) in BAYER and min(height, width) < 2:
        raise BadPicture(f"is {width}x{height} pixels of {picture.encoding}, too few for its 2x2 pattern")
    if _is_yuv(picture.encoding) and width % 2:
        raise BadPicture(f"is {width} pixels wide, but {picture.encoding} stores them in pairs")
    return height, width


def to_rgb(picture: Picture, limits: ImportLimits) -> RGB:
    """The picture's pixels.

    Raises:
        BadPicture: As ``size_of``, or the compressed bytes are damaged.
    """
    if isinstance(picture, CompressedPicture):
        return _decompress(picture, limits)
    height, width = size_of(picture, limits)
    assert isinstance(picture, RawPicture)
    row = width * _bytes_a_pixel(picture.encoding)
    rows: Rows = np.ndarray((height, row), np.uint8, buffer=picture.data, strides=(picture.step or row, 1))
    encoding = picture.encoding
    if encoding in WIDE:
        rows, encoding = rows[:, 0 if picture.big_endian else 1 :: 2], WIDE[encoding]
    return demosaic(rows, BAYER[encoding]) if encoding in BAYER else UNPACK[encoding][1](rows)


def _is_yuv(encoding: str) -> bool:
    return encoding.startswith(("yuv", "uyvy", "yuyv"))


def _bytes_a_pixel(encoding: str) -> int:
    if encoding in BAYER:
        return 1
    if encoding in WIDE:
        return 2 * _bytes_a_pixel(WIDE[encoding])
    if encoding not in UNPACK:
        depth = " (depth is no picture)" if encoding in {"16UC1", "32FC1"} else ""
        raise BadPicture(f"has the encoding {encoding[:40]!r}{depth}; known are {', '.join(ENCODINGS)}")
    return UNPACK[encoding][0]


def _check_size(height: int, width: int, most: int) -> None:
    if not height or not width:
        raise BadPicture(f"is {width}x{height} pixels large: it is empty")
    if height * width > most:
        raise BadPicture(f"declares {width}x{height} pixels, more than the {most:,} that one may have")


def _opened(picture: CompressedPicture, limits: ImportLimits) -> Image.Image:
    """The compressed file with its head read, its pixels not yet."""
    if "compresseddepth" in picture.format.lower() or _DEPTH.fullmatch(_packed_encoding(picture)):
        raise BadPicture(f"has the format {picture.format[:60]!r}: depth is no picture")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            image = Image.open(BytesIO(picture.data), formats=PICTURE_FILES)
    except (Image.DecompressionBombError, Image.DecompressionBombWarning) as error:
        raise BadPicture(f"declares more than the {limits.pixels:,} pixels that one may have") from error
    except (UnidentifiedImageError, OSError, ValueError, SyntaxError, Warning) as error:
        if is_pointer(picture.data):
            raise BadPicture(IS_POINTER) from error
        raise BadPicture(
            f"has the format {picture.format[:60]!r}, but its {len(picture.data):,} bytes are no JPEG, PNG or WebP file"
        ) from error
    # libwebp keeps a picture four times while it unpacks it
    _check_size(image.height, image.width, limits.pixels // (2 if image.format == "WEBP" else 1))
    return image


def _packed_encoding(picture: CompressedPicture) -> str:
    """The encoding of what image_transport has packed, which it puts first in the format."""
    return picture.format.partition(";")[0].strip()


def _is_deep(image: Image.Image) -> bool:
    return image.mode.startswith("I;16")


def _brightness(image: Image.Image) -> UInt8[np.ndarray, "h w"]:
    """A grey picture, of 16 bits the upper 8."""
    return (np.asarray(image) >> 8).astype(np.uint8) if _is_deep(image) else np.asarray(image)


def _orientation(image: Image.Image) -> int:
    """EXIF's number of how the camera was held; 1, upright, where the file does not say or says nonsense."""
    if image.format == "PNG":  # it would be decoded for an answer that cameras never give in PNG
        return 1
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            number = image.getexif().get(ExifTags.Base.Orientation, 1)
    except (OSError, ValueError, SyntaxError, LookupError, TypeError, OverflowError, struct.error, Warning):
        return 1
    return number if number in _UPRIGHT else 1


def _rgb(image: Image.Image) -> RGB:
    """Without its alpha channel, by way of one where a palette holds it: Pillow warns of the direct way."""
    rgb = np.empty((image.height, image.width, 3), np.uint8)
    for down, across in _tiles(image.height, image.width):
        part = image.crop((across.start, down.start, across.stop, down.stop))
        rgb[down, across] = np.asarray((part.convert("RGBA") if part.mode == "P" else part).convert("RGB"))
    return rgb


def _decompress(picture: CompressedPicture, limits: ImportLimits) -> RGB:
    with _opened(picture, limits) as image:
        try:
            with warnings.catch_warnings():
                warnings.simplefilter("error")
                image.load()
                encoding = _packed_encoding(picture)
                pattern = BAYER.get(WIDE.get(encoding, encoding))
                if pattern is not None and (image.mode == "L" or _is_deep(image)):
                    return demosaic(_brightness(image), pattern)
                turn = _UPRIGHT.get(_orientation(image))
                if turn is not None:
                    return _rgb(image.transpose(turn))
                if _is_deep(image):
                    return _gray(_brightness(image))
                return _rgb(image)
        except (OSError, ValueError, SyntaxError, Warning) as error:
            raise BadPicture(f"is a damaged {image.format} file: {str(error)[:120]}") from error
