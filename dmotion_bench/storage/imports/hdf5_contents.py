"""What an HDF5 file itself holds: links and data sets that lead to other files do not count."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Final

import h5py

from dmotion_bench.storage.imports.limits import MIB, ImportLimits
from dmotion_bench.storage.imports.natural_order import natural

ERRORS: Final = (OSError, RuntimeError, ValueError, KeyError, TypeError, IndexError, OverflowError)
"""All that h5py makes of damage."""

_LZF: Final = 32000  # h5py's own
_BUILT_IN: Final = {h5py.h5z.FILTER_DEFLATE, h5py.h5z.FILTER_SHUFFLE, h5py.h5z.FILTER_FLETCHER32, _LZF}
_DEEPEST = 6  # levels of a file that are looked at
_MOST, _MOST_INSIDE = 100_000, 10_000  # names in one group, and in a demonstration with all groups in it


def names(group: h5py.Group) -> list[str]:
    """Of what stands in a group; none of a damaged one."""
    try:
        return [name for name, _ in zip(group, range(_MOST), strict=False)]
    except ERRORS:
        return []


def own(group: h5py.Group, name: str) -> h5py.Group | h5py.Dataset | None:
    """What stands under a name in the file itself; None for nothing, and for links to elsewhere."""
    try:
        if not isinstance(group.get(name, getlink=True), h5py.HardLink):
            return None
        found = group[name]
    except ERRORS:
        return None
    return found if isinstance(found, h5py.Group | h5py.Dataset) else None


def datasets(group: h5py.Group) -> dict[str, h5py.Dataset]:
    """The data sets in a group by their paths within it.

    A file can lead in circles, and to one group under many names: there is a deepest level, and a most that is looked
    at in all.
    """
    return dict(_datasets(group, "", 0, iter(range(_MOST_INSIDE))))


def _datasets(group: h5py.Group, prefix: str, depth: int, left: Iterator[int]) -> Iterator[tuple[str, h5py.Dataset]]:
    for name in sorted(names(group), key=natural):
        if next(left, None) is None:
            return
        inside = own(group, name)
        if isinstance(inside, h5py.Dataset):
            yield prefix + name, inside
        elif isinstance(inside, h5py.Group) and depth < _DEEPEST:
            yield from _datasets(inside, f"{prefix}{name}/", depth + 1, left)


def fault(dataset: h5py.Dataset, limits: ImportLimits) -> str | None:
    """Why a data set is not to be read, for the sentence of the file's reader; None if it may be."""
    try:
        if dataset.is_virtual or dataset.external:
            return f"keeps {dataset.name!r} in another file"
        created = dataset.id.get_create_plist()
        foreign = {created.get_filter(number)[0] for number in range(created.get_nfilters())} - _BUILT_IN
        chunk = math.prod(dataset.chunks) * item_bytes(dataset) if dataset.chunks else 0
    except ERRORS as error:
        return f"is damaged at {dataset.name!r}: {str(error)[:120]}"
    if foreign:
        return f"has {dataset.name!r} packed by a plug-in; repack it with 'h5repack -f GZIP=4 IN OUT'"
    if chunk > limits.message_bytes:
        return f"has chunks of {chunk / MIB:,.0f} MiB in {dataset.name!r}"
    return None


def item_bytes(dataset: h5py.Dataset) -> int:
    """Of one entry in the file; numpy's type of an entry of variable length is a pointer of another size."""
    return int(dataset.id.get_type().get_size())


def is_filled(dataset: h5py.Dataset) -> bool:
    """Whether all was written that is declared; HDF5 makes up zeros for what was not."""
    try:
        if dataset.chunks is None:
            return bool(dataset.id.get_storage_size() == dataset.size * item_bytes(dataset))
        chunks = zip(dataset.shape, dataset.chunks, strict=True)
        return bool(dataset.id.get_num_chunks() == math.prod(-(-size // chunk) for size, chunk in chunks))
    except ERRORS:
        return False


def described(dataset: h5py.Dataset) -> str:
    """Shape and type of a data set."""
    try:
        return f"{' x '.join(map(str, dataset.shape))} {dataset.dtype}"
    except ERRORS:
        return "(damaged)"
