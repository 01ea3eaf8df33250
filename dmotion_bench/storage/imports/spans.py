"""Stretches of bytes with a known end: nothing reads past it, whatever a length field says."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from typing import Protocol

import zstandard

from dmotion_bench.storage.imports.limits import MIB


class Readable(Protocol):
    """A source of bytes: a file, a decompressor, another span."""

    def read(self, size: int, /) -> bytes:
        """At most ``size`` bytes."""


class Cut(Exception):
    """The bytes end before they should."""


class Broken(Exception):
    """The bytes cannot be what a writer meant."""


class Span:
    """The next ``length`` bytes of a source, and never one more.

    Args:
        source: Where they come from.
        length: How many there are.
        seek: Moves the source ahead without reading, where it can.
    """

    def __init__(self, source: Readable, length: int, seek: Callable[[int], object] | None = None) -> None:
        self._source, self._seek = source, seek
        self.left = length
        self.crc: int | None = None  # a number: the checksum of what was read

    def read(self, size: int = -1, /) -> bytes:
        """At most ``size`` bytes; empty at the end of the span."""
        data = self._source.read(self.left if size < 0 else min(size, self.left))
        self.left -= len(data)
        if self.crc is not None:
            self.crc = zlib.crc32(data, self.crc)
        return data

    def exactly(self, size: int) -> bytes:
        """``size`` bytes."""
        if size > self.left:
            raise Cut
        data = self.read(size)
        while len(data) < size:
            more = self.read(size - len(data))
            if not more:
                raise Cut
            data += more
        return data

    def skip(self) -> None:
        """Go to the span's end."""
        if self._seek is not None and self.crc is None:
            self._seek(self.left)
            self.left = 0
        while self.left:
            self.exactly(min(self.left, MIB))

    def part(self, length: int) -> Span:
        """The next bytes as a span of their own, to be used up before this one is read on."""
        if length > self.left:
            raise Cut
        return Span(self, length, None if self._seek is None or self.crc is not None else self._ahead)

    def _ahead(self, distance: int) -> None:
        assert self._seek is not None
        self._seek(distance)
        self.left -= distance


class Inflated(Span):
    """What something inflates to, stopped where it grows beyond its size.

    Args:
        source: What inflates it.
        declared: Its size, or the largest that it may have.
        what: It is, for the error.
    """

    def __init__(self, source: Readable, declared: int, what: str = "a chunk") -> None:
        super().__init__(source, declared)
        self._beyond, self._what = source, what
        self._checked = False

    def read(self, size: int = -1, /) -> bytes:
        try:
            data = super().read(size)
            beyond = b""
            if not self.left and not self._checked:
                self._checked, beyond = True, self._beyond.read(1)
        except (zstandard.ZstdError, RuntimeError, EOFError, ValueError) as error:  # RuntimeError: all that lz4 raises
            raise Broken(f"{self._what} cannot be inflated ({error})") from error
        if beyond:
            raise Broken(f"{self._what} inflates to more than it declares")
        return data

    def goes_on(self) -> bool:
        """Whether there is more, beyond what may be read."""
        try:
            return bool(self._beyond.read(1))
        except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
            return False

    def at_end(self) -> bool:
        """Whether there is no more, and nothing is wrong with what there was."""
        try:
            return not self._beyond.read(1)
        except (zstandard.ZstdError, RuntimeError, EOFError, ValueError):
            return False
