"""The pictures of a data set in an HDF5 file: pixels, or a JPEG, PNG or WebP file in each row.

robomimic stores pixels, n x height x width x channels, in bytes. Others store the channels first, as networks take
them, or fractions from 0 to 1 instead of bytes. Robots that record to HDF5 often pack each picture: ALOHA in rows of
bytes that are filled up with zeros, n x bytes; RoboTwin in texts that are; others in rows of variable length.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Final, TypeVar

import h5py
import numpy as np
from jaxtyping import Float, UInt8

from dmotion_bench.storage.imports.cameras import BadPicture, CompressedPicture
from dmotion_bench.storage.imports.hdf5_contents import ERRORS, fault, is_filled, item_bytes
from dmotion_bench.storage.imports.limits import ImportLimits
from dmotion_bench.storage.imports.pixels import size_of, to_rgb

_T = TypeVar("_T")
KINDS: Final = (
    "n x height x width x 3 or n x 3 x height x width in bytes or fractions of 1, grey bytes with 1 in place of 3, "
    "or a packed picture in each row"
)
_STARTS: Final = (b"\xff\xd8\xff", b"\x89PNG\r\n\x1a\n", b"RIFF")  # of JPEG, PNG, WebP


class Pixels:
    """Uncompressed pictures in bytes or fractions, in one, three or four channels.

    Channels that come first are one or three, as four may be the last four pictures of a game. Fractions are of three
    channels or four: one may be a depth.

    Args:
        dataset: Where ``holds`` is true.
        limits: What the file may make us do.

    Raises:
        BadPicture: They are too large, too many, or not all there.
    """

    def __init__(self, dataset: h5py.Dataset, limits: ImportLimits) -> None:
        self._dataset = dataset
        self._is_bytes, self._channels_last = dataset.dtype == np.uint8, _channels_last(dataset.shape)
        height, width = self._size = dataset.shape[1:3] if self._channels_last else dataset.shape[2:4]
        if not 0 < height * width <= limits.pixels:
            raise BadPicture(f"declares pictures of {width}x{height} pixels in {dataset.name!r}")

    @staticmethod
    def holds(dataset: h5py.Dataset) -> bool:
        """Whether a data set has the shape of such pictures."""
        if len(dataset.shape) != 4 or not (_channels_last(dataset.shape) or dataset.shape[1] in (1, 3)):
            return False
        channels = dataset.shape[3 if _channels_last(dataset.shape) else 1]
        return bool(dataset.dtype == np.uint8) or (dataset.dtype.kind == "f" and channels > 1)

    def sizes(self) -> Iterator[tuple[int, int]]:
        """Height and width; once for bytes, since all pictures of an array have one size.

        Raises:
            BadPicture: A number is no fraction.
        """
        yield self._size
        for number in range(0 if self._is_bytes else len(self._dataset)):
            self.read(number)
            yield self._size

    def read(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        """One picture.

        Raises:
            BadPicture: It is damaged.
        """
        try:
            picture = np.asarray(self._dataset[number])
        except ERRORS as error:
            raise BadPicture(f"is damaged: picture {number} of {self._dataset.name!r}: {str(error)[:120]}") from error
        if not self._is_bytes:
            picture = self._bytes_of(picture, number)
        if not self._channels_last:
            picture = np.moveaxis(picture, 0, 2)
        return np.ascontiguousarray(picture[..., [0, 0, 0]] if picture.shape[2] == 1 else picture[..., :3])

    def _bytes_of(self, fractions: Float[np.ndarray, "..."], number: int) -> UInt8[np.ndarray, "..."]:
        if not ((fractions >= 0) & (fractions <= 1)).all():  # not a number is neither
            low, high = fractions.min(), fractions.max()
            raise BadPicture(
                f"has numbers of {low:g} to {high:g} in picture {number} of {self._dataset.name!r}; pictures are bytes "
                "from 0 to 255 (uint8), or fractions from 0 to 1. Write them as bytes"
            )
        scaled: UInt8[np.ndarray, "..."] = np.rint(fractions.astype(np.float64) * 255).astype(np.uint8)
        return scaled


def _channels_last(shape: tuple[int, ...]) -> bool:
    return shape[3] in (1, 3, 4)


class PackedPictures:
    """A compressed picture in each row. Arguments and errors as of ``Pixels``."""

    def __init__(self, dataset: h5py.Dataset, limits: ImportLimits) -> None:
        self._dataset, self._limits = dataset, limits

    @staticmethod
    def holds(dataset: h5py.Dataset) -> bool:
        """Whether the first row begins as a picture's file does."""
        rows = len(dataset.shape) == 2 and dataset.dtype == np.uint8
        varying = len(dataset.shape) == 1 and h5py.check_vlen_dtype(dataset.dtype) == np.uint8
        texts = len(dataset.shape) == 1 and _is_text(dataset)
        if not (rows or varying or texts) or not len(dataset):
            return False
        first = dataset[0, : len(max(_STARTS, key=len))] if rows else dataset[0]
        return _bytes_of(dataset, first).startswith(_STARTS)

    def sizes(self) -> Iterator[tuple[int, int]]:
        """Height and width of each picture, by its head.

        Raises:
            BadPicture: One is damaged.
        """
        for number in range(len(self._dataset)):
            yield self._unpacked(number, size_of)

    def read(self, number: int) -> UInt8[np.ndarray, "h w 3"]:
        """One picture.

        Raises:
            BadPicture: It is damaged.
        """
        return self._unpacked(number, to_rgb)

    def _unpacked(self, number: int, unpack: Callable[[CompressedPicture, ImportLimits], _T]) -> _T:
        try:
            data = _bytes_of(self._dataset, self._dataset[number])
            return unpack(CompressedPicture(stamp_ns=0, format="packed", data=data), self._limits)
        except (BadPicture, *ERRORS) as error:
            raise BadPicture(f"is damaged: picture {number} of {self._dataset.name!r} {str(error)[:120]}") from error


def _is_text(dataset: h5py.Dataset) -> bool:
    """Whether an entry is a text or a block of bytes, of one length for all."""
    return dataset.dtype.kind in "SV" and dataset.dtype.names is None


def _bytes_of(dataset: h5py.Dataset, entry: object) -> bytes:
    """An entry's bytes; numpy takes the zeros from the end of a text."""
    return np.asarray(entry, dataset.dtype if _is_text(dataset) else np.uint8).tobytes()


def holds_pictures(dataset: h5py.Dataset, limits: ImportLimits) -> bool:
    """Whether a data set is a camera's; one that is not to be read counts by its shape alone."""
    try:
        if Pixels.holds(dataset) or fault(dataset, limits) is not None:
            return Pixels.holds(dataset)
        return item_bytes(dataset) <= limits.message_bytes and PackedPictures.holds(dataset)
    except ERRORS:
        return False


def pictures_of(dataset: h5py.Dataset, limits: ImportLimits) -> Pixels | PackedPictures:
    """The pictures of a data set that ``holds_pictures``.

    Raises:
        BadPicture: They are too large, too many, or not all there.
    """
    pictures = Pixels(dataset, limits) if Pixels.holds(dataset) else PackedPictures(dataset, limits)
    if len(dataset) > limits.frames:
        raise BadPicture(f"declares more than the {limits.frames:,} pictures that can be imported")
    if not is_filled(dataset):
        raise BadPicture(f"declares {len(dataset):,} pictures in {dataset.name!r} and holds fewer")
    return pictures
