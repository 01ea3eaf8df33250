"""Addresses of data sets that are not on this machine: ``s3://bucket/path`` and its like."""

from __future__ import annotations

import os
import re
from typing import Final

PROTOCOLS: Final = ("s3", "gs", "hf")
_ADDRESS: Final = re.compile(rf"({'|'.join(PROTOCOLS)}):/{{1,2}}([^/].*)", re.DOTALL)


def remote_address(given: str | os.PathLike[str] | None) -> str | None:
    """The address of a place on object storage, if this is one; None for a path.

    A ``Path`` of an address has one slash where the address has two; it is understood all the same.
    """
    found = None if given is None else _ADDRESS.fullmatch(os.fspath(given))
    return None if found is None else f"{found[1]}://{found[2].rstrip('/')}"


def last_name(address: str) -> str:
    """The last part of an address."""
    return address.rpartition("/")[2]
