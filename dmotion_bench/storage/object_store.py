"""The door to object storage (S3, Google Cloud Storage, Hugging Face), through fsspec: nothing else asks for bytes.

Storage that is busy answers with errors 500 and 503, or not at all, or breaks off. Every request is repeated after
pauses that grow, then a sentence says what failed. A body of another length than was asked for is such a failure, too;
a file whose digest is known is held against it, and read anew as a whole where it differs.
"""

from __future__ import annotations

import hashlib
import logging
import os
import time
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any, Final, TypeVar

from dmotion_bench.addresses import PROTOCOLS
from dmotion_bench.errors import DatasetCorrupt, DmbenchError, PackageNotInstalled, PlaceUnreachable
from dmotion_bench.storage.atomic import atomic_file
from dmotion_bench.storage.shard import FileFacts
from dmotion_bench.wording import sentence, shown

PIECE: Final = 8 * 2**20
"""Bytes that one request asks for: what has to be repeated where a body breaks off."""
PAUSES: tuple[float, ...] = (0.5, 1.0, 2.0, 4.0, 8.0)
"""Seconds before each repetition."""
PATIENCE_S: float = 30.0
"""That the storage may be silent."""
_PACKAGES: Final = {
    "s3": ("s3fs", "pip install 'dmbench[remote]'"),
    "gs": ("gcsfs", "pip install gcsfs"),
    "hf": ("huggingface_hub", "pip install 'dmbench[hub]'"),
}
_NO_HELP: Final = (FileNotFoundError, PermissionError, IsADirectoryError, NotADirectoryError)
"""What comes again however often one asks."""
_log = logging.getLogger(__name__)
Answer = TypeVar("Answer")


class WrongBody(Exception):
    """A body that is not what was asked for; the text says what is wrong."""


class ObjectStore:
    """The files below an address. It may be handed to other processes, where it connects anew.

    Attributes:
        described_by: The file that tells the digests, for sentences.
        address: Such as ``s3://bucket/path``.
        requests: Requests so far, repeated ones with them.
        bytes: That were read so far.
    """

    described_by = "dataset.json"

    def __init__(self, address: str) -> None:
        self.address, self.requests, self.bytes = address, 0, 0
        self._system: Any = None

    def __getstate__(self) -> dict[str, Any]:
        return self.__dict__ | {"_system": None}

    def read(self, name: str, *, largest: int) -> bytes:
        """A whole small file, read until two readings in a row agree: nobody knows its digest.

        Args:
            name: Below the address.
            largest: More is not read [bytes].

        Raises:
            FileNotFoundError: There is none.
            PlaceUnreachable: The storage does not answer, or never the same.
        """
        before: list[bytes] = []

        def read() -> bytes:
            content = self._piece(name, 0, largest)
            before.append(content)
            if len(before) < 2 or before[-2] != content:
                raise WrongBody("two readings of it differ")
            return content

        before.append(self._tried(name, lambda: self._piece(name, 0, largest)))
        return self._tried(name, read)

    def fetch(self, name: str, facts: FileFacts, to: Path) -> None:
        """Copy a file here; it appears whole and with its digest, or not at all.

        Raises:
            FileNotFoundError: There is none.
            PlaceUnreachable: The storage does not answer.
            DatasetCorrupt: It holds other bytes, however often it is read.
        """
        try:
            self._tried(name, lambda: self._copy(name, facts, to))
        except PlaceUnreachable as error:
            if isinstance(error.__cause__, WrongBody):
                raise self._damaged(name, error.__cause__) from None
            raise

    def holds(self, name: str, facts: FileFacts) -> bool:
        """Whether a file is there with these bytes: it is read as a whole.

        Raises:
            PlaceUnreachable: The storage does not answer.
        """
        try:
            self._tried(name, lambda: self._pass_on(name, facts, lambda _piece: None))
        except FileNotFoundError:
            return False
        except PlaceUnreachable as error:
            if isinstance(error.__cause__, WrongBody):
                return False
            raise
        return True

    def sizes(self, folder: str) -> dict[str, int]:
        """The files of a folder by name, with their sizes [bytes]; empty if there is none.

        Args:
            folder: Below the address; empty for that of the address itself.

        Raises:
            PlaceUnreachable: The storage does not answer.
        """

        return {_last(one): int(one["size"]) for one in self._listed(folder) if one["type"] == "file"}

    def folders(self, folder: str) -> list[str]:
        """The names of the folders in a folder; none if there is no such folder.

        Args:
            folder: Below the address.

        Raises:
            PlaceUnreachable: The storage does not answer.
        """
        return sorted(_last(one) for one in self._listed(folder) if one["type"] == "directory")

    def write(self, file: Path, name: str) -> None:
        """Put a file there, under its name whole or not at all.

        Raises:
            PlaceUnreachable: The storage does not answer, or does not take it.
        """

        def put() -> None:
            system = self._connected()
            system.put_file(str(file), self._at(name))
            system.invalidate_cache()
            written = int(system.info(self._at(name))["size"])
            if written != file.stat().st_size:
                raise WrongBody(f"it has {written} bytes there instead of {file.stat().st_size}")

        self._tried(name, put)

    def remove(self, name: str) -> None:
        """Delete a file, if it is there.

        Raises:
            PlaceUnreachable: The storage does not answer.
        """

        def delete() -> None:
            self._connected().rm_file(self._at(name))

        try:
            self._tried(name, delete)
        except FileNotFoundError:
            return

    def _at(self, name: str) -> str:
        return f"{self.address}/{name}" if name else self.address

    def _damaged(self, name: str, what: object) -> DmbenchError:
        """The error for a file that holds other bytes, however often it is read."""
        return DatasetCorrupt(
            f"{shown(self._at(name))} is damaged: {what}. Nothing of it is used. Put the data set there again, or name "
            "another copy of it with '--data'."
        )

    def _listed(self, folder: str) -> list[Mapping[str, Any]]:
        def listed() -> list[Mapping[str, Any]]:
            system = self._connected()
            system.invalidate_cache()
            return [_understood(one) for one in system.ls(self._at(folder), detail=True)]

        try:
            return self._tried(folder, listed)
        except FileNotFoundError:
            return []

    def _copy(self, name: str, facts: FileFacts, to: Path) -> None:
        with atomic_file(to) as file:
            self._pass_on(name, facts, file.write)

    def _pass_on(self, name: str, facts: FileFacts, take: Callable[[bytes], object]) -> None:
        digest = hashlib.sha256()
        for first in range(0, facts.size, PIECE):
            piece = self._tried(name, partial(self._exactly, name, first, min(first + PIECE, facts.size)))
            digest.update(piece)
            take(piece)
        if digest.hexdigest() != facts.sha256:
            raise WrongBody(f"it does not hold the bytes that {self.described_by} describes")

    def _exactly(self, name: str, first: int, stop: int) -> bytes:
        piece = self._piece(name, first, stop)
        if len(piece) != stop - first:
            raise WrongBody(f"{len(piece)} bytes of it come where {stop - first} were asked for")
        return piece

    def _piece(self, name: str, first: int, stop: int) -> bytes:
        content: bytes = self._connected().cat_file(self._at(name), start=first, end=stop)
        self.bytes += len(content)
        if len(content) > stop - first:
            raise WrongBody(f"more than the {stop - first} bytes that were asked for come of it")
        return content

    def _tried(self, name: str, work: Callable[[], Answer]) -> Answer:
        """What ``work`` gives; it is called again, after growing pauses, as long as its failure may pass."""
        for pause in (*PAUSES, None):
            self.requests += 1
            try:
                return work()
            except (*_NO_HELP, DmbenchError) as error:  # ours: no space on this machine, a package that is not there
                if isinstance(error, PermissionError):
                    raise self._unreachable(name, "is not allowed", error) from error
                raise
            except Exception as error:  # each kind of storage has errors of its own
                if "Credentials" in type(error).__name__:
                    raise self._unreachable(name, "needs credentials", error) from error
                if pause is None:
                    raise self._unreachable(name, f"failed {len(PAUSES) + 1} times", error) from error
                _log.info("%s: %s; again in %g s", shown(self._at(name)), _said(error), pause)
                time.sleep(pause)
        raise AssertionError("the last pause is none")

    def _unreachable(self, name: str, how: str, error: Exception) -> PlaceUnreachable:
        return PlaceUnreachable(
            f"reading or writing {shown(self._at(name))} {how}: {_said(error)} Check the address, the network and the "
            "credentials, then run the same command again: it goes on where it stopped."
        )

    def _connected(self) -> Any:
        if self._system is None:
            self._system = _file_system(self.address)
        return self._system


def _understood(listed: Mapping[str, Any]) -> Mapping[str, Any]:
    """An entry of a folder's list, which is as fsspec describes it.

    Raises:
        WrongBody: It is not.
    """
    name, kind, size = (listed.get(key) for key in ("name", "type", "size"))
    whole = type(size) is int and 0 <= size < 2**63
    if not isinstance(name, str) or not isinstance(kind, str) or (kind == "file" and not whole):
        raise WrongBody("its list says no name, kind or size of a file")
    return listed


def _last(listed: Mapping[str, Any]) -> str:
    return str(listed["name"]).rstrip("/").rpartition("/")[2]


def _said(error: Exception) -> str:
    return sentence(shown(f"{type(error).__name__}: {str(error)[:200]}"))


def _file_system(address: str) -> Any:
    """fsspec's file system for an address; it repeats nothing itself, so that pauses and requests are ours."""
    protocol = address.partition(":")[0]
    assert protocol in PROTOCOLS, "addresses are recognised by their protocol"
    package, install = _PACKAGES[protocol]
    try:
        import fsspec

        options: Mapping[str, Any] = _OPTIONS.get(protocol, dict)()
        system = fsspec.filesystem(protocol, use_listings_cache=False, **options)
    except ImportError:
        raise PackageNotInstalled(package, f"reading {shown(address)}", install) from None
    if protocol == "s3":
        system.retries = 1
    return system


def _s3_options() -> dict[str, Any]:
    attempts = {"total_max_attempts": 1, "mode": "standard"}
    timeouts = {"connect_timeout": PATIENCE_S, "read_timeout": PATIENCE_S}
    endpoint = os.environ.get("AWS_ENDPOINT_URL")  # s3fs keeps its clients by what it is given, not by the environment
    return {"config_kwargs": {"retries": attempts, **timeouts}, "endpoint_url": endpoint}


_OPTIONS: Final = {"s3": _s3_options}
