"""What a place holds."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from dmotion_bench.errors import UnknownName, UsageError
from dmotion_bench.sharing.place import DATASETS, HASH, RUNS, Place
from dmotion_bench.sharing.pull import shares_of
from dmotion_bench.sharing.push import Kind, labels_stand, read_standing, standing_name
from dmotion_bench.sharing.run_share import RunShare
from dmotion_bench.wording import command


@dataclass(frozen=True, kw_only=True)
class Shared:
    """Something that is published.

    Attributes:
        kind, name: Of what.
        fingerprint: The hash of its weights or of its content.
        share: Of a run: SHA-256 of its manifest.
        model: Of a run.
        dataset: Of a run: the fingerprint of the data set of its training.
        reports: Of a run: how many reports are there.
        labels: Of a data set: whether labels are there.
        bytes: Of all of its files.
        damage: Why it cannot be fetched; empty if nothing is known against it.
    """

    kind: Kind
    name: str
    fingerprint: str
    share: str = ""
    model: str = ""
    dataset: str = ""
    reports: int = 0
    labels: bool = False
    bytes: int = 0
    damage: str = ""


def contents(place: Place) -> list[Shared]:
    """Everything that a place holds, data sets first.

    Raises:
        PlaceUnreachable: It does not answer.
    """
    datasets = [one for name in _hashes(place, DATASETS) for one in _dataset(place, name)]
    runs = [one for name in _hashes(place, RUNS) for one in _runs(place, name)]
    return sorted(datasets, key=lambda one: one.name) + sorted(runs, key=lambda one: one.name)


def find(place: Place, beginning: str) -> tuple[Kind, str]:
    """What a hash, or the beginning of one, stands for.

    Raises:
        UnknownName: Nothing.
        UsageError: Several things.
    """
    kinds: tuple[tuple[Kind, str], ...] = (("data set", DATASETS), ("run", RUNS))
    standing = [(kind, name) for kind, folder in kinds for name in _hashes(place, folder)]
    found = [(kind, name) for kind, name in standing if name.startswith(beginning)]
    if not found:
        known = [name[:16] for _, name in standing]
        raise UnknownName("fingerprint", beginning, known, command("dmbench share list", place.address).strip("'"))
    if len(found) > 1:
        listed = ", ".join(f"{kind} {name[:16]}" for kind, name in found[:8])
        raise UsageError(f"several things begin with {beginning!r}: {listed}; write more of the one that you mean.")
    return found[0]


def _hashes(place: Place, folder: str) -> list[str]:
    return [name for name in place.folders(folder) if HASH.fullmatch(name)]


def _dataset(place: Place, fingerprint: str) -> Iterator[Shared]:
    name = standing_name(place, fingerprint)
    if not name:
        return  # published by half
    folder = f"{DATASETS}/{fingerprint}/{name}"
    try:
        manifest = read_standing(place, folder, fingerprint)
    except (FileNotFoundError, ValueError) as error:
        yield Shared(kind="data set", name=name, fingerprint=fingerprint, damage=str(error))
        return
    labels = labels_stand(place, folder, manifest)
    kept = [one.video.size + (one.labels.size if one.labels and labels else 0) for one in manifest.shards]
    size = sum(kept) + sum(facts.size for facts in manifest.tables.values())
    yield Shared(kind="data set", name=name, fingerprint=fingerprint, labels=labels, bytes=size)


def _runs(place: Place, weights: str) -> Iterator[Shared]:
    for digest, share in shares_of(place, weights):
        if isinstance(share, RunShare):
            yield Shared(
                kind="run",
                name=share.name,
                fingerprint=weights,
                share=digest,
                model=share.model,
                dataset=share.fingerprint,
                reports=len(share.samples),
                bytes=share.size,
            )
        else:
            yield Shared(kind="run", name="", fingerprint=weights, share=digest, damage=share)
