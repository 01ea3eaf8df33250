"""Fetch a run or a data set: it appears at its place in the workspace as a whole, verified, or not at all."""

from __future__ import annotations

import contextlib
import tempfile
from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from dmotion_bench.errors import (
    DatasetCorrupt,
    DatasetError,
    DatasetMissing,
    DatasetVersionUnknown,
    RunError,
    ShareCorrupt,
    ShareMissing,
    UsageError,
)
from dmotion_bench.learning.runs.run import Run
from dmotion_bench.sharing.arriving import Files, arriving, refused, settle, take
from dmotion_bench.sharing.place import DATASETS, HASH, RUNS, Place, damaged
from dmotion_bench.sharing.push import FILES, Kind, Tell, labels_stand, read_standing, standing_name
from dmotion_bench.sharing.run_share import LARGEST_MANIFEST, RunShare
from dmotion_bench.storage.atomic import remove_leftovers
from dmotion_bench.storage.check import check_dataset
from dmotion_bench.storage.lock import held
from dmotion_bench.storage.manifest import Manifest
from dmotion_bench.storage.shard import LABELS, VIDEO, FileFacts, file_facts, shard_path
from dmotion_bench.wording import command, shown
from dmotion_bench.workspace import DATASET_MANIFEST, Workspace

MOST_SHARES: Final = 100
"""Of one run, that are looked at."""
_ANOTHER: Final = "name another workspace with DMBENCH_WORKSPACE, or rename that folder"


@dataclass(frozen=True, kw_only=True)
class Pulled:
    """What was fetched.

    Attributes:
        kind, name: Of what.
        fingerprint: The hash of its weights or of its content.
        path: Its folder here.
        files, fetched: All of its files, and those that were not here before.
        bytes: Of those that were fetched.
        labels: Whether labels of a data set are here.
        dataset: The fingerprint of the data set that a run was trained on.
    """

    kind: Kind
    name: str
    fingerprint: str
    path: Path
    files: int
    fetched: int
    bytes: int
    labels: bool = False
    dataset: str = ""


def shares_of(place: Place, weights: str, beginning: str = "") -> Iterator[tuple[str, RunShare | str]]:
    """What is published of a run: by the SHA-256 of its manifest what that says, or why it cannot be used.

    Args:
        place: Where.
        weights: SHA-256 of its weights.
        beginning: Of the SHA-256 of the manifests that are looked at; others may be there by the hundred.

    Raises:
        PlaceUnreachable: The place does not answer.
    """
    folder = f"{RUNS}/{weights}"
    there = place.sizes(folder).items()
    found = {name: size for name, size in there if name.startswith(beginning) and name.endswith(".json")}
    for name in sorted(found)[:MOST_SHARES]:
        digest = name.removesuffix(".json")
        if HASH.fullmatch(digest):
            yield digest, _share(place, folder, weights, FileFacts(found[name], digest))


def _share(place: Place, folder: str, weights: str, facts: FileFacts) -> RunShare | str:
    if facts.size > LARGEST_MANIFEST:
        return f"it has {facts.size:,} bytes; at most {LARGEST_MANIFEST:,} are read"
    with tempfile.TemporaryDirectory() as scratch:
        file = Path(scratch) / "manifest.json"
        try:
            place.fetch(f"{folder}/{facts.sha256}.json", facts, file)
            share = RunShare.parse(file.read_bytes())
        except ShareCorrupt:  # it spoils no other manifest beside it
            return "it does not hold the bytes that its name describes"
        except (ValueError, FileNotFoundError) as error:
            return str(error)
    return share if share.weights == weights else f"it is of the weights {share.weights[:12]}"


def pull_run(
    place: Place, workspace: Workspace, weights: str, *, share: str = "", samples: str = "", tell: Tell
) -> Pulled:
    """Fetch a run into ``runs/``.

    Args:
        place: Where from.
        workspace: Where to.
        weights: SHA-256 of its weights.
        share: SHA-256 of the manifest that is meant, or its beginning, where the place has several of one run.
        samples: SHA-256 of the samples that it has to have.
        tell: Told how far it is.

    Raises:
        ShareMissing: It is not there.
        ShareCorrupt: It is not what its hashes say.
        UsageError: There are several, or another run has its name here.
        PlaceUnreachable: The place does not answer.
    """
    known = _meant(place, weights, share, samples)
    here = (one for one in known if _is_here(workspace.runs / one.name, _files_of_run(one)))
    meant = next(here, known[0])
    address, target, files = f"{place.address}/{RUNS}/{weights}", workspace.runs / meant.name, _files_of_run(meant)
    pulled = Pulled(
        kind="run",
        name=meant.name,
        fingerprint=weights,
        path=target,
        files=len(files),
        fetched=0,
        bytes=0,
        dataset=meant.fingerprint,
    )
    if target.exists() or target.is_symlink():
        _require_same(target, files)
        return pulled
    with arriving(workspace.runs, f"run-{weights[:16]}-{meant.digest[:8]}", files) as folder:
        fetched = take(place, files, folder, lambda done, total: tell(meant.name, done, total))
        with refused(folder, address):
            _verify_run(folder, meant)
        settle(folder, target)
    return _with(pulled, fetched)


def _files_of_run(share: RunShare) -> Files:
    return {name: (f"{RUNS}/{share.weights}/{FILES}/{facts.sha256}", facts) for name, facts in share.files.items()}


def _meant(place: Place, weights: str, share: str, samples: str) -> list[RunShare]:
    """What is meant of what is published of a run: one, or all that hold the samples, the one with most files first.

    A run that was scored on further data and published again has its earlier reports in both manifests. Who checks its
    entries one after the other needs the later one for some of them, and a run that is here is never replaced.
    """
    address = f"{place.address}/{RUNS}/{weights}"
    found = list(shares_of(place, weights, share))
    if not found and (known := list(shares_of(place, weights))):
        listed = ", ".join(f"{weights[:12]}/{digest[:12]}" for digest, _ in known[:8])
        raise ShareMissing(f"{shown(address)} has no manifest that begins with {share[:12]}; it has {listed}.")
    sound = {digest: one for digest, one in found if isinstance(one, RunShare)}
    fitting = {digest: one for digest, one in sound.items() if not samples or samples in one.samples}
    if not found:
        raise ShareMissing(
            f"{shown(place.address)} has no run with the weights {weights[:12]}; "
            f"see what it has with {command('dmbench share list', place.address)}."
        )
    if not sound:
        digest, why = found[0]
        raise damaged(f"{address}/{digest}.json", str(why).rstrip("."))
    if not fitting:
        raise ShareMissing(
            f"{shown(address)} has the weights, but no report with the samples {samples[:12]} that the entry names: "
            "the entry is of another scoring. Ask its author to publish it with 'dmbench share push ENTRY'."
        )
    named = {(one.name, tuple(sorted(one.files.items()))) for one in fitting.values()}
    if len(named) > 1 and not samples:
        choices = "; ".join(
            f"{weights[:12]}/{digest[:12]} is {one.name}, {len(one.samples)} reports" for digest, one in fitting.items()
        )
        raise UsageError(f"several reports of these weights are published; name the entry, or one of: {choices}.")
    return sorted(fitting.values(), key=lambda one: -len(one.files))


def _other(target: Path, files: Files) -> str:
    """A file of a run that is not here as it was published; empty if all are."""
    for name, (_, facts) in files.items():
        path = target / name
        if target.is_symlink() or not path.is_file() or file_facts(path) != facts:
            return name
    return ""


def _is_here(target: Path, files: Files) -> bool:
    return target.is_dir() and not _other(target, files)


def _require_same(target: Path, files: Files) -> None:
    """See that a run that is here already is the one that is meant."""
    if name := _other(target, files):
        raise UsageError(f"{shown(str(target))} is there already, and its {name} is not what is published; {_ANOTHER}.")


def _verify_run(folder: Path, share: RunShare) -> None:
    """See that what has arrived is the run that its manifest tells of.

    Raises:
        ValueError: It is not.
    """
    try:
        run = Run.open(folder)
        run.weights()
    except RunError as error:
        raise ValueError(str(error).rstrip(".")) from None
    said = {"weights": (run.result or {}).get("weights"), "data set": run.spec.fingerprint, "model": run.spec.model}
    for what, expected in (("weights", share.weights), ("data set", share.fingerprint), ("model", share.model)):
        if said[what] != expected:
            raise ValueError(f"its {what} is {shown(said[what])}, and {shown(expected)} was expected")


def pull_dataset(
    place: Place, workspace: Workspace, fingerprint: str, *, name: str = "", labels: bool, tell: Tell
) -> Pulled:
    """Fetch a data set into ``data/``; labels are added to one that is here without them.

    Args:
        place: Where from.
        workspace: Where to.
        fingerprint: Of its content.
        name: That it gets here; by default the one that it has there.
        labels: Whether to fetch ``labels/``, where they are there.
        tell: Told how far it is.

    Raises:
        ShareMissing: It is not there.
        ShareCorrupt: It is not what its hashes say.
        UsageError: Another data set has its name here.
        FolderInUse: Another process writes into that data set.
        PlaceUnreachable: The place does not answer.
    """
    standing = standing_name(place, fingerprint)
    if not standing:
        raise ShareMissing(
            f"{shown(place.address)} has no data set with the fingerprint {fingerprint[:12]}; "
            f"see what it has with {command('dmbench share list', place.address)}."
        )
    there = f"{DATASETS}/{fingerprint}/{standing}"
    address, target = f"{place.address}/{there}", workspace.data / (name or standing)
    try:
        manifest = read_standing(place, there, fingerprint)
    except (FileNotFoundError, ValueError) as error:
        raise damaged(f"{address}/{DATASET_MANIFEST}", error) from None
    kinds = (VIDEO, LABELS) if labels and labels_stand(place, there, manifest) else (VIDEO,)
    files = dict(_files_of(manifest, there, kinds))
    pulled = Pulled(
        kind="data set",
        name=target.name,
        fingerprint=fingerprint,
        path=target,
        files=len(files) + 1,
        fetched=0,
        bytes=0,
        labels=LABELS in kinds,
    )

    def told(done: int, total: int) -> None:
        tell(target.name, done, total)

    if target.exists() or target.is_symlink():
        lacking = _lacking(target, manifest, files)
        with held(target) if lacking else contextlib.nullcontext():
            remove_leftovers(target / LABELS)
            fetched = take(place, lacking, target, told)
        here = all(shard_path(target, LABELS, index).is_file() for index in range(len(manifest.shards)))
        return _with(replace(pulled, labels=here), fetched)
    with arriving(workspace.data, f"dataset-{fingerprint[:16]}", files) as folder:
        fetched = take(place, files, folder, told)
        with refused(folder, address):
            manifest.write(folder)
            _verify_dataset(folder)
        settle(folder, target)
    return _with(pulled, fetched | {DATASET_MANIFEST: FileFacts(0, "")})


def _files_of(manifest: Manifest, there: str, kinds: tuple[str, ...]) -> Iterator[tuple[str, tuple[str, FileFacts]]]:
    """The files of a data set but ``dataset.json``; their names follow from their number alone."""
    for index, shard in enumerate(manifest.shards):
        for kind in kinds:
            facts = shard.video if kind == VIDEO else shard.labels
            if facts is not None:
                name = f"{kind}/{shard_path(Path(), kind, index).name}"
                yield name, (f"{there}/{name}", facts)
    for name, facts in manifest.tables.items():
        yield name, (f"{there}/{name}", facts)


def _lacking(target: Path, manifest: Manifest, files: Files) -> Files:
    """The labels that a data set which is here lacks.

    Raises:
        UsageError: It is another data set, or none that can be opened, or damaged.
    """
    try:
        here = "" if target.is_symlink() else Manifest.read(target).fingerprint
    except (DatasetMissing, DatasetCorrupt, DatasetVersionUnknown):
        here = ""
    except DatasetError as error:
        raise UsageError(f"{shown(str(target))} is there already, and cannot be opened: {error}") from None
    if here != manifest.fingerprint:
        raise UsageError(f"{shown(str(target))} is there already, and is another data set; {_ANOTHER}.")
    lacking = dict[str, tuple[str, FileFacts]]()
    for name, one in files.items():
        path = target / name
        if not name.startswith((VIDEO, LABELS)):
            continue  # tables that another dmbench has made
        if not path.is_file() and name.startswith(LABELS):
            lacking[name] = one
        elif not path.is_file() or file_facts(path) != one[1]:
            repair = command("dmbench data repair", target)
            raise UsageError(f"{shown(str(path))} is damaged; mend it with {repair}, or delete that data set.")
    return lacking


def _verify_dataset(folder: Path) -> None:
    """Read all that has arrived: no fingerprint tells the tables, but the shards do.

    Raises:
        ValueError: Something is not what was recorded.
    """
    try:
        damages = check_dataset(folder).damages
    except DatasetError as error:
        raise ValueError(str(error).rstrip(".")) from None
    if damages:
        raise ValueError(f"{damages[0].file} {damages[0].what}")


def _with(pulled: Pulled, fetched: dict[str, FileFacts]) -> Pulled:
    return replace(pulled, fetched=len(fetched), bytes=sum(facts.size for facts in fetched.values()))
