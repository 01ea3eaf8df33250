"""What an entry of the leaderboard needs: the run with its weights and samples, and the data sets."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final

from dmotion_bench.errors import EntryInvalid
from dmotion_bench.sharing.place import HASH, plain_name
from dmotion_bench.storage.json_fields import Fields
from dmotion_bench.storage.json_file import read_json
from dmotion_bench.storage.links import require_within
from dmotion_bench.wording import shown

SCHEMA: Final = "schema.json"
"""Lies in the folder of a leaderboard's page, beside the one of its entries."""

ENTRIES: Final = "entries"

_LARGEST: Final = 8 * 2**20  # bytes of an entry that are read


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The sources of an entry, by their hashes.

    Attributes:
        weights, samples: Of the run: SHA-256 of its weights, and of the samples of the report that is meant.
        datasets: Fingerprints of the data set that was scored, and of the one of the training if it is another, with
            their names.
    """

    weights: str
    samples: str
    datasets: dict[str, str]


def entry_files(folder: Path) -> list[Path]:
    """The files of a folder's entries, in the order of their names; of a leaderboard's folder those within it.

    Raises:
        EntryInvalid: A link among them leads out of the folder.
    """
    is_leaderboard = (folder / SCHEMA).is_file() and (folder / ENTRIES).is_dir()
    place = folder / ENTRIES if is_leaderboard else folder
    found = sorted(place.glob("*.json"))
    for path in (place, *found):
        if path.is_symlink():
            require_within(path, folder, "leaderboard", EntryInvalid)
    return found


def wanted_by(entry: Path) -> Wanted | None:
    """What an entry's file says of its sources, as a run's ``report.json`` does; None if it was copied from a paper.

    Raises:
        EntryInvalid: It says nothing of them.
    """
    try:
        fields = Fields(read_json(entry, largest=_LARGEST), "it")
        return None if fields.value("kind") == "published" else _wanted(fields)
    except (OSError, ValueError) as error:
        said = error.strerror if isinstance(error, OSError) else error
        raise EntryInvalid(
            f"{shown(str(entry))} is no entry of the leaderboard: {said}. "
            "'dmbench leaderboard build' writes entries of scored runs."
        ) from None


def _wanted(fields: Fields) -> Wanted:
    dataset = fields.inner("dataset")
    datasets = {dataset.text("fingerprint"): dataset.text("name")}
    if dataset.value("trained_on") is not None:
        own = dataset.inner("trained_on")
        datasets[own.text("fingerprint")] = own.text("name")
    wanted = Wanted(weights=fields.text("weights"), samples=fields.inner("samples").text("sha256"), datasets=datasets)
    for digest in (wanted.weights, wanted.samples, *datasets):
        if not HASH.fullmatch(digest):
            raise ValueError(f"{shown(digest)} is no SHA-256")
    for name in datasets.values():
        if not plain_name(name):
            raise ValueError(f"it names a data set {shown(name)}, which can be no folder's name")
    return wanted
