"""The numbers of H.264's pictures, which tell of lost ones; FFmpeg's decoder draws on without a word.

A picture is drawn on top of reference pictures, which are counted by ``frame_num`` (ITU-T H.264, 7.4.3). Only what
leads to that number is read: of sequences, of pictures, and of the first slice of each picture.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

_START: Final = re.compile(rb"\x00\x00\x01")
_SLICE, _KEY_SLICE, _SEQUENCE, _PICTURE = 1, 5, 7, 8
_HEAD: Final = 128  # bytes of a unit that are looked at
_WITH_CHROMA: Final = frozenset({44, 83, 86, 100, 110, 118, 122, 128, 134, 135, 138, 139, 244})  # profiles


class _Unread(Exception):
    """A unit that ends early, or holds what is not read here."""


@dataclass(frozen=True)
class _Sequence:
    """What a sequence says of its pictures' numbers: their bits, and how many bits of a slice stand before them."""

    bits: int
    skipped: int


class PictureNumbers:
    """Follows the numbers of a stream's pictures, packet by packet."""

    def __init__(self) -> None:
        self._sequences: dict[int, _Sequence] = {}
        self._of_pictures: dict[int, int] = {}
        self._last: int | None = None  # of a reference picture

    def is_one_lost(self, packet: bytes) -> bool:
        """Whether a reference picture is missing between those before this packet and the one in it.

        Args:
            packet: With start codes between its units, as topics send it.
        """
        begins = [found.end() for found in _START.finditer(packet)]
        lost = [self._is_one_lost(packet[begin : begin + _HEAD]) for begin in begins]
        return any(lost)

    def _is_one_lost(self, unit: bytes) -> bool:
        try:
            return self._read(unit)
        except (_Unread, IndexError):
            return False

    def _read(self, unit: bytes) -> bool:
        kind, is_reference = unit[0] & 31, bool(unit[0] & 96)
        bits = _Bits(unit[1:].replace(b"\x00\x00\x03", b"\x00\x00"))
        if kind == _SEQUENCE:
            place, described = _sequence(bits)
            self._sequences[place] = described
        elif kind == _PICTURE:
            place = bits.unary()
            self._of_pictures[place] = bits.unary()
        elif kind in (_SLICE, _KEY_SLICE) and bits.unary() == 0:
            bits.unary()
            sequence = self._sequences.get(self._of_pictures.get(bits.unary(), -1))
            if sequence is None:
                self._last = None
                return False
            bits.plain(sequence.skipped)
            number, last = bits.plain(sequence.bits), self._last
            if is_reference:
                self._last = number
            elif number != last:
                self._last = number - 1  # it has the number of the next reference
            return kind == _SLICE and last is not None and (number - last) % (1 << sequence.bits) > 1
        return False


def _sequence(bits: _Bits) -> tuple[int, _Sequence]:
    profile = bits.plain(24) >> 16
    number, skipped = bits.unary(), 0
    if profile in _WITH_CHROMA:
        if bits.unary() == 3:
            skipped = 2 * bits.plain(1)
        bits.unary(), bits.unary()
        if bits.plain(2) & 1:
            raise _Unread  # matrices, which no robot's camera sends
    size, order = 4 + bits.unary(), bits.unary()
    if order == 0:
        bits.unary()
    elif order == 1:
        bits.plain(1), bits.unary(), bits.unary()
        for _ in range(bits.unary()):
            bits.unary()
    bits.unary()
    if bits.plain(1):
        raise _Unread  # numbers may be missing, as of layers that were left out
    return number, _Sequence(bits=size, skipped=skipped)


class _Bits:
    """The bits of a unit, read from its beginning."""

    def __init__(self, data: bytes) -> None:
        self._left = "".join(f"{byte:08b}" for byte in data)

    def plain(self, count: int) -> int:
        """A number of so many bits."""
        if count > len(self._left):
            raise _Unread
        taken, self._left = self._left[:count], self._left[count:]
        return int(taken or "0", 2)

    def unary(self) -> int:
        """A number of any size, in Exp-Golomb code: as many zeros before it as it has bits after its first."""
        zeros = self._left.find("1")
        if zeros < 0:
            raise _Unread
        return self.plain(2 * zeros + 1) - 1
